"""Fixtures of the patches' tests: processes that need no import of torch, and a scene."""
from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from checkouts import HERE, environment, make_scene

LIMIT = 300  # seconds for one process; thirty times what it takes on a slow machine


class Processes:
    """Runs scripts in forks of a process that has imported torch, at most two at once."""

    def __init__(self, folder):
        self.folder, self.count = folder, 0
        self.pool = ThreadPoolExecutor(2)
        self.server = subprocess.Popen([sys.executable, str(HERE / "warm_server.py")], stdin=subprocess.PIPE,
                                       text=True, env=environment())

    def start(self, *argv, cwd, uid=None, **env):
        """A future of (status, out, err) of a script with arguments, or of "-m", a module and arguments."""
        self.count += 1
        return self.pool.submit(self._run, self.count, [str(word) for word in argv], str(cwd), uid,
                                environment(**{**self.path(), **env}))

    def run(self, *argv, cwd, **options):
        return self.start(*argv, cwd=cwd, **options).result()

    def dsmoe(self, *argv, cwd, **options):
        return self.start("-m", "diff_smoe_rasterization", *argv, cwd=cwd, **options)

    def path(self):
        """PATH with a `python` that is this interpreter."""
        folder = self.folder / "bin"
        if not folder.exists():
            folder.mkdir()
            (folder / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
            (folder / "python").chmod(0o755)
        return {"PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"}

    def _run(self, number, argv, cwd, uid, env):
        files = {name: str(self.folder / f"{number}.{name}") for name in ("out", "err", "done")}
        self.server.stdin.write(json.dumps({"argv": argv, "cwd": cwd, "uid": uid, "env": env, **files}) + "\n")
        self.server.stdin.flush()
        end = time.monotonic() + LIMIT
        while not os.path.exists(files["done"]):
            assert self.server.poll() is None, "the server of warm processes died"
            assert time.monotonic() < end, f"{argv} took more than {LIMIT} s"
            time.sleep(0.01)
        out, err = (Path(files[name]).read_text() for name in ("out", "err"))
        return SimpleNamespace(status=int(Path(files["done"]).read_text()), out=out, err=err)

    def close(self):
        self.pool.shutdown()
        self.server.stdin.close()
        self.server.wait()


@pytest.fixture(scope="session")
def processes(tmp_path_factory):
    made = Processes(tmp_path_factory.mktemp("processes"))
    yield made
    made.close()


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scenes") / "chairs")


@pytest.fixture(scope="session")
def dsmoe():
    """Runs the command in this process; returns status, out, err."""
    from diff_smoe_rasterization import cli

    def run(*argv):
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = cli.main([str(word) for word in argv])
            except SystemExit as stop:
                status = stop.code
        return SimpleNamespace(status=status, out=out.getvalue(), err=err.getvalue())

    return run
