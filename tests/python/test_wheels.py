"""The workflow that builds the wheels, and the script that attaches them to a release."""
from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from diff_smoe_rasterization import __version__

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = ROOT / ".github" / "workflows"


@pytest.fixture(scope="module")
def workflow():
    yaml = pytest.importorskip("yaml")
    return yaml.safe_load((WORKFLOWS / "wheels.yml").read_text(encoding="utf-8"))


def steps(workflow, key):
    return [step[key] for job in workflow["jobs"].values() for step in job["steps"] if key in step]


def test_each_step_runs_one_script_of_the_repository(workflow):
    commands = steps(workflow, "run")
    assert len(commands) >= 4
    for command in commands:
        assert len(command.splitlines()) == 1 and not set(command) & set(";&|`<>"), command
        script = (ROOT / shlex.split(command)[0]).resolve()
        assert ROOT in script.parents and script.is_file() and os.access(script, os.X_OK), command
    assert {shlex.split(command)[0] for command in commands} >= {".ci/run", "build_support/wheel"}


def test_actions_are_pinned_by_commit_and_name_their_release(workflow):
    actions = steps(workflow, "uses")
    assert len(actions) >= 6
    for action in actions:
        assert re.fullmatch("actions/[a-z-]+@[0-9a-f]{40}", action), action
    lines = re.findall(r"uses: (\S+)(.*)", (WORKFLOWS / "wheels.yml").read_text(encoding="utf-8"))
    assert [action for action, _ in lines] == actions
    assert all(re.fullmatch(r"  # v\d+\.\d+\.\d+", comment) for _, comment in lines)


def test_only_the_job_that_attaches_may_write(workflow):
    assert workflow["permissions"] == {"contents": "read"}
    writers = [name for name, job in workflow["jobs"].items() if "permissions" in job]
    assert writers == ["attach"] and workflow["jobs"]["attach"]["permissions"] == {"contents": "write"}
    assert set(workflow["jobs"]["attach"]["needs"]) == set(workflow["jobs"]) - {"attach"}
    assert workflow["jobs"]["attach"]["if"] == "startsWith(github.ref, 'refs/tags/')"


@pytest.fixture
def attach(tmp_path):
    """Runs a copy of the script with a `gh` that writes down how it is called; returns its status, errors and calls."""
    for path in ("build_support/attach_wheels", "build_support/environment.sh",
                 "diff_smoe_rasterization/_version.py"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / path, tmp_path / path)
    gh = tmp_path / "bin" / "gh"
    gh.parent.mkdir()
    gh.write_text('#!/bin/sh\necho "$@" >>"$CALLS"\n[ "$2" != view ] || exit "$NO_RELEASE"\n')
    gh.chmod(0o755)

    def run(tag, *wheels, no_release=0):
        folder, calls = tmp_path / "dist" / "stable", tmp_path / "calls"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for wheel in wheels:
            (folder / wheel).touch()
        calls.write_text("")
        environment = {**os.environ, "PATH": f"{gh.parent}:{os.environ['PATH']}", "CALLS": str(calls),
                       "NO_RELEASE": str(no_release)}
        result = subprocess.run([str(tmp_path / "build_support" / "attach_wheels"), tag], env=environment,
                                stdout=subprocess.PIPE, stderr=subprocess.PIPE, universal_newlines=True)
        return result.returncode, result.stderr, [line.split() for line in calls.read_text().splitlines()]

    return run


@pytest.mark.parametrize("no_release", [0, 1])
def test_the_wheels_are_attached_to_the_release_of_the_tag(attach, no_release):
    tag = f"v{__version__}"
    stem = f"diff_smoe_rasterization-{__version__}"
    names = [f"{stem}+{kind}-cp310.cp312-none-linux_x86_64.whl" for kind in ("cpu", "cu13")]
    status, errors, calls = attach(tag, *names, no_release=no_release)
    assert status == 0, errors
    made = [call for call in calls if call[1] == "create"]
    assert len(made) == no_release and all(call[2] == tag and "--verify-tag" in call for call in made)
    assert calls[-1][:3] == ["release", "upload", tag]
    assert [Path(word).name for word in calls[-1] if word.endswith(".whl")] == names


@pytest.mark.parametrize("tag, wheel, message", [
    ("v999.0", f"diff_smoe_rasterization-{__version__}+cpu-x.whl", "the tag must be v"),
    (f"v{__version__}", "diff_smoe_rasterization-999.0+cpu-x.whl", "has no wheel of version"),
])
def test_a_wrong_tag_or_a_missing_wheel_stops_before_github_is_asked(attach, tag, wheel, message):
    status, errors, calls = attach(tag, wheel)
    assert status != 0 and message in errors and not calls
