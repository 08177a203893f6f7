"""Fixtures of the patches' tests: processes that need no import of torch, a scene, and trained trainers."""
from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
from checkouts import HERE, TRAINERS, contents, environment, make_checkout, make_scene
from warm_python import ask


class Processes:
    """Runs Python in forks of a process that has imported torch, at most two at once; see warm_python.py."""

    def __init__(self, folder):
        self.folder, self.count = folder, 0
        self.socket = str(folder / "socket")
        self.pool = ThreadPoolExecutor(2)
        warm = HERE / "warm_python.py"
        self.server = subprocess.Popen([sys.executable, str(warm), "serve", self.socket], env=environment())
        self.warm_path = self._path_with_python("warm", f'-S -E "{warm}" ask "{self.socket}"')
        self.real_path = self._path_with_python("real", "")

    def _path_with_python(self, name, words):
        """A PATH whose `python` is this interpreter with these words in front of its arguments."""
        (self.folder / name).mkdir()
        (self.folder / name / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n')
        (self.folder / name / "python").chmod(0o755)
        return f"{self.folder / name}{os.pathsep}{os.environ['PATH']}"

    def start(self, *words, cwd, after=(), real=False, **env):
        """A future of (status, out, err) of `python *words`.

        after: futures that must be there before it starts; real: processes that it starts as `python` are fresh
        interpreters, seconds each, and no forks.
        """
        self.count += 1
        path = self.real_path if real else self.warm_path
        return self.pool.submit(self._run, self.folder / str(self.count), [str(word) for word in words], str(cwd),
                                after, environment(PATH=path, **env))

    def run(self, *words, cwd, **options):
        return self.start(*words, cwd=cwd, **options).result()

    def dsmoe(self, *words, cwd, **options):
        return self.start("-m", "diff_smoe_rasterization", *words, cwd=cwd, **options)

    def _run(self, files, words, cwd, after, env):
        for future in after:
            future.result()
        while not os.path.exists(self.socket):
            assert self.server.poll() is None, "the server of warm processes died"
            time.sleep(0.05)
        out, err = files.with_suffix(".out"), files.with_suffix(".err")
        with open(os.devnull) as nothing, open(out, "w") as out_file, open(err, "w") as err_file:
            status = ask(self.socket, words, cwd, env, [file.fileno() for file in (nothing, out_file, err_file)])
        return SimpleNamespace(status=status, out=out.read_text(), err=err.read_text())

    def close(self):
        self.pool.shutdown()
        self.server.kill()
        self.server.wait()


class Runs:
    """Trainers that are trained with small scenes, patched and not: Runs()(name) waits for those of one trainer."""

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
        outputs = {(kind, mode): self.folder / name / f"{kind}_{mode}" for kind in ("patched", "plain")
                   for mode in ("alpha", "smoe")}
        before, jobs = contents(plain), {}
        after = list(self.made["3dgs-2023"].jobs.values()) if name == "c3dgs" else []
        for (kind, mode), output in outputs.items():
            script, *words = [*self.script(name, mode), output]
            if kind == "patched":
                job = self.processes.start(patched / script, *words, "--blend_mode", mode, cwd=patched, after=after)
            elif mode == "smoe":  # from somewhere else, with an option of Python's
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
