"""`dsmoe simplify` and `dsmoe train --init`: a trained model as the start of a training."""
from __future__ import annotations

import dataclasses
import json
import os
import shlex
import shutil
import signal
import struct

import numpy as np
import pytest
import torch
from PIL import Image

from diff_smoe_rasterization import io
from diff_smoe_rasterization.settings import BLEND_MODES
from dsmoe import simplify as module
from dsmoe.cli import main
from dsmoe.distributed.trainer import new_trainer
from dsmoe.errors import ConfigError, TrainerError
from dsmoe.inspection import open_renderer
from dsmoe.model import GaussianModel
from dsmoe.options.config import TrainConfig
from dsmoe.results.evaluation import evaluate
from dsmoe.results.glb import glb_bytes
from dsmoe.results.metrics import quantised
from dsmoe.results.modelfile import load_model, model_path
from dsmoe.results.shown import raw_of
from dsmoe.scenes.colmap import read_colmap_layout
from dsmoe.scenes.lens import Lens
from dsmoe.scenes.scene import load_scene, read_layout
from dsmoe.simplify import simplify
from dsmoe.starting import blend_options, check_start, find_model, read_start, start_renderer
from dsmoe.train import train
from dsmoe.training.forecast import Forecast
from dsmoe.training.importance_strategy import ImportanceStrategy
from dsmoe.training.trainer import Trainer

SHORT = {"iterations": 60, "progress": False}


@pytest.fixture(scope="module")
def run(tiny_scene, tmp_path_factory):
    """A run by alpha, of SH degree 1, at another resolution than a scene has by default."""
    config = TrainConfig(scene=tiny_scene, output=str(tmp_path_factory.mktemp("run") / "out"), blend_mode="alpha",
                         iterations=250, sh_degree=1, sh_degree_interval=50, checkpoint_every=0, resolution=30,
                         strategy="steady", densify_from_iter=20, densify_until_iter=200, densification_interval=20)
    train(config, progress=False)
    return config


def ply_of(config):
    return model_path(config.output, config.iterations)


def results_of(output):
    with open(os.path.join(output, "results.json"), encoding="utf-8") as file:
        return json.load(file)


def model_folder(run, folder, cfg_args=None, cameras=True):
    """What 3DGS writes: the last of two models, cfg_args and cameras.json, by its own definition of these."""
    for iteration in (7, 30):
        path = model_path(str(folder), iteration)
        os.makedirs(os.path.dirname(path))
        shutil.copyfile(ply_of(run), path)
    stored = io.read_gaussians(path)
    io.write_gaussians(path, dataclasses.replace(stored, blend_mode=None, comments=()))
    if cfg_args is not None:
        (folder / "cfg_args").write_text(cfg_args)
    if cameras:
        entries = []
        for index, view in enumerate(load_scene(run, progress=False).train):
            camera = view.camera
            entries.append({"id": index, "img_name": camera.name, "width": camera.width, "height": camera.height,
                            "position": (-camera.rotation.T @ camera.translation).tolist(),
                            "rotation": camera.rotation.T.tolist(), "fx": camera.fx, "fy": camera.fy})
        (folder / "cameras.json").write_text(json.dumps(entries))
    return str(folder)


def test_a_run_becomes_one_of_fewer_gaussians(run, tmp_path, capsys):
    before = open(ply_of(run), "rb").read()
    output = str(tmp_path / "out")
    assert main(["simplify", run.output, "--keep", "0.5", "-o", output, "--iterations", "60", "--quiet"]) == 0
    said = capsys.readouterr().out
    trained, = results_of(run.output)
    row, = results_of(output)
    model, recorded = load_model(model_path(output, 60), "cpu")
    assert row["num_gaussians"] == model.num_gaussians == round(0.5 * trained["num_gaussians"])
    assert (row["blend_mode"], recorded.blend_mode, model.sh_degree) == ("alpha", "alpha", 1)
    for name in ("psnr", "ssim", "num_gaussians"):  # as the training measured them
        assert row["start"][name] == pytest.approx(trained[name], rel=1e-6)
    assert row["protocol"]["resolution"] == 30 and row["protocol"]["init"] == "point_cloud.ply"
    assert f"{trained['num_gaussians']:,} Gaussians of SH degree 1, blend mode alpha" in said
    assert f"export {output} -o model.spz" in said
    assert open(ply_of(run), "rb").read() == before, "the model itself stays"


def test_it_is_better_than_only_leaving_gaussians_out(run, tmp_path):
    row = simplify(run.output, str(tmp_path / "out"), keep=0.3, **SHORT)
    start = io.read_gaussians(ply_of(run))
    opacities = start.opacity_logits[:, 0]
    kept = np.sort(np.argsort(-opacities)[:row["num_gaussians"]])  # the usual rule: the most opaque stay
    model = GaussianModel.from_gaussians({name: rows[kept] for name, rows in raw_of(start).items()}, 1)
    left = open_renderer(run, ply_of(run), None, "cpu").of(model, 1.0)
    trained = open_renderer(run, model_path(str(tmp_path / "out"), 60), None, "cpu")
    views = load_scene(run, progress=False).train
    before, after = (evaluate(renderer, views, "cpu", passes=1).metrics["psnr"] for renderer in (left, trained))
    assert after > before + 1, "60 steps that know the images are worth more than a decibel"


def test_removals_begin_at_once_and_nothing_grows(run):
    config = run.changed(init=ply_of(run), strategy="importance", budget=20, densify_until_iter=200,
                         densify_from_iter=0, densification_interval=10)
    scene = load_scene(config, progress=False)
    assert Forecast(config, scene).text(10, 2000.0) == (
        "at this speed the other 10 iterations take about 33 min, less and less as Gaussians are removed")
    count = len(scene.points.positions)
    for budget, words in ((count, " about 33 min"), (count + 1, "longer as Gaussians are added")):
        assert Forecast(config.changed(budget=budget), scene).text(10, 2000.0).partition(". A GPU")[0].endswith(words)
    strategy = Trainer(config, scene).strategy
    assert isinstance(strategy, ImportanceStrategy)
    assert strategy.removals[0] == 4 and strategy.growth_ends == 0, "2 % of 200"
    assert strategy.most() == len(scene.points.positions)
    grows = Trainer(config.changed(budget=10 * len(scene.points.positions)), scene).strategy  # above the model's number
    assert grows.growth_ends == 107 and grows.removals[0] == 109, "8 / 15 and 8.2 / 15"


def test_what_no_view_needs_goes_first(run):
    """As far as the budget allows."""
    scene = load_scene(run.changed(init=ply_of(run)), progress=False)
    gaussians = scene.start.gaussians
    means = gaussians.means3D.copy()
    hidden = np.array([1, 5, 8])
    means[hidden] = [0, 1000, 0]  # above all cameras, which look down
    scene = scene.starting_with(dataclasses.replace(scene.start, gaussians=dataclasses.replace(
        gaussians, means3D=means)))
    count = len(means)
    for budget, left in ((20, 0), (count, 3)):
        config = run.changed(init=ply_of(run), strategy="importance", budget=budget, densify_until_iter=200)
        trainer = Trainer(config, scene)
        trainer.step()
        assert int((trainer.model.raw["means3D"][:, 1] > 900).sum()) == left
        assert budget <= trainer.num_gaussians <= count - 3 + left


def test_a_large_batch_removes_to_the_budget_from_a_model(run):
    """All removals fall into the first step, in which also goes what no view needs."""
    config = run.changed(init=ply_of(run), strategy="importance", budget=20, iterations=128, batch=64,
                         densify_until_iter=45)
    trainer = new_trainer(config, load_scene(config, progress=False))
    assert max(trainer.strategy.removals) <= 64 and trainer.num_gaussians > 20
    trainer.step()
    assert trainer.num_gaussians == 20


def test_alpha_becomes_smoe_and_a_smoe_model_keeps_its_gate(run, tmp_path, capsys):
    row = simplify(run.output, str(tmp_path / "smoe"), keep=0.5, blend_mode="smoe", **SHORT)
    assert (row["blend_mode"], row["start"]["blend_mode"]) == ("smoe", "alpha")
    assert row["start"]["psnr"] == pytest.approx(results_of(run.output)[0]["psnr"], rel=1e-6)
    config = TrainConfig.load(str(tmp_path / "smoe"))
    stored = dataclasses.replace(io.read_gaussians(ply_of(config)), background_gate=0.375, comments=())
    ply = str(tmp_path / "smoe.ply")
    io.write_gaussians(ply, stored)
    for words in (["train", run.scene, "--init", ply], ["simplify", ply, "--scene", run.scene, "--budget", "30"]):
        output = str(tmp_path / words[0])
        assert main([*words, "-o", output, "--iterations", "4", "--resolution", "30", "--quiet"]) == 0
        config = TrainConfig.load(output)
        assert (config.blend_mode, config.background_gate, config.background_gate_start) == ("smoe", "learned", 0.375)
    assert f"export {output} --bake alpha -o model.spz" in capsys.readouterr().out, "viewers of .spz blend by alpha"
    assert main(["simplify", ply, "--scene", run.scene, "--budget", "30", "-o", str(tmp_path / "no"), "--blend-mode",
                 "alpha"]) == 1
    assert "dsmoe export OUT --bake alpha" in capsys.readouterr().err


@pytest.mark.parametrize("recorded", ["alpha", None])
def test_a_model_becomes_one_of_the_authors_program(run, tmp_path, capsys, recorded):
    """--paper is of what is made: smoe, gate 0, all pairs. What it is made of is alpha, and the command says why."""
    ply, output = str(tmp_path / "model.ply"), str(tmp_path / "paper")
    io.write_gaussians(ply, dataclasses.replace(io.read_gaussians(ply_of(run)), blend_mode=recorded, comments=()))
    words = ["--iterations", "4", "--resolution", "30", "--quiet", "--device", "cpu"]
    simplifies = ["simplify", ply, "--scene", run.scene, "--budget", "40", *words]
    assert main([*simplifies, "-o", output, "--paper"]) == 0
    said = capsys.readouterr().out
    row, = results_of(output)
    assert (row["blend_mode"], row["background_gate"], row["protocol"]["faint_below"]) == ("smoe", 0, 2)
    assert row["start"]["blend_mode"] == "alpha" and load_model(model_path(output, 4), "cpu")[1] == ("smoe", 0, 2)
    assert main(["train", run.scene, "--init", ply, "-o", str(tmp_path / "trained"), *words]) == 0
    for text in (said, capsys.readouterr().out):
        assert "blend mode alpha" in text
        assert (f"(not recorded; `dsmoe export {ply} --paper -o declared" in text) == (recorded is None)
    for other in (["--blend-mode", "alpha"], ["--background-gate", "1"], ["--faint-below", "0.25"]):
        assert main([*simplifies, "-o", str(tmp_path / "no"), "--paper", *other]) == 1
        assert f"{other[0]} is " in capsys.readouterr().err and not (tmp_path / "no").exists()


def test_a_gate_of_0_stays_and_another_blend_is_told(run, tmp_path, capsys):
    """--blend-mode smoe learns a gate by default; one that a model records as the paper's stays 0."""
    stored = dataclasses.replace(io.read_gaussians(ply_of(run)), blend_mode="smoe", comments=())
    words = ["--iterations", "4", "--resolution", "30", "--quiet", "--device", "cpu"]

    def trained(gate, command, name, *more):
        ply, output = str(tmp_path / "model.ply"), str(tmp_path / name)
        io.write_gaussians(ply, dataclasses.replace(
            stored, background_gate=gate, comments=("faint_below 2",) if gate == 0 else ()))
        start = ["train", run.scene, "--init", ply] if command == "train" else [
            "simplify", ply, "--scene", run.scene, "--budget", "40"]
        assert main([*start, *words, "-o", output, *more]) == 0
        return load_model(model_path(output, 4), "cpu")[1], capsys.readouterr().out

    for command in ("simplify", "train"):
        blend, said = trained(0.0, command, command)
        assert blend == ("smoe", 0, 2) and "note: the model is blended" not in said
        blend, said = trained(0.0059, command, command + "_paper", "--paper")
        assert blend == ("smoe", 0, 2)
        assert ("note: the model is blended by smoe (gate 0.0059, faint below 0.25), and the result will be by smoe "
                "(gate 0, all pairs)\n") in said
    for more in (["--background-gate", "learned"], ["--background-gate-start", "0.1"]):
        assert trained(0.0, "train", "_".join(more), *more)[0].background_gate > 0, "asked for"


def test_without_photographs_a_model_is_its_own_teacher(run, tmp_path, capsys):
    (tmp_path / "model").mkdir()
    folder = model_folder(run, tmp_path / "model", "Namespace(source_path='/nowhere', eval=True, resolution=-1)")
    config = TrainConfig(scene=folder, blend_mode="alpha", test_every=0)
    scene = load_scene(config, progress=False)
    renderer = open_renderer(run, ply_of(run), None, "cpu")
    photographs = load_scene(run, progress=False).train
    assert [view.camera.name for view in scene.train] == [view.camera.name for view in photographs]
    for view, photograph in zip(scene.train, photographs):
        assert (view.camera.width, view.camera.height) == (photograph.camera.width, photograph.camera.height)
        with torch.no_grad():
            shown = renderer(photograph.camera.centred()).color
        assert (view.image_float() - quantised(shown)).abs().max() <= 1 / 255 + 1e-6, "cameras.json has 64-bit numbers"
    output = str(tmp_path / "out")
    assert main(["simplify", folder, "--budget", "40", "-o", output, "--iterations", "60", "--quiet"]) == 0
    row, = results_of(output)
    assert (row["num_gaussians"], row["protocol"]["scene_kind"], row["protocol"]["test_views"]) == (40, "model", 1)
    said = capsys.readouterr().out
    assert "measured against renderings of the model" in said and "inf" not in said and row["start"]["psnr"] is None
    assert "the scene that its folder names, /nowhere, is not there" in said
    assert main(["eval", output, "--device", "cpu"]) == 0, "what was trained on can be made again"
    assert main(["simplify", folder, "--loses", "1", "-o", str(tmp_path / "no")]) == 1
    assert "--loses compares with photographs" in capsys.readouterr().err and not (tmp_path / "no").exists()


def test_a_run_whose_scene_is_gone_is_its_own_teacher(run, tmp_path):
    """By the cameras.json that it has written: sizes and principal points are those of its images."""
    scene = shifted_scene(run.scene, str(tmp_path / "scene"), 1.5)
    config = run.changed(scene=scene, init=ply_of(run), iterations=4, densify_until_iter=0,
                         output=str(tmp_path / "run"))
    train(config, progress=False)
    photographs = load_scene(config, progress=False)
    shutil.rmtree(scene)
    row = simplify(config.output, str(tmp_path / "out"), budget=40, **SHORT)
    assert (row["protocol"]["scene_kind"], row["protocol"]["image_size"]) == ("model", [30, 22])
    rendered = load_scene(TrainConfig.load(str(tmp_path / "out")), progress=False)
    for mine, theirs in ((rendered.train, photographs.train), (rendered.test, photographs.test)):
        assert [view.camera.name for view in mine] == [view.camera.name for view in theirs]
        for view, photograph in zip(mine, theirs):
            for name in ("fx", "fy", "cx", "cy", "width", "height"):
                assert getattr(view.camera, name) == getattr(photograph.camera, name)
            assert np.allclose(view.camera.rotation, photograph.camera.rotation, atol=1e-12)
            assert np.allclose(view.camera.translation, photograph.camera.translation, atol=1e-12)


def test_a_scene_without_its_photographs_leaves_the_models_renderings(run, tmp_path, capsys):
    scene = str(tmp_path / "scene")
    shutil.copytree(run.scene, scene)
    shutil.rmtree(os.path.join(scene, "images"))
    (tmp_path / "model").mkdir()
    folder = model_folder(run, tmp_path / "model", f"Namespace(eval=False, source_path={scene!r})")
    words = ["simplify", folder, "--budget", "40", "-o", str(tmp_path / "out"), "--iterations", "8", "--device", "cpu"]
    assert main(words) == 1
    text = capsys.readouterr().err
    assert "no such folder of images" in text and f"--scene {folder} takes the model's renderings" in text
    assert not (tmp_path / "out").exists() and main([*words, "--scene", folder]) == 0
    said, row = capsys.readouterr().out, results_of(str(tmp_path / "out"))[0]
    assert f"the training views have {row['psnr_train']:.2f} dB\n" in said and row["start"]["psnr"] is None


def test_a_run_is_its_own_teacher_at_the_size_of_its_images_if_asked(run, tmp_path):
    """Its cameras.json has those; dividing them again would be wrong."""
    shutil.copytree(run.output, tmp_path / "run")
    TrainConfig.load(run.output).changed(resolution=2, output=str(tmp_path / "run")).save(str(tmp_path / "run"))
    row = simplify(str(tmp_path / "run"), str(tmp_path / "out"), scene=str(tmp_path / "run"), budget=40, **SHORT)
    assert (row["protocol"]["scene_kind"], row["protocol"]["image_size"]) == ("model", [30, 22])


def test_a_run_knows_how_its_scene_is_loaded_wherever_that_lies(run, tmp_path):
    scene, moved = str(tmp_path / "scene"), str(tmp_path / "moved")
    shutil.copytree(run.scene, scene)
    config = run.changed(scene=scene, init=ply_of(run), iterations=4, densify_until_iter=0, principal_point="centre",
                         output=str(tmp_path / "run"))
    train(config, progress=False)
    os.rename(scene, moved)
    row = simplify(config.output, str(tmp_path / "out"), scene=moved, budget=40, **SHORT)
    assert (row["protocol"]["scene_kind"], row["protocol"]["resolution"]) == ("colmap", 30)
    assert row["protocol"]["principal_point"] == "centre"


def test_a_model_in_the_folder_to_write_is_refused(run, tmp_path, capsys):
    """--overwrite would remove it."""
    copy = str(tmp_path / "run")
    shutil.copytree(run.output, copy)
    before = sorted(path for path, _, _ in os.walk(copy))
    for words in (["simplify", copy, "--budget", "40"], ["simplify", model_path(copy, 250), "--scene", run.scene,
                                                         "--budget", "40"], ["train", run.scene, "--init", copy]):
        assert main([*words, "-o", copy, "--overwrite", "--device", "cpu"]) == 1
        text = capsys.readouterr().err
        assert text.count("\n") == 1 and "lies in" in text and "choose another folder with -o" in text
    assert sorted(path for path, _, _ in os.walk(copy)) == before and os.path.isfile(model_path(copy, 250))


def test_what_a_model_says_of_faint_pairs_is_kept(run, tmp_path, capsys):
    ply, output = str(tmp_path / "paper.ply"), str(tmp_path / "out")
    stored = dataclasses.replace(io.read_gaussians(ply_of(run)), blend_mode="smoe", background_gate=1.0,
                                 comments=("faint_below 2",))
    io.write_gaussians(ply, stored)
    assert main(["simplify", ply, "--scene", run.scene, "--budget", "40", "-o", output, "--iterations", "4",
                 "--resolution", "30", "--quiet"]) == 0
    assert TrainConfig.load(output).faint_below == 2
    assert capsys.readouterr().out.count("all pairs") == 2, "the model and the result"
    assert main(["eval", output, "--device", "cpu"]) == 0
    assert results_of(output)[0]["start"]["protocol"] == {"faint_below": 2}, "measured anew it is kept"


def test_a_model_that_says_nothing_of_faint_pairs_has_the_usual_rule(run, tmp_path, monkeypatch):
    monkeypatch.setenv("DSMOE_FAINT_BELOW", "2")
    ply = str(tmp_path / "smoe.ply")
    io.write_gaussians(ply, dataclasses.replace(io.read_gaussians(ply_of(run)), blend_mode="smoe", background_gate=1.0,
                                                comments=()))
    start = read_start(ply)
    camera = load_scene(run, progress=False).train[0].camera
    for renderer in (start_renderer(start, run), open_renderer(run, ply, None, "cpu")):
        assert renderer.settings_of(camera).faint_below == 0.25
    assert blend_options(start, {})["faint_below"] == 0.25 and blend_options(start, {"faint_below": 1.0})[
        "faint_below"] == 1.0, "what is typed"
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.5")
    config = TrainConfig(scene="scene", output="out", **blend_options(start, {}))
    assert (config.background_gate, config.background_gate_start) == ("learned", 1.0)


def test_a_model_folder_says_where_and_how_it_was_trained(run, tmp_path):
    (tmp_path / "model").mkdir()
    text = (f"Namespace(sh_degree=3, source_path={run.scene!r}, model_path='x', images='images', resolution=30, "
            "white_background=False, eval=False, depths='', antialiasing=False, thing=<object at 0x7f>)")
    folder = model_folder(run, tmp_path / "model", text)
    found = find_model(folder)
    assert found.path == model_path(folder, 30)
    assert found.options == {"scene": run.scene, "images": "images", "resolution": 30, "white_background": False,
                             "antialiasing": False, "test_every": 0}
    row = simplify(folder, str(tmp_path / "out"), budget=40, **SHORT)
    assert row["protocol"]["scene_kind"] == "colmap" and row["psnr"] is None, "it had trained on all images"


def shifted_scene(scene, folder, pixels):
    """The scene with principal points so far from the centre."""
    shutil.copytree(scene, folder)
    model = io.read_colmap(folder)
    cameras = {number: dataclasses.replace(camera, params=camera.params + np.array([0, 0, pixels, 0]))
               for number, camera in model.cameras.items()}
    io.write_colmap(model.folder, dataclasses.replace(model, cameras=cameras), text=True)
    return folder


def test_where_the_models_program_had_its_principal_points_is_seen(run, tmp_path, capsys):
    scene = shifted_scene(run.scene, str(tmp_path / "scene"), 4.0)
    assert read_colmap_layout(scene, run).train[0].camera.cx == 20
    words = [ply_of(run), "--scene", scene, "--budget", "40", "--iterations", "20", "--resolution", "30", "--quiet"]
    assert main(["simplify", *words, "-o", str(tmp_path / "out")]) == 0
    assert TrainConfig.load(str(tmp_path / "out")).principal_point == "centre"
    assert "with principal points in their centres, which are taken" in capsys.readouterr().out
    assert main(["simplify", *words, "-o", str(tmp_path / "out"), "--resume"]) == 0
    assert main(["simplify", *words, "-o", str(tmp_path / "asked"), "--principal-point", "scene"]) == 0
    assert TrainConfig.load(str(tmp_path / "asked")).principal_point == "scene"
    (tmp_path / "model").mkdir()
    folder = model_folder(run, tmp_path / "model", f"Namespace(source_path={scene!r}, resolution=30, eval=True)")
    assert simplify(folder, str(tmp_path / "3dgs"), budget=40, iterations=4, progress=False)["protocol"][
        "principal_point"] == "centre"
    capsys.readouterr()
    assert main(["train", scene, "--init", ply_of(run), "-o", str(tmp_path / "init"), "--iterations", "2",
                 "--resolution", "30", "--quiet"]) == 0
    assert "note: with --principal-point centre it has" in capsys.readouterr().out


def test_the_fewest_that_lose_no_more(run, tmp_path, monkeypatch):
    count = results_of(run.output)[0]["num_gaussians"]
    tried = []

    class Measured:
        def __init__(self, number):
            self.metrics, self.fps = {"psnr": 30 - 10 * (1 - number / count), "ssim": 1.0}, None

    def figures(renderer, views, device, passes=5):
        return Measured(renderer.model.num_gaussians)

    def trained(config, *arguments, **options):
        tried.append(config.budget)
        return train(config, *arguments, **options)

    monkeypatch.setattr(module, "evaluate", figures)
    monkeypatch.setattr(module, "train", trained)
    output = str(tmp_path / "out")
    row = simplify(run.output, output, loses=5.0, iterations=4, progress=False)
    assert tried == sorted(tried) and row["num_gaussians"] == tried[-1] == results_of(output)[0]["num_gaussians"]
    assert 0.5 * count <= tried[-1] < 0.5 * 1.5 * count, "half of them lose 5 dB; numbers grow by a half"
    assert tried[-2] < 0.5 * count and row["start"]["psnr"] == 30
    begun = tried[-2]
    tried.clear()
    train(TrainConfig.load(output).changed(budget=begun, iterations=4), overwrite=True, progress=False)
    assert simplify(run.output, output, loses=5.0, iterations=4, progress=False, resume=True) == {
        **row, "train_seconds": pytest.approx(0, abs=60), "fps": pytest.approx(0, abs=1e6)}
    assert tried[0] == begun, "a resumed search goes on where it was"


def test_a_gain_on_the_training_views_is_said_as_one(run, tmp_path, monkeypatch):
    count, said = results_of(run.output)[0]["num_gaussians"], []

    def figures(renderer, views, device, passes=5):
        psnr = 30.0 if renderer.model.num_gaussians == count else 31.25
        return type("Measured", (), {"metrics": {"psnr": psnr, "ssim": 1.0}, "fps": None})

    monkeypatch.setattr(module, "evaluate", figures)
    simplify(run.output, str(tmp_path / "out"), loses=0.0, iterations=4, progress=False, say=said.append)
    assert said[-1].endswith("31.25 dB on the training images, 1.25 dB more than the model")


@pytest.mark.parametrize("options, words", [
    ({}, "give one of --budget N, --keep PART and --loses DB"),
    ({"budget": 5, "keep": 0.5}, "give one of"),
    ({"budget": 10**6}, "--budget is 1000000; it must be at most"),
    ({"budget": 3}, "--budget is 3; it must be at least 4"),
    ({"budget": 0}, "--budget is 0; it must be at least 4"),
    ({"keep": 0.0}, "--keep is 0.0; it must be above 0 and at most 1"),
    ({"keep": 1.5}, "--keep is 1.5"),
    ({"loses": -1.0}, "--loses is -1.0; it must be at least 0"),
    ({"budget": 40, "iterations": 1}, "--iterations is 1; it must be a whole number of at least 4"),
    ({"budget": 40, "scene": "/nowhere"}, "scene /nowhere: no such folder"),
])
def test_bad_input_is_told_and_nothing_is_written(run, tmp_path, options, words):
    with pytest.raises((ConfigError, TrainerError)) as error:
        simplify(run.output, str(tmp_path / "out"), progress=False, **options)
    assert words in str(error.value) and not (tmp_path / "out").exists()


def test_bad_models_are_told_and_nothing_is_written(run, tmp_path, capsys):
    output, ply = str(tmp_path / "out"), str(tmp_path / "my model.ply")
    stored = io.read_gaussians(ply_of(run))

    def fails(model, *words):
        for command in (["simplify", model, "--budget", "40"], ["train", run.scene, "--init", model]):
            given = [word for word in words if command[0] == "simplify" or word not in ("--scene", run.scene)]
            assert main([*command, "-o", output, *given, "--device", "cpu"]) == 1
            text = capsys.readouterr().err
            assert text.count("\n") == 1 and not os.path.exists(output)
        return text

    scene = ["--scene", run.scene]
    assert "no such file or folder; name a .ply, .splat, .spz or .glb" in fails(str(tmp_path / "no.ply"), *scene)
    assert "no model is in it: neither config.json" in fails(str(tmp_path))
    logits = stored.opacity_logits.copy()
    logits[0], logits[4] = np.nan, np.inf
    io.write_gaussians(ply, dataclasses.replace(stored, opacity_logits=logits))
    assert (f"2 of its {len(logits):,} Gaussians have a number that is NaN or infinite; `dsmoe export '{ply}' -o "
            "clean.glb`") in fails(ply, *scene)
    arrays = ("means3D", "dc", "shs", "opacity_logits", "log_scales", "rotations")
    io.write_gaussians(ply, dataclasses.replace(stored, **{name: getattr(stored, name)[:0] for name in arrays}))
    assert "my model.ply: it holds no Gaussians; name a model that has some\n" in fails(ply, *scene)
    io.write_gaussians(ply, stored)
    assert main(["simplify", ply, *scene, "--budget", "100000", "-o", output, "--device", "cpu"]) == 1
    assert f"--init '{ply}'`" in capsys.readouterr().err
    io.write_gaussians(ply, dataclasses.replace(stored, means3D=stored.means3D[:, [1, 2, 0]]))
    said = fails(ply, *scene)
    assert "does not show" in said and "at least 15. Is it another scene, are its poses" in said
    assert said.endswith(", or was its background white (--white-background)?\n")
    assert "was its background black (now it is white)?" in fails(ply, *scene, "--white-background")
    io.write_gaussians(ply, dataclasses.replace(stored, means3D=stored.means3D[:, [1, 2, 0]], blend_mode=None,
                                                comments=()))
    said = fails(ply, *scene)
    assert said.endswith("--blend-mode smoe --background-gate X that of another one)?\n")
    words = said.partition("or is its blend mode not alpha (not recorded; `dsmoe ")[2].partition("`")[0]
    declared = str(tmp_path / "declared.ply")
    assert main([declared if word == "declared.ply" else word for word in shlex.split(words)]) == 0
    assert load_model(declared, "cpu")[1] == ("smoe", 0, 2), "the command that is named works"
    (tmp_path / "model.ksplat").write_bytes(bytes(64))
    assert "model.ksplat: it is none of .ply, .splat, .spz and .glb" in fails(str(tmp_path / "model.ksplat"), *scene)
    packed = "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 1\n{packed}end_header\n"
    (tmp_path / "packed.ply").write_bytes(header.encode() + bytes(16))
    assert "it is compressed, as SuperSplat does" in fails(str(tmp_path / "packed.ply"), *scene)
    main(["simplify", ply, "--budget", "40", "-o", output])
    assert "neither photographs nor cameras are known; name its scene with --scene" in capsys.readouterr().err
    (tmp_path / "bare").mkdir()
    bare = model_folder(run, tmp_path / "bare", cameras=False)
    main(["simplify", bare, "--budget", "40", "-o", output])
    assert "neither photographs nor cameras are known" in capsys.readouterr().err and not os.path.exists(output)


@pytest.mark.parametrize("kind, order", [("float", "little"), ("double", "little"), ("float", "big")])
def test_a_ply_of_another_program_is_read_by_the_names_of_its_fields(run, tmp_path, kind, order):
    """No normals, fields in another order, other fields between them, either byte order, either precision."""
    stored = io.read_gaussians(ply_of(run))
    count, coefficients = stored.shs.shape[:2]
    columns = {f"rot_{i}": stored.rotations[:, i] for i in range(4)}
    columns.update({f"f_rest_{channel * coefficients + k}": stored.shs[:, k, channel]  # channel by channel
                    for channel in range(3) for k in range(coefficients)})
    columns.update(label=np.arange(count), opacity=stored.opacity_logits[:, 0])
    columns.update({f"scale_{i}": stored.log_scales[:, i] for i in range(3)})
    columns.update({f"f_dc_{i}": stored.dc[:, 0, i] for i in range(3)})
    columns.update(zip("zxy", stored.means3D[:, [2, 0, 1]].T))
    path = tmp_path / "model.ply"
    header = "".join(f"property {kind} {name}\n" for name in columns)
    dtype = (">" if order == "big" else "<") + ("f8" if kind == "double" else "f4")
    path.write_bytes(f"ply\nformat binary_{order}_endian 1.0\nelement vertex {count}\n{header}end_header\n".encode()
                     + np.stack(list(columns.values()), axis=1).astype(dtype).tobytes())
    start = read_start(str(path))
    assert (start.blend_mode, start.gaussians.sh_degree) == ("alpha", 1)
    for name in ("means3D", "dc", "shs", "opacity_logits", "log_scales", "rotations"):
        np.testing.assert_array_equal(getattr(start.gaussians, name), getattr(stored, name), err_msg=name)


def test_a_model_trained_on_all_images_is_judged_by_these(run, tmp_path, capsys):
    """As the recipe of 3DGS trains where nobody says --eval: then there is no test image."""
    folder = model_folder(run, tmp_path, f"Namespace(eval=False, resolution=30, source_path={run.scene!r})")
    output = str(tmp_path / "out")
    assert main(["simplify", folder, "--keep", "1", "--iterations", "8", "-o", output, "--device", "cpu"]) == 0
    row = results_of(output)[0]
    scene = load_scene(run.changed(test_every=0), progress=False)
    renderer = open_renderer(run, ply_of(run), None, "cpu")
    before = evaluate(renderer, scene.train, "cpu", passes=1).metrics["psnr"]
    assert row["psnr"] is None and row["start"]["psnr_train"] == pytest.approx(before, abs=1e-6)
    assert f"the training views have {row['psnr_train']:.2f} dB, and {before:.2f} dB before" in capsys.readouterr().out


@pytest.mark.parametrize("lens, note, question", [
    (True, "", "were its images undistorted (--lenses undistort)"),
    (False, "8 images are undistorted", "was it trained on images as they are (--lenses native)")])
def test_another_lens_is_asked_for(run, lens, note, question):
    config = run.changed(init=ply_of(run))
    scene = load_scene(config, progress=False)
    bent = Lens("OPENCV_FISHEYE", True, (0.0,) * 4) if lens else None
    black = [dataclasses.replace(view, image=255 - view.image, camera=dataclasses.replace(view.camera, lens=bent))
             for view in scene.train]
    with pytest.raises(TrainerError) as error:
        check_start(dataclasses.replace(scene, train=black, note=note), config)
    assert question in str(error.value)


def test_training_and_test_views_may_share_names(run, tmp_path):
    """As those of NeRF-synthetic scenes do in cameras.json."""
    folder = model_folder(run, tmp_path)
    path = tmp_path / "cameras.json"
    entries = json.loads(path.read_text())
    entries[3]["img_name"] = entries[0]["img_name"] = "r_0"
    path.write_text(json.dumps(entries))
    layout = read_layout(TrainConfig(scene=folder, test_every=0))
    assert sorted(image.camera.name for image in layout.train) == sorted(
        ["r_0-0", "r_0-3", *(entry["img_name"] for entry in entries if entry["img_name"] != "r_0")])


@pytest.mark.parametrize("edit, words", [
    (lambda entry: entry.pop("fx"), "'fx' is missing"),
    (lambda entry: entry.update(rotation=[[1, 0, 0], [0, 2, 0], [0, 0, 1]]), "is not a rotation"),
    (lambda entry: entry.update(position=[0, float("nan"), 0]), "must be finite"),
    (lambda entry: entry.update(width=0), "must be above 0"),
])
def test_wrong_cameras_are_named(run, tmp_path, edit, words):
    folder = model_folder(run, tmp_path)
    path = tmp_path / "cameras.json"
    entries = json.loads(path.read_text())
    edit(entries[0])
    path.write_text(json.dumps(entries))
    with pytest.raises(TrainerError) as error:
        read_layout(TrainConfig(scene=folder))
    assert words in str(error.value) and "cameras.json" in str(error.value)


def test_ctrl_c_keeps_the_model_and_resume_ends_where_it_would_have(run, tmp_path, monkeypatch, capsys):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    words = ["simplify", run.output, "--budget", "40", "--iterations", "40", "--quiet", "--device", "cpu"]
    straight, broken = str(tmp_path / "straight"), str(tmp_path / "broken")
    assert main([*words, "-o", straight]) == 0
    step = Trainer.step

    def interrupted(self, *arguments):
        if self.iteration + 1 == 9:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, *arguments)

    try:
        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "step", interrupted)
            assert main([*words, "-o", broken]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err.endswith(f"-o {broken} --resume\n")
    assert main(["export", broken, "-o", str(tmp_path / "sofar.ply")]) == 0
    assert 40 < len(io.read_gaussians(tmp_path / "sofar.ply").means3D), "the checkpoint's"
    assert main([*words, "-o", broken, "--resume"]) == 0
    assert open(model_path(broken, 40), "rb").read() == open(model_path(straight, 40), "rb").read()
    start = results_of(broken)[0]["start"]
    assert main(["train", "--resume", "-o", broken, "--iterations", "44", "--quiet"]) == 0
    assert results_of(broken)[0]["start"] == start and results_of(broken)[0]["protocol"]["iterations"] == 44


@pytest.mark.parametrize("degree, strategy", [
    (0, "importance"), (1, "importance"), (3, "importance"), (1, "3dgs"), (1, "steady"), (1, "mcmc")])
def test_a_training_from_a_model_begins_with_its_image(run, degree, strategy):
    """With fewer harmonics it is what they show, with more the others begin with 0."""
    budget = results_of(run.output)[0]["num_gaussians"]
    config = run.changed(init=ply_of(run), sh_degree=degree, strategy=strategy, budget=budget)
    scene = load_scene(config, progress=False)
    trainer = Trainer(config, scene)
    assert trainer.model.active_sh_degree == min(degree, 1)
    assert trainer.model.raw["shs"].shape[1] == (degree + 1) ** 2 - 1
    gaussians = io.read_gaussians(ply_of(run))
    cut = raw_of(dataclasses.replace(gaussians, shs=gaussians.shs[:, :3 * min(degree, 1)]))
    expected = open_renderer(run, ply_of(run), None, "cpu").of(GaussianModel.from_gaussians(cut, min(degree, 1)), 1.0)
    camera = scene.test[0].camera
    with torch.no_grad():
        assert torch.equal(trainer.renderer(camera).color, expected(camera).color)


@pytest.mark.parametrize("strategy", ["3dgs", "steady", "mcmc", "importance"])
def test_every_strategy_starts_from_a_model(run, tmp_path, strategy):
    count = results_of(run.output)[0]["num_gaussians"]
    config = run.changed(strategy=strategy, init=ply_of(run), budget=count + 10, iterations=30, densify_until_iter=20,
                         densify_from_iter=2, densification_interval=4, output=str(tmp_path / "out"))
    row = train(config, progress=False)
    assert 0 < row["num_gaussians"] <= count + 10 and row["protocol"]["init_points"] == count
    if strategy != "importance":
        with pytest.raises(ConfigError, match=f"--budget is {count - 1}; with --strategy {strategy} it must be at"):
            train(config.changed(budget=count - 1, output=str(tmp_path / "no")), progress=False)


def test_a_resumed_run_finds_the_model_that_it_began_with(run, tmp_path):
    model = str(tmp_path / "model.ply")
    shutil.copyfile(ply_of(run), model)
    config = run.changed(init=model, iterations=6, output=str(tmp_path / "out"), densify_until_iter=0)
    train(config, progress=False)
    longer = config.changed(iterations=8)
    stored = io.read_gaussians(model)
    io.write_gaussians(model, dataclasses.replace(stored, means3D=stored.means3D + np.float32(0.5)))
    with pytest.raises(TrainerError, match="checksum of the points"):
        train(longer, resume=True, progress=False)
    shutil.copyfile(ply_of(run), model)
    assert train(longer, resume=True, progress=False)["protocol"]["iterations"] == 8


@pytest.mark.parametrize("mode", BLEND_MODES)
def test_a_glb_is_read_as_it_was_written(run, tmp_path, mode):
    gate = 0.25 if mode in ("smoe", "smoe_eq7") else None
    model = dataclasses.replace(io.read_gaussians(ply_of(run)), blend_mode=mode, background_gate=gate, comments=())
    ply, glb = str(tmp_path / "m.ply"), str(tmp_path / "m.glb")
    io.write_gaussians(ply, model)
    assert main(["export", ply, "-o", glb]) == 0
    read = read_start(glb)
    assert (read.blend_mode, read.background_gate) == (mode, {"alpha": 1}.get(mode, gate or 0))
    turned = model.rotations / np.linalg.norm(model.rotations, axis=1, keepdims=True)
    for name, expected, error in (("means3D", model.means3D, 0), ("dc", model.dc, 0), ("shs", model.shs, 0),
                                  ("rotations", turned, 1e-6), ("log_scales", model.log_scales, 1e-5),
                                  ("opacity_logits", model.opacity_logits.clip(-11, 11), 2e-2)):
        actual = getattr(read.gaussians, name)  # logs and logits of float32; near 1 an opacity has few digits
        assert np.allclose(actual.clip(-11, 11) if name == "opacity_logits" else actual, expected, rtol=0, atol=error)


def test_a_splat_is_read_as_its_bytes_say(run, tmp_path):
    splat = str(tmp_path / "m.splat")
    assert main(["export", run.output, "-o", splat]) == 0
    read, model = read_start(splat).gaussians, io.read_gaussians(ply_of(run))
    opacity = 1 / (1 + np.exp(-model.opacity_logits.astype(np.float64)))
    order = np.argsort(-np.exp(model.log_scales.astype(np.float64)).prod(axis=1) * opacity[:, 0], kind="stable")
    assert read.sh_degree == 0 and np.array_equal(read.means3D, model.means3D[order])
    assert np.allclose(read.log_scales, model.log_scales[order], atol=1e-5)
    assert np.abs(1 / (1 + np.exp(-read.opacity_logits)) - opacity[order]).max() <= 0.51 / 255
    colour = (0.5 + 0.28209479177387814 * model.dc[order]).clip(0, 1)  # 1 / (2 sqrt(pi))
    assert np.abs(0.5 + 0.28209479177387814 * read.dc - colour).max() <= 0.51 / 255
    unit = model.rotations[order] / np.linalg.norm(model.rotations[order], axis=1, keepdims=True)
    assert np.abs(read.rotations - unit).max() <= 1.01 / 128
    for content in (b"", b"\0" * 33):
        (tmp_path / "bad.splat").write_bytes(content)
        with pytest.raises(TrainerError, match=f"{len(content)} bytes; a .splat has 32 for each Gaussian"):
            read_start(str(tmp_path / "bad.splat"))


def test_an_spz_is_read_to_the_bits_of_the_format(run, tmp_path):
    pytest.importorskip("gsply", reason="pip install gsply")
    spz = str(tmp_path / "m.spz")
    assert main(["export", run.output, "-o", spz]) == 0
    read, model = read_start(spz).gaussians, io.read_gaussians(ply_of(run))
    assert np.allclose(read.means3D, model.means3D, rtol=0, atol=2.0**-18)
    assert np.allclose(read.log_scales, model.log_scales, atol=0.51 / 16)
    assert np.allclose(read.shs, model.shs, atol=0.51 / 128)


def test_what_is_no_glb_of_gaussians_is_named(tmp_path):
    path = str(tmp_path / "m.glb")
    for content in (b"", b"glTF" + bytes(40), Image.new("RGB", (2, 2)).tobytes() * 9):
        with open(path, "wb") as file:
            file.write(content)
        with pytest.raises(TrainerError, match="m.glb: "):
            read_start(path)


@pytest.mark.parametrize("place, value, words", [
    (("accessors", 2, "count"), 5, "KHR_gaussian_splatting:SCALE has 5 rows of 3 numbers; it must have 6 of 3"),
    (("accessors", 2, "count"), -1, "accessor 2 has -1 rows of 3 numbers from byte 168 on"),
    (("accessors", 2, "count"), 99, "bytes of them (truncated file?)"),
    (("meshes", 0, "primitives", 0, "attributes", "KHR_gaussian_splatting:SCALE"), 1, "SCALE has 6 rows of 4 numbers"),
])
def test_a_glb_whose_attributes_do_not_fit_is_told(tmp_path, place, value, words):
    """The scales are the third accessor, behind positions and rotations: 6 (3 + 4) numbers of 4 bytes."""
    rows = np.ones((6, 4), np.float32)
    content = glb_bytes(io.Gaussians(means3D=rows[:, :3], dc=rows[:, None, :3], shs=np.zeros((6, 0, 3), np.float32),
                                     opacity_logits=rows[:, :1], log_scales=rows[:, :3], rotations=rows), None)
    begin = content.index(b"BIN\0") - 4
    document = json.loads(content[20:begin])
    part = document
    for name in place[:-1]:
        part = part[name]
    part[place[-1]] = value
    text = json.dumps(document).encode()
    path = str(tmp_path / "m.glb")
    with open(path, "wb") as file:
        file.write(content[:12] + struct.pack("<I4s", len(text), b"JSON") + text + content[begin:])
    with pytest.raises(TrainerError) as error:
        read_start(path)
    assert words in str(error.value)
