"""`dsmoe run`: what the command's processes see, what is refused, and the exit status."""
from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import pytest
from checkouts import PACKAGE_PARENT, contents, environment
from tiny import GR, RENDERER, make

from diff_smoe_rasterization import patches
from diff_smoe_rasterization.patches import run
from diff_smoe_rasterization.settings import BLEND_MODES, RECOMMENDED_BACKGROUND_GATE

SHOW = """import os, sys
sys.path.insert(0, "")
import diff_gaussian_rasterization
print(diff_gaussian_rasterization.GaussianRasterizer.__module__, os.environ["DSMOE_BLEND_MODE"], sys.argv[1:])
import gaussian_renderer
sys.exit(7)
"""
RUN = ("run", "--blend-mode", "smoe")
WORDS = ["--blend_mode", "a b", "--", "*", "--help", ""]


def test_an_unmodified_checkout_runs_and_stays_as_it_was(tmp_path, python):
    """The script's folder says which trainer it is; a child of the child has the same rasterizer and mode."""
    checkout = make(tmp_path / "a trainer", {
        "show.py": SHOW, "parent.py": "import os, subprocess, sys\nos.chdir(os.path.dirname(sys.argv[0]))\n"
                                      "sys.exit(subprocess.call([sys.executable, 'show.py'] + sys.argv[1:]))\n"})
    before = contents(tmp_path)
    result = python("-m", "diff_smoe_rasterization", *RUN, "--background-gate", "0.25", "--", sys.executable,
                    checkout / "parent.py", *WORDS, cwd=tmp_path, PYTHONPATH=str(PACKAGE_PARENT))
    assert result.status == 7, result.err
    assert result.out.splitlines() == [f"diff_smoe_rasterization.rasterizer smoe {WORDS}"]
    announced, *said = result.err.splitlines()
    words = "of this package, blend mode smoe, background gate 0.25"
    assert "3dgs-2023" in announced and "will be inria " + words in announced
    assert said == ["diff_smoe_rasterization: the rasterizer is inria " + words]
    assert contents(tmp_path) == before


def test_it_becomes_the_command(monkeypatch, dsmoe):
    """So that signals and exit status are the command's own."""
    called = []
    monkeypatch.setattr(os, "execvpe", lambda *words: called.append(words))
    monkeypatch.setattr(run, "_ask_python", lambda *_: ([], []))
    dsmoe(*RUN, "--trainer", "scaffold", "--", sys.executable, "show.py")
    (name, words, variables), = called
    assert name == sys.executable and words == [sys.executable, "show.py"] and variables["DSMOE_BLEND_MODE"] == "smoe"
    folders = variables["PYTHONPATH"].split(os.pathsep)
    assert folders[:5] == [str(run.SHIMS / name) for name in ("scaffold", *run.STAND_INS)]


@pytest.mark.slow
def test_stand_ins_only_for_what_is_missing(tmp_path, python):
    """What the command's Python can import itself is left to it. Each stand-in says that it is used."""
    variables = environment()  # has simple_knn and fused_ssim, and no weighted_distance
    made, _ = run.prepare([sys.executable, "x.py"], "smoe", "hac", variables)
    folders = made["PYTHONPATH"].split(os.pathsep)
    assert folders[0] == str(run.SHIMS / "scaffold") and str(run.SHIMS / "weighted_distance") in folders
    assert str(run.SHIMS / "simple_knn") not in folders and made["PYTHONPATH"].endswith(variables["PYTHONPATH"])
    code = "from simple_knn._C import distCUDA2; import fused_ssim; fused_ssim.fused_ssim"
    shims = [str(run.SHIMS / name) for name in ("simple_knn", "fused_ssim", "weighted_distance")]
    result = python("-c", code, cwd=tmp_path, PYTHONPATH=os.pathsep.join([*shims, variables["PYTHONPATH"]]))
    assert [line.split()[1] for line in result.err.splitlines()] == ["simple_knn", "fused_ssim"], result.err


def test_every_flavour_has_its_shim():
    assert set(run.flavours()) >= {known.flavour for known in run.TRAINERS}
    for flavour in run.flavours():
        text = (run.SHIMS / flavour / "diff_gaussian_rasterization/__init__.py").read_text()
        assert f"from diff_smoe_rasterization.integrations.{flavour} import *" in text
        assert f'say_rasterizer("{flavour}")' in text


@pytest.mark.parametrize("mode", BLEND_MODES)
def test_the_gate_of_the_children(mode, monkeypatch, dsmoe):
    """That which is asked for, else the variable's, else the recommended one; and none in other modes than smoe."""
    words = [sys.executable, "show.py"]
    monkeypatch.setattr(run, "_ask_python", lambda *_: (run.STAND_INS.values(), []))  # takes seconds
    for variable, asked, gate in (("", None, RECOMMENDED_BACKGROUND_GATE), ("0.25", None, 0.25), ("0.25", 0.0, 0.0)):
        monkeypatch.setenv("DSMOE_BACKGROUND_GATE", variable)
        if mode == "smoe" or asked is None:
            made, lines = run.prepare(words, mode, "scaffold", dict(os.environ), asked)
            assert made.get("DSMOE_BACKGROUND_GATE") == (str(gate) if mode == "smoe" else None)
            assert (f"blend mode {mode}, background gate {gate};" in lines[0]) == (mode == "smoe")
    for gate in ("-1", "nan") if mode == "smoe" else ("0.1",):
        said = dsmoe("run", "--blend-mode", mode, "--background-gate", gate, "--trainer", "scaffold", "--", *words)
        assert said.status == 1 and "background_gate is" in said.err


OURS = RENDERER.replace("diff_gaussian_rasterization import", "diff_smoe_rasterization.integrations.inria import")
PYTHON = [*RUN, "--", sys.executable, "train.py"]


@pytest.mark.parametrize("files, words, said", [
    ({}, ["run", "--", "python", "train.py"], "--blend-mode"), ({}, ["run", "--blend-mode", "smooth"], "smoe_tn"),
    ({}, [*RUN, "--"], "there is no command"), ({}, ["run", "--blend_mode", "smoe", "--"], "there is no command"),
    ({}, [*RUN, "--", "no-such-command"], "no-such-command: there is no such command"),
    ({"tool.py": ""}, [*RUN, "--", "./tool.py"], "./tool.py: is not executable; type: python ./tool.py"),
    ({GR: None}, PYTHON, "name it with --trainer, or the rasterizer whose API it calls (c3dgs, inria, inria_2024"),
    ({}, [*RUN, "--trainer", "nerf", "--", sys.executable], "there is no trainer 'nerf'; it must be one of 3dgs-2023"),
    ({"diff_gaussian_rasterization.py": ""}, PYTHON, "diff_gaussian_rasterization.py would be imported before"),
    ({"diff_gaussian_rasterization/a": ""}, PYTHON, "diff_gaussian_rasterization would be imported before"),
    ({GR: OURS}, PYTHON, "is patched already: run the command itself, with --blend_mode")])
def test_what_would_not_use_the_rasterizer_is_refused(files, words, said, tmp_path, dsmoe, monkeypatch):
    monkeypatch.chdir(make(tmp_path, files))
    result = dsmoe(*words)
    assert result.status in (1, 2) and said in result.err and "Traceback" not in result.err


def test_a_python_without_the_package_is_named(tmp_path, dsmoe, monkeypatch):
    other = tmp_path / "python3"  # a Python that finds nothing but its own library
    other.write_text(f'#!/bin/sh\nexec env -u PYTHONPATH "{sys.executable}" -I -S "$@"\n')
    other.chmod(0o755)
    monkeypatch.chdir(make(tmp_path / "trainer"))
    said = dsmoe(*RUN, "--", other, "train.py")
    assert said.status == 1 and f"{other} (Python" in said.err and "cannot import diff_smoe_rasterization" in said.err


def test_a_patched_checkout_is_refused_until_nothing_of_the_patch_is_left(tmp_path, monkeypatch):
    pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")
    monkeypatch.setattr(run, "_ask_python", lambda *_: ([], []))
    patches.apply(make(tmp_path))
    words = [sys.executable, str(tmp_path / "train.py")], "smoe", None, environment()
    with pytest.raises(patches.PatchError, match="patched already"):
        run.prepare(*words)
    make(tmp_path)  # as git checkout does
    assert run.prepare(*words)


def test_the_package_brings_the_shims_and_nothing_beside_itself():
    """Not one of the names that the shims stand in for is installed as such."""
    pytest.importorskip("setuptools")
    root = Path(__file__).resolve().parents[3]
    spec = importlib.util.spec_from_file_location("dsmoe_setup", root / "setup.py")
    setup = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(setup)
    packages = setup.packages()
    assert {name.partition(".")[0] for name in packages["packages"]} == {"diff_smoe_rasterization"}
    brought = {path for pattern in packages["package_data"]["diff_smoe_rasterization.patches"]
               for path in (root / "patches").glob(pattern)}
    assert brought == set((root / "patches/shims").rglob("*.py")) != set()
    assert {folder.name for folder in run.SHIMS.iterdir()} == set(run.flavours()) | set(run.STAND_INS)
