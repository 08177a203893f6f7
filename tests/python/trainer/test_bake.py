"""`dsmoe export --bake alpha`: a model of another blend is fine-tuned to alpha."""
from __future__ import annotations

import dataclasses
import math
import os
import re
import shutil
import signal

import pytest
from PIL import Image, ImageOps

from diff_smoe_rasterization import io
from diff_smoe_rasterization.images import as_float
from diff_smoe_rasterization.losses import fused_ssim, l1_ssim_loss
from dsmoe.cli import main
from dsmoe.errors import TrainerError
from dsmoe.export.bake import RisingGate, bake
from dsmoe.inspection import open_renderer
from dsmoe.results.evaluation import evaluate
from dsmoe.results.modelfile import model_path
from dsmoe.scenes.scene import load_scene
from dsmoe.train import train
from dsmoe.training.trainer import Trainer


@pytest.fixture(scope="module")
def smoe_run(tiny_scene, tmp_path_factory):
    """Trained for a second by a small gate, so that alpha shows its Gaussians much darker."""
    from dsmoe.options.config import TrainConfig

    config = TrainConfig(scene=tiny_scene, output=str(tmp_path_factory.mktemp("run") / "out"), blend_mode="smoe",
                         background_gate=0.01, iterations=250, sh_degree=1, sh_degree_interval=100, checkpoint_every=0)
    train(config, progress=False)
    return config


def test_the_gate_rises_by_equal_factors_to_alpha(tiny_config):
    config = dataclasses.replace(tiny_config.changed(background_gate=0.0625), iterations=10)
    strategy = RisingGate(Trainer(config, load_scene(config, progress=False)).strategy.context)
    # 4 of 10 iterations: 1/16 to the powers 3/4, 1/2 and 1/4.
    assert [strategy.gate(iteration) for iteration in (0, 1, 2, 3)] == pytest.approx([1 / 16, 1 / 8, 1 / 4, 1 / 2])
    assert [strategy.gate(iteration) for iteration in (4, 9)] == [1.0, 1.0]


def test_the_end_of_the_rise_is_alpha_by_name(tiny_config):
    """Not in every mode is a gate of 1 the blend of viewers."""
    config = dataclasses.replace(tiny_config.changed(background_gate=0.0625), iterations=10)
    trainer = Trainer(config, load_scene(config, progress=False))
    trainer.strategy = RisingGate(trainer.strategy.context)
    blends = []
    for _ in range(6):
        trainer.step()
        settings = trainer.renderer.settings_of(trainer.scene.train[0].camera)
        blends.append((settings.blend_mode, trainer.renderer.background_gate))
    assert [mode for mode, _ in blends] == ["smoe"] * 3 + ["alpha"] * 3
    assert [gate for _, gate in blends] == pytest.approx([1 / 8, 1 / 4, 1 / 2, 1, 1, 1])


def test_a_baked_model_is_better_in_alpha_than_what_viewers_show(smoe_run, tmp_path, capsys):
    path = str(tmp_path / "baked.ply")
    assert main(["export", smoe_run.output, "-o", path, "--bake", "alpha", "--bake-iterations", "150"]) == 0
    said = capsys.readouterr().out
    trained, shown, baked, change = map(float, re.search(
        r"test PSNR: ([\d.]+) dB in smoe .gate 0.01., ([\d.]+) dB when viewers blend that by alpha, "
        r"([\d.]+) dB baked to alpha \(([-+][\d.]+) dB\)", said).groups())
    assert "viewers of 3DGS" not in said, "what was written is alpha"
    before, after = io.read_gaussians(model_path(smoe_run.output, 250)), io.read_gaussians(path)
    assert (after.blend_mode, after.background_gate) == ("alpha", None)
    assert after.means3D.shape == before.means3D.shape and after.sh_degree == before.sh_degree == 1
    assert baked > shown + 1, "150 iterations of a tiny scene are worth more than a decibel"
    assert change == pytest.approx(baked - trained, abs=0.011)  # each is rounded
    views = load_scene(smoe_run, progress=False).test
    for ply, mode, expected in ((path, "alpha", baked), (model_path(smoe_run.output, 250), "smoe", trained)):
        renderer = open_renderer(smoe_run, ply, mode, "cpu")
        assert evaluate(renderer, views, "cpu", passes=1).metrics["psnr"] == pytest.approx(expected, abs=0.0051)


def test_gaussians_that_cannot_be_shown_are_left_out_and_a_diverging_baking_is_told(smoe_run, monkeypatch):
    renderer = open_renderer(smoe_run, model_path(smoe_run.output, 250), "smoe", "cpu")
    renderer.model.raw["scales"].data[3, 0] = 100.0  # whose exponential is infinite
    count = renderer.model.num_gaussians
    assert bake(smoe_run, renderer, 2, progress=False).renderer.model.num_gaussians == count - 1
    step = Trainer.step

    def diverging_step(self, *arguments):
        done = step(self, *arguments)
        self.model.raw["dc"].data[0] = math.nan
        return done

    monkeypatch.setattr(Trainer, "step", diverging_step)
    with pytest.raises(TrainerError, match="iteration 2: the training has diverged, its `raw/dc` is NaN"):
        bake(smoe_run, renderer, 2, progress=False)


def l2_ssim_loss(image, target, weight, squares):
    error = (image - target).square().mean()
    return (1 - weight) * squares * error + weight * (1 - fused_ssim(image[None], target[None]))


@pytest.mark.parametrize("options, squares", [
    ({"strategy": "3dgs"}, 0), ({"strategy": "importance", "budget": 60}, 30),
    ({"strategy": "importance", "budget": 60, "strategy_options": "squares=5"}, 5)])
def test_the_loss_is_the_one_with_which_the_run_ended(smoe_run, monkeypatch, options, squares):
    """`importance` ends with D-SSIM and so many times the squared error."""
    losses = []
    loss = RisingGate.loss

    def remembered(self, iteration, image, target, *padding):
        value, gradient = loss(self, iteration, image, target, *padding)
        losses.append((value, l2_ssim_loss(image, as_float(target), 0.2, squares) if squares else
                       l1_ssim_loss(image, as_float(target), 0.2)))
        return value, gradient

    monkeypatch.setattr(RisingGate, "loss", remembered)
    config = smoe_run.changed(**{"densify_until_iter": 20, **options})
    bake(config, open_renderer(config, model_path(smoe_run.output, 250), "smoe", "cpu"), 1, progress=False)
    (value, expected), = losses
    assert float(value) == pytest.approx(float(expected), rel=1e-5)  # float32 sums


def test_a_declared_model_begins_as_it_is_blended(smoe_run, tmp_path, monkeypatch, capsys):
    """A .splat records nothing; $DSMOE_FAINT_BELOW is for trainings."""
    splat, begun, step = str(tmp_path / "model.splat"), [], Trainer.step

    def seen(self, *arguments):
        begun.append(self.renderer.settings_of(self.scene.train[0].camera))
        return step(self, *arguments)

    monkeypatch.setenv("DSMOE_FAINT_BELOW", "0.5")
    monkeypatch.setattr(Trainer, "step", seen)
    assert main(["export", smoe_run.output, "-o", splat]) == 0
    for words, faint, name in ((["--paper"], 2, "smoe (gate 0, all pairs)"), (
            ["--blend-mode", "smoe", "--background-gate", "0.01"], 0.25, "smoe (gate 0.01)")):
        assert main(["export", splat, "--bake", "alpha", "--bake-iterations", "5", "--scene", smoe_run.scene, *words,
                     "--overwrite", "-o", str(tmp_path / "baked.ply"), "--device", "cpu"]) == 0
        assert (begun[0].blend_mode, begun[0].faint_below) == ("smoe", faint)
        assert f"dB in {name}, " in capsys.readouterr().out
        begun.clear()


def test_a_mode_without_a_gate_is_baked_in_alpha_alone(smoe_run, tiny_scene, tmp_path, capsys):
    """A .ply with --scene; the ablation has another weight of each Gaussian, and no gate that could rise."""
    ablation, path = str(tmp_path / "ablation.ply"), str(tmp_path / "baked.ply")
    stored = io.read_gaussians(model_path(smoe_run.output, 250))
    io.write_gaussians(ablation, dataclasses.replace(stored, blend_mode="smoe_tn", background_gate=None, comments=()))
    assert main(["export", ablation, "-o", path, "--scene", tiny_scene, "--bake", "alpha", "--bake-iterations",
                 "5"]) == 0
    assert "dB in smoe_tn," in capsys.readouterr().out and io.read_gaussians(path).blend_mode == "alpha"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_an_export_that_is_ended_leaves_nothing(smoe_run, tmp_path, capsys, monkeypatch, request, number):
    """Neither a part of the file nor the baked model, whose folder is temporary."""
    earlier = signal.signal(number, signal.SIG_DFL)  # under nohup it is ignored, and an export goes on
    request.addfinalizer(lambda: signal.signal(number, earlier))
    temporary, output = tmp_path / "temporary", tmp_path / "output"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))

    def write_half(path, gaussians):
        with open(path, "wb") as file:
            file.write(b"ply")
        if os.path.dirname(path) == str(output):
            assert len(list(temporary.iterdir())) == 1
            os.kill(os.getpid(), number)

    monkeypatch.setattr(io, "write_gaussians", write_half)
    monkeypatch.setattr(io, "read_gaussians", lambda path, read=io.read_gaussians: read(
        model_path(smoe_run.output, 250)))
    words = ["export", smoe_run.output, "-o", str(output / "new.ply"), "--bake", "alpha", "--bake-iterations", "1"]
    assert main(words) == 128 + number and "interrupted" in capsys.readouterr().err
    assert not [*temporary.iterdir(), *output.iterdir()]
    assert signal.getsignal(number) == signal.SIG_DFL


def test_a_scene_that_has_changed_since_the_training_is_named(smoe_run, tmp_path, capsys):
    """The decibels would be those of other photographs; of a lone .ply nobody knows the scene."""
    changed = tmp_path / "scene"
    shutil.copytree(smoe_run.scene, changed)
    image = sorted(changed.rglob("*.png"))[0]
    with Image.open(image) as photograph:
        ImageOps.invert(photograph.convert("RGB")).save(image)

    def said(source, scene):
        words = ["--scene", str(scene), "--bake", "alpha", "--bake-iterations", "1", "--overwrite"]
        assert main(["export", source, "-o", str(tmp_path / "a.ply"), *words]) == 0
        return [line for line in capsys.readouterr().err.splitlines() if "scene" in line]

    assert said(smoe_run.output, smoe_run.scene) == said(model_path(smoe_run.output, 250), changed) == []
    note, = said(smoe_run.output, changed)
    assert f"note: {changed} is not the scene that {smoe_run.output} was trained on: checksum of the " in note


def test_what_cannot_be_baked_is_refused(smoe_run, tmp_path, capsys):
    model, path = str(tmp_path / "model.ply"), str(tmp_path / "new.ply")
    stored = dataclasses.replace(io.read_gaussians(model_path(smoe_run.output, 250)), comments=())

    def refused(blend_mode, gate, *arguments):
        io.write_gaussians(model, dataclasses.replace(stored, blend_mode=blend_mode, background_gate=gate))
        assert main(["export", model, "-o", path, "--bake", "alpha", *arguments]) == 1
        return capsys.readouterr().err

    assert "name the scene's folder with --scene" in refused("smoe", 0.01)
    scene = ["--scene", smoe_run.scene]
    assert "blended by alpha already; leave out --bake" in refused("alpha", None, *scene)
    assert "blended by alpha already; leave out --bake" in refused("smoe_eq7", 1.0, *scene)
    assert "--bake-iterations is 0; it must be at least 1" in refused("smoe", 0.01, *scene, "--bake-iterations", "0")
    assert not (tmp_path / "new.ply").exists()
