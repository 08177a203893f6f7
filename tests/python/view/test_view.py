"""The live viewer: what it shows of a model and of a training, and, in a browser, that it arrives there."""
from __future__ import annotations

import gc
import math
import os
import time
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import browser  # noqa: F401
from tiny_scene import one_thread, tiny_scene  # noqa: F401

from diff_smoe_rasterization import io
from diff_smoe_rasterization.settings import BLEND_MODES
from dsmoe.cli import main
from dsmoe.inspection import open_trained, to_image
from dsmoe.options.config import TrainConfig
from dsmoe.results.rendering import Renderer
from dsmoe.scenes.scene import load_scene
from dsmoe.train import Run, train
from dsmoe.training.trainer import Trainer
from dsmoe.view import guard, server
from dsmoe.view.following import Followed
from dsmoe.view.guard import CAMERA, refusal
from dsmoe.view.picture import SHOWN, Blend, Look, own_colours, picture


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
    assert str(Blend.of(opened.renderer)) == "smoe_eq7 (gate 0.03)"
    assert np.array_equal(picture(opened.renderer, camera_of(opened), Look(Blend.of(opened.renderer))), expected)


def test_two_blends_share_a_picture(opened):
    camera, left, right = camera_of(opened), Blend("smoe_eq7", 0.03), Blend("alpha")
    whole = {blend: picture(opened.renderer, camera, Look(blend)).astype(int) for blend in (left, right)}
    both = picture(opened.renderer, camera, Look(left, beside=right, split=0.25))
    assert np.array_equal(both[:, :15], whole[left][:, :15]) and np.array_equal(both[:, 17:], whole[right][:, 17:])
    assert (both[:, 15:17] == 255).all(), "a line between them"
    assert np.abs(whole[left] - whole[right]).max() > 20


def test_another_blend_has_its_own_faint_below(opened):
    """That of the training is of its blend alone."""
    camera, other = camera_of(opened), Blend("smoe", 0.0)
    usual = picture(opened.renderer, camera, Look(other))
    opened.renderer.faint_below = 0.0
    assert np.array_equal(picture(opened.renderer, camera, Look(other)), usual)
    opened.renderer.blend_by("smoe", 0.0)
    assert not np.array_equal(picture(opened.renderer, camera, Look(other)), usual)


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
    model, camera = opened.renderer.model, opened.cameras[0].resized(100, 75)  # more than one tile
    renderer = Renderer(model, mode, torch.zeros(60), background_gate=gate)
    with torch.no_grad():
        weights = renderer(camera, colors_precomp=torch.eye(60)).color
    best = weights.topk(2, dim=0)
    which = best.indices[0].masked_fill(best.values[0] == 0, -1)
    colours = torch.cat([own_colours(60), opened.renderer.background[None]])
    expected = np.asarray(to_image(colours[which].permute(2, 0, 1)))
    shown = picture(opened.renderer, camera, Look(Blend(mode, gate), "largest gate"))
    clear = (best.values[0] > 1.0001 * best.values[1]) | (which < 0)  # rounding may turn what is closer
    assert clear.double().mean() > 0.5 and np.array_equal(shown[clear], expected[clear])
    assert len(which[clear].unique()) > 20


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
    for asked in ({"blend_mode": "alpha"}, {"background_gate": 0.0}, {"faint_below": 2.0}):
        with pytest.raises(ValueError, match="not (alpha|0.0|2)"):
            Followed(config.output, **asked)
    followed = Followed(config.output, "smoe")
    assert followed.progress == "training, iteration 1 of 6" and not followed.poll()
    assert float(followed.renderer.background_gate) == pytest.approx(run.trainer.background_gate)
    first = followed.renderer.model.raw["means3D"].detach().clone()
    run.trainer.optimizer.add_to_average(1.0, torch.ones(1))
    run.trainer.optimizer.average["means3D"] += 1
    run.save_checkpoint()
    assert followed.poll() and float(followed.renderer.background_gate) == 1
    torch.testing.assert_close(followed.renderer.model.raw["means3D"].detach(), first + 1)
    run.trainer.optimizer.average = {}
    os.rename(config.output + "/checkpoint.pt", config.output + "/away")
    with pytest.raises(ValueError, match="no such file yet"):
        followed.poll()
    os.rename(config.output + "/away", config.output + "/checkpoint.pt")
    run.train()
    assert followed.poll() and followed.progress == "trained, 6 iterations"
    assert not torch.equal(followed.renderer.model.raw["means3D"], first) and not followed.poll()
    assert len(followed.cameras) == 2


def test_a_training_that_is_replaced_is_followed(tiny_scene, tmp_path):  # noqa: F811
    """Another run in the same folder: fewer harmonics, another blend, and a gate that is not learned."""
    config = TrainConfig(scene=tiny_scene, output=str(tmp_path / "out"), blend_mode="smoe", iterations=4,
                         densify_from_iter=100)
    train(config, progress=False)
    followed = Followed(config.output)
    assert followed.progress == "trained, 4 iterations" and not followed.poll()
    other = TrainConfig(scene=tiny_scene, output=config.output, blend_mode="alpha", iterations=9, sh_degree=1,
                        densify_from_iter=100)
    os.remove(os.path.join(config.output, "checkpoint.pt"))
    other.save(config.output)
    with pytest.raises(ValueError, match="no such file yet"):
        followed.poll()
    assert followed.renderer.blend_mode == "smoe", "what was shown stays"
    run = Run(Trainer(other, load_scene(other, False)), progress=False)
    run.trainer.step()
    run.save_checkpoint()
    assert followed.poll() and followed.progress == "training, iteration 1 of 9" and not followed.poll()
    assert followed.renderer.blend_mode == "alpha" and followed.renderer.model.sh_degree == 1
    train(other, overwrite=True, progress=False)
    assert followed.poll() and followed.progress == "trained, 9 iterations"
    train(other, overwrite=True, progress=False)
    assert followed.poll(), "the same options again"


@pytest.mark.parametrize("origin, host, words", [
    ("http://127.0.0.1:8080", "127.0.0.1:8080", None),
    ("http://localhost:9000", "localhost:9000", None),  # through ssh -L 9000:localhost:8080
    ("https://[::1]:8080", "[::1]:8080", None),
    ("http://gpu7:8080", "gpu7:8080", None),  # --host gpu7
    (None, "127.0.0.1:8080", None),  # no browser
    ("http://evil.example", "127.0.0.1:8080", "a page of 'http://evil.example' asks"),
    ("http://localhost:3000", "localhost:8080", "a page of 'http://localhost:3000' asks"),
    ("null", "localhost:8080", "a page of 'null' asks"),
    ("http://evil.example:8080", "evil.example:8080", "'evil.example:8080' is not a name of this machine"),
    ("http://localhost.evil.example", "localhost.evil.example", "not a name of this machine"),
    *((f"http://{host}", host, "not a name of this machine") for host in (
        "[::1]evil.example", "[::1].evil.example:8080", "[::1]:8080.evil.example", "[localhost]", "[::1", "::1]",
        "localhost:80:evil.example", "localhost:evil.example", "[::1]:80x", "[[::1]]", "[]", "", "[evil.example]")),
    (None, None, "None is not a name of this machine")])
def test_pages_of_others_are_refused(origin, host, words):
    why = refusal(origin, host, "gpu7")
    assert why is None if words is None else words in why


def test_only_cameras_and_values_are_passed_on():
    camera = {"type": "ViewerCameraMessage", **{name: 1.0 if count == 1 else [1, 0.5, math.nan, 0][:count]
                                                for name, count in CAMERA.items()}}
    update = {"type": "GuiUpdateMessage", "uuid": "1", "updates": {"value": True}}

    def is_wanted(message, taken=True):
        return guard.is_wanted(message, lambda uuid, value: taken)

    assert is_wanted(camera) and is_wanted({**camera, "near": 1}) and is_wanted(update) and not is_wanted(update, False)
    for other in (None, [], {}, {"type": "ShareUrlRequest"}, {**camera, "fov": None}, {**camera, "wxyz": [1, 0, 0]},
                  {**camera, "position": "abc"}, {**camera, "up_direction": [0, "1", 0]},
                  {**camera, "image_width": math.nan}, {**camera, "image_height": math.inf},
                  {**update, "updates": {"value": {}}}, {**update, "updates": {"sync_cb": 1}}, {**update, "uuid": 1}):
        assert not is_wanted(other), other


def handle_of(**changes):
    """What viser knows of a browser's camera."""
    return SimpleNamespace(**{"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, -4.0), "fov": 0.9,
                              "image_width": 900, "image_height": 500, **changes})


@pytest.mark.parametrize("width, height", [(1, 10**7), (10**7, 1), (1e300, 1e300), (1, 1), (3000, 2000), (-5, 700)])
def test_no_window_asks_for_too_many_pixels(width, height):
    camera = server.camera_of(handle_of(image_width=width, image_height=height), 10**6)
    assert camera.width * camera.height <= 10**6 and min(camera.width, camera.height) >= 16
    if (width, height) == (3000, 2000):
        assert abs(camera.width / camera.height - 1.5) < 0.01 and camera.width * camera.height > 0.99e6


@pytest.mark.parametrize("changes", [dict(fov=0.0), dict(fov=math.nan), dict(fov=-1.0), dict(fov=4.0), dict(fov=1e300),
                                     dict(position=(math.nan, 1e300, -math.inf))])
def test_every_camera_can_be_rendered(opened, changes):
    camera = server.camera_of(handle_of(**changes), 10**4)
    assert picture(opened.renderer, camera, Look(Blend("smoe"))).shape == (camera.height, camera.width, 3)
    assert server.camera_of(handle_of(image_width=0, **changes), 10**4) is None


class Panel:
    """viser's panel: what is added has a value."""

    def __getattr__(self, name):
        return lambda *arguments, **options: SimpleNamespace(
            value=options.get("initial_value", arguments[1] if name == "add_number" else False), content="",
            on_update=lambda _: None)


def test_a_gate_that_somebody_has_set_stays():
    controls = server.Controls(Panel(), Blend("smoe", 0.03), lambda: None)
    controls.gate.value = 0.7
    controls.follow(Blend("smoe", 0.03), Blend("smoe", 0.5))
    assert (controls.gate.value, controls.other_gate.value) == (0.7, 0.5)


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, 1e300, 0.5])
def test_whatever_the_panel_says_can_be_shown(opened, value):
    controls = server.Controls(Panel(), Blend("smoe", 0.03), lambda: None)
    controls.beside.value, controls.shown.value, controls.other_mode.value = True, "passwords", ["smoe"]
    controls.gate.value = controls.other_gate.value = controls.split.value = value
    look = controls.look()
    assert picture(opened.renderer, camera_of(opened), look).shape == (48, 64, 3)
    assert look.shown == "colour" and look.beside.mode == "alpha"
    assert value != 0.5 or (look.blend.background_gate, look.split) == (0.5, 0.5)


def test_an_error_of_one_browser_is_said_in_its_panel(model):
    pictures = []
    scene = SimpleNamespace(set_background_image=lambda image, **_: pictures.append(image))
    bad, good = (server._Client(SimpleNamespace(gui=Panel(), scene=scene, camera=handle_of(**changes)))
                 for changes in (dict(wxyz=(0.0, 0.0, 0.0, 0.0)), {}))
    for client in (bad, good):
        client.show(Followed(model), Look(Blend("smoe")), "a trouble")
        assert not client.wants_picture()
    assert bad.text.content.startswith("no picture: ValueError:") and len(pictures) == 1
    assert good.text.content.startswith("60 Gaussians") and good.text.content.endswith("a trouble")


def test_a_moving_picture_of_a_slow_machine_keeps_a_least_size(model):
    pictures = []
    scene = SimpleNamespace(set_background_image=lambda image, **_: pictures.append(image))
    client = server._Client(SimpleNamespace(gui=Panel(), scene=scene, camera=handle_of()))
    client.moved, client.seconds_per_pixel = math.inf, 1e6
    client.show(Followed(model), Look(Blend("smoe")))
    assert [picture.shape for picture in pictures] == [(16, 16, 3)] and not client.sharp


def test_the_server_refuses_other_pages_and_outlives_bad_messages(model, capsys, caplog):
    viser = pytest.importorskip("viser")
    import msgspec
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    viewer = server.Viewer(Followed(model), port=0)
    own, protocol = viewer.address, f"viser-v{viser.__version__}"

    def page(origin):
        return connect(own.replace("http", "ws"), origin=origin, subprotocols=[protocol], max_size=None)

    def camera(**changes):
        fields = vars(handle_of(**{**dict(near=0.1, far=100.0, look_at=(0.0, 0.0, 0.0), up_direction=(0.0, -1.0, 0.0),
                                          image_width=90, image_height=50), **changes}))
        return msgspec.msgpack.encode({"type": "ViewerCameraMessage", **fields})

    def until(holds):
        end = time.monotonic() + 20
        while not holds():
            assert time.monotonic() < end and viewer._thread.is_alive()
            time.sleep(0.02)

    try:
        for origin in ("http://evil.example", own.replace("127.0.0.1", "localhost"), "null"):
            with pytest.raises(InvalidStatus, match="403"):
                page(origin)
        assert "refused: a page of 'http://evil.example' asks" in capsys.readouterr().out
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(own, headers={"Host": "evil.example"}))
        with urllib.request.urlopen(own) as answer:
            assert b"<html" in answer.read()
        with page(own) as first, page(own) as second:
            first.send(camera())
            second.send(camera())
            until(lambda: len(viewer._clients) == 2)
            bad, good = (viewer._clients[number] for number in sorted(viewer._clients))
            gate = viewer.controls.gate._impl
            for updates in ({"update_cb": "x" * 99}, {"visible": 0, "value": 0.7}, {"value": [1]}, {"value": "text"},
                            {"value": ""}, {"value": math.nan}, {"value": 0.25}):
                first.send(msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": gate.uuid, "updates": updates}))
            until(lambda: gate.value == 0.25)
            assert isinstance(gate.update_cb, list) and viewer.controls.gate.visible
            for message in (b"no message", camera(fov=0.0), camera(fov=math.nan), camera(image_width=math.nan),
                            camera(image_height=math.inf), camera(image_width=0.5), camera(image_width=-1e30),
                            camera(wxyz=(0.0, 0.0, 0.0, 0.0))):
                first.send(message)
            until(lambda: bad.text.content.startswith("no picture"))
            viewer.controls.gate.value = -1.0
            good.due = True
            until(lambda: not good.due and good.text.content.startswith("60 Gaussians"))
            first.send(msgspec.msgpack.encode({"type": "ViewerCameraMessage"}))
            until(lambda: len(viewer._clients) == 1)
            assert "left a browser: its message cannot be read (" in capsys.readouterr().out
            second.send(camera(fov=0.5))
            until(lambda: good.handle.camera.fov == 0.5 and not good.due and good.text.content)
    finally:
        viewer.close()
    gc.collect()  # an error that nobody has seen is said then
    assert "Traceback" not in caplog.text


def test_without_viser_the_command_says_what_to_install(model, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert main(["view", model]) == 1
    assert capsys.readouterr().err.endswith("pip install viser\n")
    assert main(["view", model, "--port", "65536"]) == 1
    assert "--port is 65536; it must be between 0 and 65535" in capsys.readouterr().err


@pytest.mark.slow
def test_a_browser_shows_the_rendering_of_its_camera(model, browser, tmp_path):  # noqa: F811
    pytest.importorskip("viser")
    from dsmoe.view.server import Viewer, camera_of

    viewer = Viewer(Followed(model), port=0)
    try:
        browser.open(viewer.address + "/?darkMode", 900, 500)
        browser.wait_until("!!document.querySelector('canvas')")
        assert np.asarray(browser.picture())[PART].mean() < 200, "it begins with the model's background, and not white"
        browser.wait_until("document.body.innerText.includes('60 Gaussians')")
        client, = viewer._clients.values()
        np.testing.assert_allclose(viewer.server.initial_camera.position, viewer.followed.cameras[0].center)
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
