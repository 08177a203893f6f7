"""`dsmoe run`: an unmodified trainer, and what it starts, with this rasterizer; and what it refuses."""
from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from checkouts import TRAINERS, contents, make_checkout

from diff_smoe_rasterization import patches


@pytest.fixture
def run(processes):
    """Starts `dsmoe run` with these words in a folder."""
    return lambda *words, cwd, **env: processes.dsmoe("run", *words, cwd=cwd, **env)


def test_child_processes_have_the_rasterizer_too(scene, run, tmp_path):
    evaluation, shell = make_checkout("3dgs-2023", tmp_path / "2023"), make_checkout("hac-plus", tmp_path / "hac")
    shutil.copytree(scene, shell / "data" / "db" / "chairs")
    before = contents(evaluation)
    # A mode in the environment gives way to the one that is asked for.
    jobs = [run("--blend-mode", "smoe", "--", "python", "full_eval.py", "-mu", scene.parent, "--output_path",
                tmp_path / "eval", cwd=evaluation, DSMOE_BLEND_MODE="alpha"),
            run("--blend-mode", "alpha", "--", "python", "train.py", "-s", scene, "-m", tmp_path / "eval" / "alpha",
                "--quiet", cwd=evaluation),
            run("--blend-mode", "smoe", "--", "python", "run_shell_db.py", cwd=shell)]
    for job in jobs:
        assert job.result().status == 0, job.result().err
    assert contents(evaluation) == before
    assert len(list((tmp_path / "eval" / scene.name).rglob("*.png"))) == 1
    clouds = [(tmp_path / "eval" / name / "point_cloud" / "iteration_7" / "point_cloud.npz").read_bytes()
              for name in (scene.name, "alpha")]
    assert clouds[0] != clouds[1]
    assert (shell / "outputs" / "db" / "chairs" / "0.004" / "point_cloud").is_dir()


def test_the_exit_status_is_passed_on(run, tmp_path):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    (checkout / "leave.py").write_text("import sys\nsys.exit(int(sys.argv[1]))\n")
    jobs = [run("--blend-mode", "smoe", "--", "python", "leave.py", str(status), cwd=checkout) for status in (0, 7)]
    assert [job.result().status for job in jobs] == [0, 7]


def test_arguments_reach_the_command_as_they_are(run, tmp_path):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    (checkout / "tell.py").write_text("import sys\nprint(sys.argv[1:])\n")
    words = ["--blend_mode", "a b", "--", "*", "--help", ""]
    result = run("--blend-mode", "smoe", "--", "python", "tell.py", *words, cwd=checkout).result()
    assert result.status == 0 and result.out.strip() == str(words)


def test_any_command_runs_for_a_trainer_that_is_named(run, tmp_path):
    code = "import diff_gaussian_rasterization as d; print(d.GaussianRasterizer, hasattr(d, 'SparseGaussianAdam'))"
    jobs = {name: run("--blend-mode", "smoe", "--trainer", name, "--", "python", "-c", code, cwd=tmp_path)
            for name in ("3dgs-2023", "3dgs-2024")}
    for name, job in jobs.items():
        assert job.result().status == 0, job.result().err
        assert job.result().out.split()[-1] == str(name == "3dgs-2024")
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
