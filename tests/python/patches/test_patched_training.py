"""Small trainers train, patched and unmodified under `dsmoe run`, to the same bits; the mode goes where it must."""
from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from checkouts import TRAINERS, WITH_RENDER, contents, make_checkout

from diff_smoe_rasterization import BLEND_MODES, patches
from diff_smoe_rasterization.settings import RECOMMENDED_BACKGROUND_GATE

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

MODES = ("alpha", "smoe")


def model(output):
    """{name: array} of the trained model in a folder."""
    path, = Path(output).glob("point_cloud/iteration_*/point_cloud.npz")
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def same_bits(one, other):
    return set(one) == set(other) and all(
        one[name].dtype == other[name].dtype and one[name].shape == other[name].shape
        and one[name].tobytes() == other[name].tobytes() for name in one)


def log(output, result):
    """The lines with losses and PSNR."""
    file = Path(output) / "outputs.log"
    text = file.read_text() if file.exists() else result.out
    return re.findall(r"^.*(?:loss|PSNR|bits) .*$", text, re.MULTILINE)


def pictures(output):
    return {path.relative_to(output).as_posix(): path.read_bytes() for path in sorted(Path(output).rglob("*.png"))}


every_trainer = pytest.mark.parametrize("name", TRAINERS)
with_render = pytest.mark.parametrize("name", WITH_RENDER)


@every_trainer
@pytest.mark.parametrize("mode", MODES)
def test_patched_and_run_train_to_the_same_bits(name, mode, runs):
    made = runs(name)
    logs = [log(made.outputs[kind, mode], made.results[kind, mode]) for kind in ("patched", "plain")]
    assert len(logs[0]) >= 4 and logs[0] == logs[1]
    assert same_bits(model(made.outputs["patched", mode]), model(made.outputs["plain", mode]))


@every_trainer
def test_the_mode_matters_and_gaussians_come_and_go(name, runs):
    made = runs(name)
    alpha, smoe = (model(made.outputs["patched", mode]) for mode in MODES)
    assert not same_bits(alpha, smoe)
    if name == "c3dgs":
        assert len(alpha["_features_dc"]) < len(alpha["_xyz"]), "no codebook is shorter than the model"
    else:
        assert all(len(next(iter(trained.values()))) not in (0, 150) for trained in (alpha, smoe))


@every_trainer
def test_a_run_writes_nothing_into_the_checkout(name, runs):
    assert contents(runs(name).plain) == runs(name).before


@every_trainer
def test_mode_and_gate_are_saved(name, runs):
    for mode, gate in zip(MODES, (None, RECOMMENDED_BACKGROUND_GATE)):
        saved = (runs(name).outputs["patched", mode] / "cfg_args").read_text()
        assert f"blend_mode='{mode}'" in saved and f"background_gate={gate}" in saved


def rendered(runs, name, output, *words, **env):
    """The pictures that render.py of the patched trainer makes of a copy of `output`."""
    copy = shutil.copytree(output, runs.folder / f"copy {runs.processes.count}",
                           ignore=shutil.ignore_patterns("*.png"))
    patched = runs(name).patched

    def finish(job):
        result = job.result()
        assert result.status == 0, result.err
        return pictures(copy)

    job = runs.processes.start(patched / "render.py", "-m", copy, *words, cwd=patched, **env)
    return lambda: finish(job)


@with_render
def test_render_uses_the_saved_mode_or_the_flag_or_alpha(name, runs):
    output = runs(name).outputs["patched", "smoe"]
    old = shutil.copytree(output, runs.folder / f"old {name}")
    text, count = re.subn(r", blend_mode='smoe'|blend_mode='smoe', ", "", (old / "cfg_args").read_text())
    assert count == 1
    (old / "cfg_args").write_text(text)
    jobs = [rendered(runs, name, output), rendered(runs, name, output, "--blend_mode", "smoe"),
            rendered(runs, name, output, "--blend_mode", "alpha"), rendered(runs, name, old)]
    alone, smoe, alpha, without_the_field = (job() for job in jobs)
    assert len(alone) == 4
    assert alone == smoe
    assert without_the_field == alpha
    assert all(smoe[picture] != alpha[picture] for picture in smoe)


def test_render_uses_the_saved_gate_or_the_flag_or_0(runs):
    output = runs("3dgs-2023").outputs["patched", "smoe"]
    old = shutil.copytree(output, runs.folder / "without a gate")
    text, count = re.subn(r", background_gate=[0-9.]+|background_gate=[0-9.]+, ", "", (old / "cfg_args").read_text())
    assert count == 1
    (old / "cfg_args").write_text(text)
    jobs = [rendered(runs, "3dgs-2023", output), rendered(runs, "3dgs-2023", output, "--background_gate", "0"),
            rendered(runs, "3dgs-2023", old, DSMOE_BACKGROUND_GATE=str(RECOMMENDED_BACKGROUND_GATE))]
    alone, eq_7, without_the_field = (job() for job in jobs)
    assert eq_7 == without_the_field and all(alone[picture] != eq_7[picture] for picture in alone)


@pytest.mark.parametrize("name", ["hac", "hac-plus"])
def test_trainers_that_render_at_the_end_use_the_mode(name, runs):
    alpha, smoe = (pictures(runs(name).outputs["patched", mode]) for mode in MODES)
    assert set(alpha) == set(smoe) != set()
    assert all(alpha[picture] != smoe[picture] for picture in alpha)
    assert smoe == pictures(runs(name).outputs["plain", "smoe"])


def refused(result, *words):
    """Whether a process failed with these words, before it read the scene."""
    return result.status != 0 and all(word in result.err for word in words) and "made_up.json" not in result.err


@every_trainer
def test_a_wrong_mode_is_refused_before_anything_is_loaded(name, runs, tmp_path):
    patched = runs(name).patched
    script, *words = runs.script(name, "smoe")
    if name != "c3dgs":
        words[words.index("-s") + 1] = tmp_path / "no scene"
    jobs = [runs.processes.start(patched / script, *words, tmp_path / "out", "--blend_mode", "smooth", cwd=patched)]
    if name == "3dgs-2023":
        jobs.append(runs.processes.start(patched / "render.py", "-m", runs("3dgs-2023").outputs["patched", "smoe"],
                                         "--blend_mode", "smooth", cwd=patched))
    for job in jobs:
        result = job.result()
        assert refused(result, "smooth", *BLEND_MODES) and "loss" not in result.out, result.err
    assert not list(tmp_path.rglob("point_cloud*"))


@every_trainer
def test_help_shows_the_flag(name, runs):
    patched = runs(name).patched
    help = runs.processes.run(patched / runs.script(name, "smoe")[0], "--help", cwd=patched)
    assert help.status == 0 and "--blend_mode" in help.out and "--background_gate" in help.out
    assert re.search(r"--feat_dim|--data_device", help.out), "the other options of the group"


def test_the_environment_gives_the_default(runs, tmp_path):
    patched = runs("3dgs-2024").patched
    words = [patched / "train.py", "-s", runs.scene, "--quiet", "-m"]
    jobs = [runs.processes.start(*words, tmp_path / "default", cwd=patched, DSMOE_BLEND_MODE="smoe"),
            runs.processes.start(*words, tmp_path / "flag", "--blend_mode", "alpha", cwd=patched,
                                 DSMOE_BLEND_MODE="smoe", DSMOE_BACKGROUND_GATE="0.5"),
            runs.processes.start(*words, tmp_path / "none", cwd=patched),
            runs.processes.start(*words, tmp_path / "wrong", cwd=patched, DSMOE_BLEND_MODE="smooth"),
            runs.processes.start(*words, tmp_path / "wrong", "--blend_mode", "smoe", "--background_gate", "-1",
                                 cwd=patched)]
    default, flag, none, wrong, wrong_gate = (job.result() for job in jobs)
    assert default.status == flag.status == none.status == 0, default.err + flag.err + none.err
    assert "blend_mode='smoe'" in (tmp_path / "default" / "cfg_args").read_text()
    for folder in ("flag", "none"):
        assert "blend_mode='alpha'" in (tmp_path / folder / "cfg_args").read_text()
        assert same_bits(model(tmp_path / folder), model(runs("3dgs-2024").outputs["patched", "alpha"]))
    assert same_bits(model(tmp_path / "default"), model(runs("3dgs-2024").outputs["patched", "smoe"]))
    assert refused(wrong, *BLEND_MODES), wrong.err
    assert refused(wrong_gate, "background_gate is '-1'; it must be a number"), wrong_gate.err


@pytest.mark.parametrize("name, words", [
    ("3dgs-2024", ["--optimizer_type", "sparse_adam", "--antialiasing", "--train_test_exp"]),
    ("3dgs-2023", ["--compute_cov3D_python", "--random_background"]),
    ("taming", ["--optimizer_type", "sparse_adam", "--mode", "final_count", "--budget", "300"])])
def test_other_ways_of_training_learn_too(name, words, runs, tmp_path):
    patched = runs(name).patched
    result = runs.processes.run(patched / "train.py", "-s", runs.scene, "-m", tmp_path / "out", "--blend_mode", "smoe",
                                *words, cwd=patched)
    assert result.status == 0, result.err
    plain = runs(name)
    losses, plain_losses = (re.findall(r"loss (\S+)", text) for text in (result.out,
                                                                         plain.results["patched", "smoe"].out))
    assert len(losses) == len(plain_losses) == 7 and losses != plain_losses
    assert not same_bits(model(tmp_path / "out"), model(plain.outputs["patched", "smoe"]))


@pytest.mark.parametrize("name", ["hac-plus", "c3dgs"])
def test_a_modernised_trainer_trains_as_before(name, runs, tmp_path):
    checkout = make_checkout(name, tmp_path / "modern")
    patches.apply(checkout, modernise=True)
    script, *words = runs.script(name, "smoe")
    result = runs.processes.run(checkout / script, *words, tmp_path / "out", "--blend_mode", "smoe", cwd=checkout)
    assert result.status == 0, result.err
    assert same_bits(model(tmp_path / "out"), model(runs(name).outputs["patched", "smoe"]))


def test_a_trainer_whose_ssim_is_its_own_trains_as_before(runs, tmp_path):
    """That of the small trainer has boxes for windows; its Adam is its own too."""
    checkout = make_checkout("3dgs-2023", tmp_path / "fused")
    planned = patches.apply(checkout, fuse=True)
    assert [rule.files for rule in planned.requested] == [("utils/loss_utils.py",), ()]
    script, *words = runs.script("3dgs-2023", "smoe")
    result = runs.processes.run(checkout / script, *words, tmp_path / "out", "--blend_mode", "smoe", cwd=checkout)
    assert result.status == 0, result.err
    assert "utils.loss_utils.ssim is not SSIM as it is fused here" in result.err
    assert same_bits(model(tmp_path / "out"), model(runs("3dgs-2023").outputs["patched", "smoe"]))


def test_scripts_that_build_commands_pass_the_mode_on(runs, tmp_path):
    evaluation, shell = make_checkout("3dgs-2023", tmp_path / "2023"), make_checkout("hac", tmp_path / "hac")
    for checkout in (evaluation, shell):
        patches.apply(checkout)
    shutil.copytree(runs.scene, shell / "data" / "db" / "chairs")
    jobs = [runs.processes.start(evaluation / "full_eval.py", "-mu", runs.scene.parent, "--output_path",
                                 tmp_path / "eval", cwd=evaluation, DSMOE_BLEND_MODE="smoe"),
            runs.processes.start(shell / "run_shell_db.py", cwd=shell, DSMOE_BLEND_MODE="smoe")]
    for job in jobs:
        assert job.result().status == 0, job.result().err
    trained = tmp_path / "eval" / runs.scene.name
    assert same_bits(model(trained), model(runs("3dgs-2023").outputs["patched", "smoe"]))
    assert pictures(trained) == rendered(runs, "3dgs-2023", trained, "--skip_train", "--blend_mode", "smoe")() != {}
    assert "blend_mode='smoe'" in (shell / "outputs" / "db" / "chairs" / "0.004" / "cfg_args").read_text()
