"""The captures beside the repository, if they are there: what the loader makes of them, and that they train."""
from __future__ import annotations

import pytest
from real_data import folder

from dsmoe.options.config import TrainConfig
from dsmoe.scenes.scene import load_scene
from dsmoe.training.trainer import Trainer


@pytest.mark.parametrize("name, views, points, size", [("fox", (43, 7), 13_710, (67, 118)),
                                                       ("room35", (30, 5), 5_740, (120, 68))])
def test_captures(name, views, points, size):
    scene = load_scene(TrainConfig(scene=folder(name), resolution=8), progress=False)
    assert (len(scene.train), len(scene.test)) == views
    assert len(scene.points.positions) == points
    camera = scene.train[0].camera
    assert (camera.width, camera.height) == size


def test_the_principal_point_of_the_fox_is_honoured():
    """7 pixels off the centre of 534, so 7/8 of one at an eighth of the size."""
    scenes = [load_scene(TrainConfig(scene=folder("fox"), resolution=8, principal_point=point), progress=False)
              for point in ("scene", "centre")]
    offsets = [scene.train[0].camera.cx - scene.train[0].camera.width / 2 for scene in scenes]
    assert offsets[0] == pytest.approx(7.2 / 8, abs=0.02) and offsets[1] == 0


def test_a_nerf_synthetic_scene():
    scene = load_scene(TrainConfig(scene=folder("lego"), resolution=8, white_background=True), progress=False)
    assert (scene.kind, len(scene.train), len(scene.test), len(scene.points.positions)) == (
        "nerf-synthetic", 100, 50, 100_000)
    assert (scene.train[0].image[:, 0, 0] == 255).all(), "what is transparent is white"
    # Cameras of this data set lie on a sphere of radius 4.03 around the object.
    distance = float((scene.train[0].camera.center ** 2).sum()) ** 0.5
    assert distance == pytest.approx(4.03, abs=0.01)


@pytest.mark.parametrize("blend_mode", ["alpha", "smoe"])
def test_a_real_capture_trains(blend_mode):
    config = TrainConfig(scene=folder("fox"), resolution=67, init_points=2000, blend_mode=blend_mode, iterations=1000)
    trainer = Trainer(config, load_scene(config, progress=False))
    before = trainer.evaluate().metrics["psnr"]
    for _ in range(150):
        trainer.step()
    # A wrong axis, order or unit anywhere would leave noise; 150 steps gain several dB on views never seen.
    assert trainer.evaluate().metrics["psnr"] > before + 3
