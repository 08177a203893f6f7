"""`dsmoe run`: an unmodified trainer, and what it starts, with this rasterizer; and what it refuses."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from checkouts import TRAINERS, contents, make_checkout

from diff_smoe_rasterization import patches

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")


@pytest.fixture
def run(processes):
    """Starts `dsmoe run` with these words in a folder."""
    return lambda *words, cwd, **env: processes.dsmoe("run", *words, cwd=cwd, **env)


def test_child_processes_have_the_rasterizer_too(runs, run, tmp_path):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    before = contents(checkout)
    # A mode in the environment gives way to the one that is asked for.
    job = run("--blend-mode", "smoe", "--", "python", "full_eval.py", "-mu", runs.scene.parent, "--output_path",
              tmp_path / "eval", cwd=checkout, DSMOE_BLEND_MODE="alpha", real=True)
    assert job.result().status == 0, job.result().err
    assert contents(checkout) == before
    trained, = (tmp_path / "eval").rglob("point_cloud.npz")
    expected, = runs("3dgs-2023").outputs["plain", "smoe"].rglob("point_cloud.npz")
    with np.load(trained) as one, np.load(expected) as other:
        assert all(one[name].tobytes() == other[name].tobytes() for name in other.files)
    assert len(list((tmp_path / "eval").rglob("*.png"))) == 1


def test_arguments_and_exit_status_are_passed_on(run, tmp_path):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    (checkout / "tell.py").write_text("import sys\nprint(sys.argv[1:])\nsys.exit(7)\n")
    words = ["--blend_mode", "a b", "--", "*", "--help", ""]
    result = run("--blend-mode", "smoe", "--", "python", "tell.py", *words, cwd=checkout).result()
    assert result.status == 7 and result.out.strip() == str(words)


def test_any_command_runs_for_a_trainer_that_is_named(run, tmp_path):
    code = "from diff_gaussian_rasterization import GaussianRasterizer, SparseGaussianAdam"
    result = run("--blend-mode", "smoe", "--trainer", "3dgs-2024", "--", "python", "-c", code, cwd=tmp_path).result()
    assert result.status == 0, result.err
    assert list(tmp_path.iterdir()) == []


def test_what_is_missing_or_wrong_is_refused_by_name(dsmoe, tmp_path, monkeypatch):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    patched = make_checkout("hac", tmp_path / "patched")
    patches.apply(patched)
    unknown = tmp_path / "unknown"
    unknown.mkdir()
    for folder in (unknown, checkout, patched):
        (folder / "mark.py").write_text("open('it ran', 'w')\n")

    def refused(folder, *words):
        monkeypatch.chdir(folder)
        result = dsmoe("run", *words)
        assert result.status not in (0, None) and not (Path(folder) / "it ran").exists()
        return result.err

    assert "--blend-mode" in refused(checkout, "--", "python", "mark.py")
    assert "smoe_tn" in refused(checkout, "--blend-mode", "smooth", "--", "python", "mark.py")
    assert "--blend_mode" in refused(patched, "--blend-mode", "smoe", "--", "python", "mark.py")
    assert "--trainer" in refused(unknown, "--blend-mode", "smoe", "--", "python", "mark.py")
    message = refused(unknown, "--blend-mode", "smoe", "--trainer", "3dgs-2022", "--", "python", "mark.py")
    assert all(name in message for name in TRAINERS)
    refused(checkout, "--blend-mode", "smoe")
    assert refused(checkout, "--blend-mode", "smoe", "--", "no_such_command_anywhere")
