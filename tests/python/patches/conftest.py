"""Fixtures of the patches' tests: processes that need no import of torch, a scene, and trained trainers."""
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
from checkouts import HERE, TRAINERS, contents, environment, make_checkout, make_scene

LIMIT = 300  # seconds for one process; a hundred times what it takes


class Processes:
    """Runs scripts in forks of a process that has imported torch, at most two at once."""

    def __init__(self, folder):
        self.folder, self.count = folder, 0
        self.pool = ThreadPoolExecutor(2)
        self.server = subprocess.Popen([sys.executable, str(HERE / "warm_server.py")], stdin=subprocess.PIPE,
                                       text=True, env=environment())
        (folder / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
        (folder / "python").chmod(0o755)
        self.path = f"{folder}{os.pathsep}{os.environ['PATH']}"  # whose `python` is this interpreter

    def start(self, *argv, cwd, after=(), **env):
        """A future of (status, out, err) of a script with arguments, or of "-m", a module and arguments.

        after: futures that must be there before it starts.
        """
        self.count += 1
        return self.pool.submit(self._run, self.count, [str(word) for word in argv], str(cwd), after,
                                environment(PATH=self.path, **env))

    def run(self, *argv, cwd, **options):
        return self.start(*argv, cwd=cwd, **options).result()

    def dsmoe(self, *argv, cwd, **options):
        return self.start("-m", "diff_smoe_rasterization", *argv, cwd=cwd, **options)

    def _run(self, number, argv, cwd, after, env):
        for future in after:
            future.result()
        files = {name: str(self.folder / f"{number}.{name}") for name in ("out", "err", "done")}
        self.server.stdin.write(json.dumps({"argv": argv, "cwd": cwd, "env": env, **files}) + "\n")
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


class Runs:
    """Trainers that are trained with small scenes, patched and not: Runs()(name) waits for those of one trainer."""

    # Every one by `dsmoe run` in one of the SMoE modes; in `alpha` too where the other code of a run is at stake.
    KINDS = (("patched", "alpha"), ("patched", "smoe"), ("plain", "smoe"))

    def __init__(self, folder, scene, processes, names):
        self.folder, self.scene, self.processes, self.made = folder, scene, processes, {}
        for name in sorted({"3dgs-2023", *names}, key=TRAINERS.index):
            self.made[name] = self._start(name)

    def __call__(self, name):
        made = self.made[name]
        for key, job in made.jobs.items():
            result = made.results[key] = job.result()
            assert result.status == 0, f"{name}, {key}: {result.out}\n{result.err}"
        return made

    def script(self, name, mode):
        """The words that train; c3dgs compresses what the trainer of 2023 has trained."""
        if name == "c3dgs":
            return ["compress.py", "-m", self.made["3dgs-2023"].outputs["patched", mode], "--output_vq"]
        return ["train.py", "-s", self.scene, "--quiet", "-m"]

    def _start(self, name):
        from diff_smoe_rasterization import patches

        plain = make_checkout(name, self.folder / name / "plain")
        patched = make_checkout(name, self.folder / name / "patched")
        patches.apply(patched)
        kinds = self.KINDS + ((("plain", "alpha"),) if name == "3dgs-2023" else ())
        outputs = {(kind, mode): self.folder / name / f"{kind}_{mode}" for kind, mode in kinds}
        before, jobs = contents(plain), {}
        after = list(self.made["3dgs-2023"].jobs.values()) if name == "c3dgs" else []
        for (kind, mode), output in outputs.items():
            script, *words = [*self.script(name, mode), output]
            if kind == "patched":
                job = self.processes.start(patched / script, *words, "--blend_mode", mode, cwd=patched, after=after)
            elif name in ("3dgs-2023", "hac"):  # from somewhere else, with an option of Python's
                job = self.processes.dsmoe("run", "--blend-mode", mode, "--", "python", "-u", plain / script, *words,
                                           cwd=self.folder, after=after)
            else:  # in the checkout, as the trainers' READMEs say
                job = self.processes.dsmoe("run", "--blend-mode", mode, "--", "python", script, *words, cwd=plain,
                                           after=after)
            jobs[kind, mode] = job
        return SimpleNamespace(plain=plain, patched=patched, outputs=outputs, jobs=jobs, results={}, before=before)


@pytest.fixture(scope="session")
def processes(tmp_path_factory):
    made = Processes(tmp_path_factory.mktemp("processes"))
    yield made
    made.close()


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scenes") / "chairs")


def trainers_of_runs(items):
    """The trainers that the selected tests train, by their parameter `name`; None where no test trains any."""
    tests = [item for item in items if "runs" in getattr(item, "fixturenames", ())]
    names = {item.callspec.params.get("name") for item in tests if hasattr(item, "callspec")} - {None}
    return {"3dgs-2024", *names} if tests else None


@pytest.fixture(scope="session")
def runs(request, tmp_path_factory, scene, processes):
    return Runs(tmp_path_factory.mktemp("runs"), scene, processes, trainers_of_runs(request.session.items))


@pytest.fixture(scope="session", autouse=True)
def trainers_train_while_other_tests_run(request):
    if trainers_of_runs(request.session.items) is not None:
        request.getfixturevalue("runs")


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
