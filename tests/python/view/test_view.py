"""The live viewer: what it shows of a model and of a training, and, in a browser, that it arrives there."""
from __future__ import annotations

import math
import os

import numpy as np
import pytest
import torch
from browser import browser  # noqa: F401
from tiny_scene import one_thread, tiny_scene  # noqa: F401

from diff_smoe_rasterization import io
from diff_smoe_rasterization.cli import main
from diff_smoe_rasterization.settings import BLEND_MODES
from diff_smoe_rasterization.trainer.config import TrainConfig
from diff_smoe_rasterization.trainer.inspection import to_image
from diff_smoe_rasterization.trainer.opening import open_trained
from diff_smoe_rasterization.trainer.results.rendering import Renderer
from diff_smoe_rasterization.trainer.scenes.scene import load_scene
from diff_smoe_rasterization.trainer.training.loop import Run, Trainer
from diff_smoe_rasterization.view.following import Followed
from diff_smoe_rasterization.view.gate_map import largest_gates
from diff_smoe_rasterization.view.picture import SHOWN, Blend, Look, own_colours, picture


@pytest.fixture
def model(tmp_path):
    random, path = np.random.RandomState(0), str(tmp_path / "model.ply")
    io.write_gaussians(path, io.Gaussians(
        random.normal(0, 1, (60, 3)), random.normal(0, 1, (60, 1, 3)), np.zeros((60, 0, 3)),
        random.normal(0, 2, (60, 1)), random.normal(-1.5, 0.5, (60, 3)), random.normal(0, 1, (60, 4)), "smoe_eq7",
        0.03))
    return path


@pytest.fixture
def opened(model):
    return open_trained(model)


def camera_of(opened):
    return opened.cameras[0].resized(64, 48)


def test_a_picture_is_the_rendering(opened):
    with torch.no_grad():
        expected = np.asarray(to_image(opened.renderer(camera_of(opened)).color))
    assert str(Blend.of(opened.renderer)) == "smoe_eq7 0.03"
    assert np.array_equal(picture(opened.renderer, camera_of(opened), Look(Blend.of(opened.renderer))), expected)


def test_two_blends_share_a_picture(opened):
    camera, left, right = camera_of(opened), Blend("smoe_eq7", 0.03), Blend("alpha")
    whole = {blend: picture(opened.renderer, camera, Look(blend)).astype(int) for blend in (left, right)}
    both = picture(opened.renderer, camera, Look(left, beside=right, split=0.25))
    assert np.array_equal(both[:, :15], whole[left][:, :15]) and np.array_equal(both[:, 17:], whole[right][:, 17:])
    assert (both[:, 15:17] == 255).all(), "a line between them"
    assert np.abs(whole[left] - whole[right]).max() > 20


@pytest.mark.parametrize("shown", SHOWN)
@pytest.mark.parametrize("mode", BLEND_MODES)
def test_everything_can_be_shown_in_every_mode(opened, mode, shown):
    image = picture(opened.renderer, camera_of(opened), Look(Blend(mode, 0.5), shown))
    assert image.shape == (48, 64, 3) and image.dtype == np.uint8 and image.std() > 5


def test_gates_have_distinct_colours_and_show_the_one_that_is_open(opened):
    colours = own_colours(1000)
    apart = torch.cdist(colours, colours) + 10 * torch.eye(1000)
    assert colours.min() >= 0 and colours.max() <= 1 and apart.min() > 0.02
    opened.renderer.model.raw["opacities"].data[1:] = -30  # only the first Gaussian is open
    image = picture(opened.renderer, camera_of(opened), Look(Blend("smoe", 0.0), "gates"))
    expected = np.asarray(to_image(own_colours(1)[0][:, None, None]))[0, 0]
    center = image.reshape(-1, 3)[(image.reshape(-1, 3) == expected).all(axis=1)]
    assert len(center) > 20


@pytest.mark.parametrize("mode, gate", [("alpha", 1.0), ("smoe", 0.0), ("smoe", 0.03), ("smoe_eq7", 0.03),
                                        ("smoe_tn", 0.0), ("smoe_std", 0.0)])
def test_the_gate_map_has_the_largest_weight_of_each_pixel(opened, mode, gate):
    """A rendering with a channel for each Gaussian says all weights, but for what divides them."""
    model, camera = opened.renderer.model, opened.cameras[0].resized(100, 75)  # more than one block
    renderer = Renderer(model, mode, torch.zeros(60), background_gate=gate)
    with torch.no_grad():
        weights = renderer(camera, colors_precomp=torch.eye(60)).color
    best = weights.topk(2, dim=0)
    found = largest_gates(model, renderer.settings_of(camera))
    assert torch.equal(found < 0, best.values[0] == 0)
    clear = best.values[0] > 1.0001 * best.values[1]  # rounding may turn what is closer
    assert clear.double().mean() > 0.5 and torch.equal(found[clear], best.indices[0][clear])
    assert len(found.unique()) > 20


def test_near_is_bright(opened):
    image = picture(opened.renderer, camera_of(opened), Look(Blend.of(opened.renderer), "depth"))[:, :, 0]
    with torch.no_grad():
        depth = opened.renderer(camera_of(opened), outputs=("depth",)).depth[0].numpy()
    assert (image[depth == 0] == 0).all()
    order = np.argsort(depth[depth > 0])
    assert (np.diff(image[depth > 0][order].astype(int)) <= 0).all()


def test_a_training_is_followed_to_its_end(tiny_scene, tmp_path):  # noqa: F811
    config = TrainConfig(scene=tiny_scene, output=str(tmp_path / "out"), blend_mode="smoe", iterations=6,
                         checkpoint_every=2, densify_from_iter=100)
    run = Run(Trainer(config, load_scene(config, False)), progress=False)
    config.save(config.output)
    with pytest.raises(ValueError, match="no such file yet"):
        Followed(config.output)
    run.trainer.step()
    run.save_checkpoint()
    followed = Followed(config.output)
    assert followed.progress == "training, iteration 1 of 6" and not followed.poll()
    assert float(followed.renderer.background_gate) == pytest.approx(run.trainer.background_gate)
    first = followed.renderer.model.raw["means3D"].detach().clone()
    os.rename(config.output + "/checkpoint.pt", config.output + "/away")
    with pytest.raises(ValueError, match="no such file yet"):
        followed.poll()
    os.rename(config.output + "/away", config.output + "/checkpoint.pt")
    run.train()
    assert followed.poll() and followed.progress == "trained, 6 iterations"
    assert not torch.equal(followed.renderer.model.raw["means3D"], first) and not followed.poll()
    assert len(followed.cameras) == 2


def test_without_viser_the_command_says_what_to_install(model, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert main(["view", model]) == 1
    assert "the viewer needs viser (pip install viser)" in capsys.readouterr().err


@pytest.mark.slow
def test_a_browser_shows_the_rendering_of_its_camera(model, browser, tmp_path):  # noqa: F811
    pytest.importorskip("viser")
    from diff_smoe_rasterization.view.server import Viewer, camera_of

    viewer = Viewer(Followed(model), port=0)
    try:
        browser.open(viewer.address, 900, 500)
        browser.wait_until("document.querySelector('canvas') && document.body.innerText.includes('60 Gaussians')")
        client, = viewer._clients.values()
        shot = settled(browser, client, viewer)
        assert psnr(shot, expected(viewer, client, camera_of)) > 35  # the browser scales it to its canvas
        viewer.controls.mode.value = "alpha"
        other = settled(browser, client, viewer)
        assert psnr(other, expected(viewer, client, camera_of)) > 35 and psnr(shot, other) < 30
        viewer.controls.follow(Blend("smoe", 0.03), Blend("smoe", 0.5))
        assert viewer.controls.gate.value == 0.5, "a training has learned another gate"
        browser.drag((200, 250), (260, 270))
        turned = settled(browser, client, viewer)
        assert psnr(turned, expected(viewer, client, camera_of)) > 35 and psnr(turned, other) < 30
    finally:
        viewer.close()


# Where neither the panel nor viser's notice nor its axes lie.
PART = (slice(190, 420), slice(0, 560))


def settled(browser, client, viewer):  # noqa: F811
    """The part of the window that shows the model, once it stays as it is."""
    import time

    before = None
    for _ in range(60):
        time.sleep(0.5)
        shot = np.asarray(browser.picture())[PART]
        if before is not None and np.array_equal(shot, before) and client.sharp and not client.due:
            return shot
        before = shot
    raise AssertionError("the picture never came to rest")


def expected(viewer, client, camera_of):
    camera = camera_of(client.handle.camera, 10**9)
    return picture(viewer.followed.renderer, camera, viewer.controls.look())[PART]


def psnr(first, second):
    error = np.mean((first.astype(float) - second.astype(float)) ** 2) / 255**2
    return math.inf if error == 0 else -10 * math.log10(error)
