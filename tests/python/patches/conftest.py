"""What the patches' tests run: the command in this process, trainers in processes of their own."""
from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from types import SimpleNamespace

import pytest
from checkouts import environment, make_scene


@pytest.fixture(scope="session")
def dsmoe():
    """Runs the command in this process; returns status, out, err."""
    from dsmoe import cli

    def run(*argv):
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = cli.main([str(word) for word in argv])
            except SystemExit as stop:
                status = stop.code
        return SimpleNamespace(status=status, out=out.getvalue(), err=err.getvalue())

    return run


@pytest.fixture(scope="session")
def python():
    """Runs Python with these words in a folder, in an environment without a blend mode; returns status, out, err."""
    def run(*words, cwd, **more):
        result = subprocess.run([sys.executable, *map(str, words)], cwd=str(cwd), env=environment(**more),
                                stdout=subprocess.PIPE, stderr=subprocess.PIPE, universal_newlines=True)
        return SimpleNamespace(status=result.returncode, out=result.stdout, err=result.stderr)

    return run


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scenes") / "chairs")
