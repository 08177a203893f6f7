"""The page of `dsmoe export` shows in a browser what the rasterizer renders, for the same camera."""
from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from browser import browser  # noqa: F401

from diff_smoe_rasterization import io
from dsmoe.cli import main
from dsmoe.export import html
from dsmoe.inspection import open_trained, to_image
from dsmoe.results.modelfile import load_model
from dsmoe.results.rendering import Renderer
from dsmoe.scenes.orbit import default_camera, orbit_of_points

# A mean error of 1.4/255: what the page's 8-bit harmonics and 16-bit shapes may cost. It reaches 55 to 69 dB.
LEAST_PSNR = 45
SIZE = (160, 120)


def cloud(count=600, degree=3, seed=0):
    """A cloud of thick and thin, opaque and faint Gaussians, raw parameters as in a .ply."""
    random = np.random.RandomState(seed)
    coefficients = (degree + 1) ** 2
    return io.Gaussians(
        means3D=random.uniform(-2, 2, (count, 3)), dc=random.normal(0, 1, (count, 1, 3)),
        shs=random.normal(0, 0.3, (count, coefficients - 1, 3)), opacity_logits=random.normal(-1, 2.5, (count, 1)),
        log_scales=random.uniform(-4.5, -1.2, (count, 3)), rotations=random.normal(0, 1, (count, 4)))


def psnr(first, second):
    error = np.mean((np.asarray(first, float) - np.asarray(second, float)) ** 2) / 255**2
    return math.inf if error == 0 else -10 * math.log10(error)


def camera_of(orbit):
    camera, = orbit.cameras(1, default_camera())
    camera = camera.resized(*SIZE)
    return camera.__class__(**{**camera.__dict__, "cx": camera.cx + 7.5, "cy": camera.cy - 4.25})


@pytest.mark.slow
@pytest.mark.parametrize("mode, gate, degree, antialiasing", [
    ("alpha", 1.0, 3, False), ("smoe", 0.0, 3, False), ("smoe", 0.5, 1, True), ("smoe_eq7", 0.0, 2, False),
    ("smoe_eq7", 0.03, 3, False), ("smoe_eq7", 2.0, 1, True), ("smoe_eq7", 1.0, 0, False)])
def test_a_browser_shows_what_is_rendered(browser, tmp_path, mode, gate, degree, antialiasing):  # noqa: F811
    path = str(tmp_path / "model.ply")
    gaussians = cloud(degree=degree)
    io.write_gaussians(path, gaussians)
    orbit = orbit_of_points(io.read_gaussians(path).means3D)
    camera, background = camera_of(orbit), (0.1, 0.5, 0.9)
    shown = html.Shown("a cloud", mode, gate, background, antialiasing, [camera], orbit)
    (tmp_path / "page.html").write_text(html.page(io.read_gaussians(path), shown), encoding="utf-8")
    browser.open(f"file://{tmp_path}/page.html#panel=0", *SIZE)
    browser.wait_until("document.body && document.body.dataset.drawn === 'true'")
    picture = browser.picture()

    model, _ = load_model(path, "cpu")
    with torch.no_grad():
        rendered = Renderer(model, mode, torch.tensor(background), antialiasing, background_gate=gate)(camera).color
    assert psnr(picture, to_image(rendered)) >= LEAST_PSNR
    browser.value("delete document.body.dataset.drawn, 0")
    browser("Emulation.setDeviceMetricsOverride", width=160, height=248, deviceScaleFactor=1, mobile=False)
    browser.wait_until("document.body.dataset.drawn === 'true'")
    tall = browser.picture().crop((0, 64, 160, 184))  # a multiple of 16: tails depend on tiles
    assert psnr(tall, to_image(rendered)) >= LEAST_PSNR, "a tall window has the whole view in its middle"
    other = "smoe_eq7" if mode == "alpha" or gate == 1 else "alpha"
    with torch.no_grad():
        wrong = Renderer(model, other, torch.tensor(background), antialiasing, background_gate=0.1)(camera).color
    assert psnr(picture, to_image(wrong)) < LEAST_PSNR, "the other blend would pass too: the test sees nothing"


@pytest.mark.slow
def test_a_browser_counts_faint_pairs_where_the_model_does(browser, tmp_path):  # noqa: F811
    path, pictures = str(tmp_path / "model.ply"), []
    io.write_gaussians(path, cloud(degree=0))
    model, _ = load_model(path, "cpu")
    orbit = orbit_of_points(io.read_gaussians(path).means3D)
    camera, background = camera_of(orbit), (0.1, 0.5, 0.9)
    for below in (0.25, 2.0):
        shown = html.Shown("a cloud", "smoe", 0.0, background, False, [camera], orbit, below)
        page = tmp_path / f"{below}.html"
        page.write_text(html.page(io.read_gaussians(path), shown), encoding="utf-8")
        browser.open(f"file://{page}#panel=0", *SIZE)
        browser.wait_until("document.body && document.body.dataset.drawn === 'true'")
        with torch.no_grad():
            rendered = Renderer(model, "smoe", torch.tensor(background), background_gate=0.0, faint_below=below)(camera)
        pictures.append((browser.picture(), to_image(rendered.color)))
    (usual, mine), (all_pairs, theirs) = pictures
    assert psnr(usual, mine) > psnr(usual, theirs) and psnr(all_pairs, theirs) > psnr(all_pairs, mine)


@pytest.mark.slow
def test_a_gpu_that_cannot_blend_32_bit_floats_is_told_of(browser, tmp_path):  # noqa: F811
    """Sums of 11 bits: a few grey levels if a pixel has many Gaussians, and the page says so."""
    gaussians = io.Gaussians(**{**vars(cloud()), "blend_mode": "alpha"})
    model, page = str(tmp_path / "model.ply"), str(tmp_path / "page.html")
    io.write_gaussians(model, gaussians)
    assert main(["export", model, "-o", page]) == 0
    without = """const get = WebGL2RenderingContext.prototype.getExtension;
        WebGL2RenderingContext.prototype.getExtension = function(name) {
          return name === "EXT_float_blend" ? null : get.call(this, name);
        };"""
    script = browser("Page.addScriptToEvaluateOnNewDocument", source=without)["identifier"]
    browser("Page.enable")
    try:
        browser.open(f"file://{page}", *SIZE)
        browser.wait_until("document.body && document.body.dataset.drawn === 'true'")
        assert "16-bit sums" in browser.value("document.body.innerText")
        browser.value("byId('panel').hidden = true, 0")
        picture = browser.picture()
    finally:
        browser("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
        browser("Page.disable")
    trained = open_trained(model)
    with torch.no_grad():
        rendered = trained.renderer(trained.cameras[0].resized(*SIZE)).color
    assert psnr(picture, to_image(rendered)) >= 35


@pytest.mark.slow
def test_the_mouse_turns_it_and_the_switch_shows_what_other_viewers_do(browser, tmp_path):  # noqa: F811
    model, page = str(tmp_path / "model.ply"), str(tmp_path / "page.html")
    io.write_gaussians(model, io.Gaussians(**{**vars(cloud()), "blend_mode": "smoe", "background_gate": 0.03}))
    assert main(["export", model, "-o", page]) == 0
    browser.open(f"file://{page}", 320, 240)
    drawn = "document.body && document.body.dataset.drawn === 'true'"
    browser.wait_until(drawn)
    assert "600 Gaussians, smoe, background gate 0.0300" in browser.value("document.body.innerText")
    browser.value("byId('panel').hidden = true, 0")
    before = browser.picture()
    browser.value("document.querySelector('#switch input').click()")
    browser.wait_until("byId('text').textContent.includes('alpha')")
    assert psnr(before, browser.picture()) < 30
    browser.value("document.querySelector('#switch input').click()")
    browser.wait_until("byId('text').textContent.includes('smoe')")
    assert psnr(before, browser.picture()) == math.inf
    browser.value("delete document.body.dataset.drawn, 0")
    browser.drag((160, 120), (200, 130))
    browser.wait_until(drawn)
    assert psnr(before, browser.picture()) < 30

    # The same turn about the same point, by the renderer.
    trained = open_trained(model)
    yaw, pitch = 4 * 40 / 240, 4 * 10 / 240
    camera = turned(trained.cameras[0], trained.orbit, yaw, pitch).resized(320, 240)
    with torch.no_grad():
        rendered = trained.renderer(camera).color
    assert psnr(browser.picture(), to_image(rendered)) >= LEAST_PSNR


def turned(camera, orbit, yaw, pitch):
    """The camera turned about the orbit's axis and then about its own horizontal axis."""
    from scipy.spatial.transform import Rotation

    eye, rotation = camera.center, camera.rotation
    for axis, angle in ((orbit.up, yaw), (None, -pitch)):
        turn = Rotation.from_rotvec((rotation[0] if axis is None else axis) * angle).as_matrix()
        eye, rotation = orbit.target + turn @ (eye - orbit.target), rotation @ turn.T
    return camera.__class__(**{**camera.__dict__, "rotation": rotation, "translation": -rotation @ eye})
