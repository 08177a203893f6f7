"""A Python that starts in milliseconds: forks of a process that has imported torch.

    python warm_python.py serve SOCKET          waits for jobs
    python warm_python.py ask SOCKET ARGS...    runs `python ARGS...` in a fork; what stands for `python` in the tests

A fork does what a fresh interpreter would: it takes folder, environment and files from who asks, sets sys.path from
PYTHONPATH, imports sitecustomize, and runs a script, -m MODULE or -c CODE.
"""
import array
import json
import os
import signal
import socket
import sys


def ask(path, arguments, cwd, environment, files):
    """Runs `python *arguments` with the three files as its standard ones; returns its status, negative for a signal."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(path)
        connection.sendmsg([b"j"], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", files))])
        connection.sendall(json.dumps({"arguments": arguments, "cwd": cwd, "environment": environment}).encode())
        connection.shutdown(socket.SHUT_WR)
        return int(connection.makefile().read())


def serve(path):
    import numpy  # noqa: F401  what nearly every job imports
    import PIL.Image  # noqa: F401
    import torch
    import tqdm  # noqa: F401

    torch.set_num_threads(1)
    own = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    base = [entry for entry in sys.path[1:] if entry not in own]
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # keepers leave nothing to wait for
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path + ".part")
        listener.listen(16)
        os.rename(path + ".part", path)
        while True:
            connection, _ = listener.accept()
            if os.fork() == 0:
                listener.close()
                keep(connection, base)
            connection.close()


def keep(connection, base):
    """Runs the job of a connection in a fork, and tells its status."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _, [(_, _, data)], _, _ = connection.recvmsg(1, socket.CMSG_SPACE(3 * 4))
    files = array.array("i", data)
    job = json.loads(connection.makefile().read())
    runner = os.fork()
    if runner == 0:
        connection.close()
        status = run(job, files, base)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(status)
    status = os.waitpid(runner, 0)[1]
    connection.sendall(str(os.WEXITSTATUS(status) if os.WIFEXITED(status) else -os.WTERMSIG(status)).encode())
    os._exit(0)


def run(job, files, base):
    for standard, given in enumerate(files):
        os.dup2(given, standard)
        os.close(given)
    os.chdir(job["cwd"])
    os.environ.clear()
    os.environ.update(job["environment"])
    sys.dont_write_bytecode = bool(os.environ.get("PYTHONDONTWRITEBYTECODE"))
    sys.pycache_prefix = os.environ.get("PYTHONPYCACHEPREFIX")
    sys.path[:] = [entry for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry] + base
    try:
        return start(job["arguments"])
    except SystemExit as stop:
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
        return 1


def start(arguments):
    import importlib
    import runpy

    sys.modules.pop("sitecustomize", None)
    try:
        importlib.import_module("sitecustomize")
    except ModuleNotFoundError:
        pass
    while arguments[0] in ("-u", "-B"):
        arguments = arguments[1:]
    if arguments[0] == "-m":
        sys.argv = arguments[1:]
        sys.path.insert(0, os.getcwd())
        runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
    elif arguments[0] == "-c":
        sys.argv = ["-c", *arguments[2:]]
        sys.path.insert(0, "")
        exec(compile(arguments[1], "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.argv = arguments
        sys.path.insert(0, os.path.dirname(os.path.abspath(arguments[0])))
        runpy.run_path(arguments[0], run_name="__main__")
    return 0


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2])
    status = ask(sys.argv[2], sys.argv[3:], os.getcwd(), dict(os.environ), [0, 1, 2])
    sys.exit(status if status >= 0 else 128 - status)
