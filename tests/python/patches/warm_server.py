"""Runs Python scripts without the seconds that importing torch takes: each in a fork of this process.

Reads one job a line from stdin, as JSON: argv (a script and its arguments, or "-m", a module and its arguments), cwd,
env, out, err, done. Writes the exit status into `done` when the job has ended.
"""
import json
import os
import runpy
import sys
import traceback

import numpy  # noqa: F401  what every job would import
import PIL.Image  # noqa: F401
import torch
import tqdm  # noqa: F401


def run(job):
    os.chdir(job["cwd"])
    os.environ.clear()
    os.environ.update(job["env"])
    for number, name in ((0, os.devnull), (1, job["out"]), (2, job["err"])):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644), number)
    sys.dont_write_bytecode = "PYTHONDONTWRITEBYTECODE" in job["env"]
    paths = job["env"]["PYTHONPATH"].split(os.pathsep)
    sys.path[:] = paths + [path for path in sys.path[1:] if path not in paths]
    argv = job["argv"]
    try:
        if argv[0] == "-m":
            sys.argv = argv[1:]
            sys.path.insert(0, os.getcwd())
            runpy.run_module(argv[1], run_name="__main__", alter_sys=True)
        else:
            sys.argv = argv
            sys.path.insert(0, os.path.dirname(os.path.abspath(argv[0])))
            runpy.run_path(argv[0], run_name="__main__")
        return 0
    except SystemExit as stop:
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1


def main():
    torch.set_num_threads(1)
    for line in sys.stdin:
        job = json.loads(line)
        keeper = os.fork()
        if keeper == 0:
            runner = os.fork()
            if runner == 0:
                status = run(job)
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
            status = os.waitpid(runner, 0)[1]
            with open(job["done"] + ".part", "w") as file:
                file.write(str(os.WEXITSTATUS(status) if os.WIFEXITED(status) else -os.WTERMSIG(status)))
            os.rename(job["done"] + ".part", job["done"])
            os._exit(0)
        while True:  # reap keepers that have ended
            try:
                if os.waitpid(-1, os.WNOHANG)[0] == 0:
                    break
            except ChildProcessError:
                break


if __name__ == "__main__":
    main()
