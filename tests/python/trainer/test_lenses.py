"""Distorted images are loaded as those of a pinhole camera: every model against its formula, masks, and the cache."""
from __future__ import annotations

import json
import math
import os
import shutil
import time

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.optimize import brentq

from diff_smoe_rasterization import io, rasterize, settings_from_camera
from dsmoe.cli import main
from dsmoe.distributed.trainer import new_trainer
from dsmoe.errors import SceneError
from dsmoe.inspection import evaluate_run, open_run, open_trained
from dsmoe.options.config import TrainConfig
from dsmoe.results.evaluation import Evaluation, evaluate
from dsmoe.results.rows import result_row
from dsmoe.scenes import undistortion
from dsmoe.scenes.cameras import Camera
from dsmoe.scenes.images import View
from dsmoe.scenes.lens import lens_of
from dsmoe.scenes.modelfolder import _camera, cameras_content
from dsmoe.scenes.orbit import orbit_of_cameras
from dsmoe.scenes.scene import describe_scene, load_cameras, load_scene, read_layout
from dsmoe.scenes.straight import EVERY, StraightViews, _places, pinhole_every, straightened
from dsmoe.system.files import ABANDONED, PART
from dsmoe.train import PROGRESS_EVERY, train
from dsmoe.training.trainer import Trainer

WIDTH, HEIGHT = 96, 72
FX, FY, CX, CY = 70.0, 72.0, 46.5, 37.0
needs_opencv = pytest.mark.skipif(undistortion._opencv() is None, reason="pip install opencv-python-headless")


def bend(model, x, y, k):
    """COLMAP's formulas: from the plane at depth 1 to the one that the lens makes of it."""
    r2 = x * x + y * y
    if "FISHEYE" in model:
        r = np.sqrt(r2)
        angle = np.arctan(r)
        k = [*k, 0, 0, 0, 0][:4]
        bent = angle * (1 + sum(value * angle ** (2 * power) for power, value in enumerate(k, 1)))
        scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1)
        return x * scale, y * scale
    k = {"SIMPLE_RADIAL": [*k, 0, 0, 0], "RADIAL": [*k, 0, 0]}.get(model, list(k))
    k1, k2, p1, p2, k3, k4, k5, k6 = [*k, 0, 0, 0, 0][:8]
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)


def colour(x, y):
    """[..., 3] of the ray through (x, y) on the plane at depth 1: smooth, and different everywhere."""
    return 127 + 100 * np.stack([np.sin(6 * x) * np.cos(5 * y), np.sin(4 * x + 3 * y), np.cos(5 * x - 4 * y)], axis=-1)


def bent_image(model, k):
    """What a camera with that lens sees of `colour`: the ray of each pixel by inverting the formula step by step."""
    columns, rows = np.meshgrid((np.arange(WIDTH) + 0.5 - CX) / FX, (np.arange(HEIGHT) + 0.5 - CY) / FY)
    x, y = columns.copy(), rows.copy()
    for _ in range(200):
        u, v = bend(model, x, y, k)
        x, y = x + 0.7 * (columns - u), y + 0.7 * (rows - v)
    assert np.abs(np.stack(bend(model, x, y, k)) - [columns, rows]).max() < 1e-9
    return Image.fromarray(colour(x, y).round().astype(np.uint8))


def write_scene(folder, model, params, image, count=3, size=(WIDTH, HEIGHT), turned=False):
    """A COLMAP scene of so many equal images, with 12 points. turned: by 180 degrees about y."""
    os.makedirs(folder / "images", exist_ok=True)
    for index in range(count):
        image.save(folder / "images" / f"{index}.png")
    points = io.Points(np.random.RandomState(0).normal(0, 1, (12, 3)) + [0, 0, 4], np.full((12, 3), 128, np.uint8))
    turn, side = ([0.0, 0, 1, 0], -0.1) if turned else ([1.0, 0, 0, 0], 0.1)
    images = [io.ColmapImage(index + 1, f"{index}.png", 1, np.array(turn), np.array([side * index, 0, 0]))
              for index in range(count)]
    cameras = {1: io.ColmapCamera(1, model, *size, np.array(params, np.float64))}
    io.write_colmap(str(folder / "sparse" / "0"), io.ColmapModel(cameras, images, points))
    return str(folder)


def load(folder, lenses="undistort", **options):
    return load_scene(TrainConfig(scene=str(folder), lenses=lenses, **options), progress=False)


LENSES = [
    ("SIMPLE_RADIAL", False, [-0.12]), ("RADIAL", False, [-0.1, 0.03]), ("OPENCV", True, [-0.15, 0.04, 0.004, -0.006]),
    ("OPENCV", True, [0.2, 0.05, 0, 0]),
    ("FULL_OPENCV", True, [-0.1, 0.05, 0.003, 0.002, 0.01, 0.02, -0.01, 0.005]),
    ("OPENCV_FISHEYE", True, [0.03, -0.01, 0.004, -0.001]), ("RADIAL_FISHEYE", False, [0.03, -0.01]),
    ("SIMPLE_RADIAL_FISHEYE", False, [0.05]), ("FISHEYE", True, []),
]


def straight(view):
    return straightened(view, view.camera.pinhole())


@pytest.mark.parametrize("how", [pytest.param("undistort", marks=needs_opencv), "native"])
@pytest.mark.parametrize("model, two_focals, k", LENSES)
def test_every_model_becomes_a_pinhole_camera(tmp_path, monkeypatch, model, two_focals, k, how):
    """By OpenCV before a training, or beside the images in one through the lens."""
    monkeypatch.setitem(globals(), "FY", FY if two_focals else FX)
    params = [*([FX, FY] if two_focals else [FX]), CX, CY, *k]
    folder = write_scene(tmp_path, model, params, bent_image(model, k))
    view = load(folder).train[0] if how == "undistort" else straight(load(folder, "native").train[0])
    camera = view.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (WIDTH, HEIGHT, FX, FY, CX, CY)
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - CX) / FX, (np.arange(HEIGHT) + 0.5 - CY) / FY)
    u, v = bend(model, x, y, k)
    columns, rows = u * FX + CX, v * FY + CY  # in the bent image; its border pixels have no neighbours beyond
    shown = (columns >= 0) & (columns <= WIDTH) & (rows >= 0) & (rows <= HEIGHT)
    inner = (columns >= 2) & (columns <= WIDTH - 2) & (rows >= 2) & (rows <= HEIGHT - 2)
    valid = np.ones_like(shown) if view.mask is None else view.mask[0].numpy() == 255
    # OpenCV rounds positions to 1/32 pixel.
    doubtful = np.abs(np.stack([columns, columns - WIDTH, rows, rows - HEIGHT])).min(axis=0) < 1 / 16
    assert (valid == shown)[~doubtful].all()
    # Rounding twice, 1 level, and a half 32nd pixel of at most 10 levels; a shift by half a pixel would be 4 levels.
    difference = np.abs(view.image.permute(1, 2, 0).numpy() - colour(x, y))[inner]
    assert difference.max() < 2.5 and inner.mean() > 0.6


def fisheye_scene(folder, model="OPENCV_FISHEYE", k=(0.03, -0.01, 0.004, -0.001), count=8):
    """A COLMAP scene of a cloud of Gaussians before and beside cameras of 190 degrees and more, and its points."""
    generator = torch.Generator().manual_seed(3)
    directions = torch.nn.functional.normalize(torch.randn(60, 3, generator=generator), dim=1)
    means = 3 * torch.cat([directions[:, :2], directions[:, 2:].abs() - 0.2], 1)
    colors = torch.rand(60, 3, generator=generator)
    params = [27.0, 28.0, CX, CY, *k]
    cameras = {1: io.ColmapCamera(1, model, WIDTH, HEIGHT, np.array(params))}
    images = []
    os.makedirs(folder / "images")
    for index in range(count):
        place = torch.tensor([0.25 * math.cos(index), 0.25 * math.sin(index), 0.1 * index])
        settings = settings_from_camera([[27, 0, CX], [0, 28, CY], [0, 0, 1]], torch.eye(3), -place, WIDTH, HEIGHT,
                                        camera_model=lens_of(model, True, {}).camera_model, distortion=k)
        color = rasterize(means, torch.full((60,), 0.9), settings, colors_precomp=colors,
                          scales=torch.full((60, 3), 0.25), rotations=torch.tensor([[1.0, 0, 0, 0]] * 60)).color
        Image.fromarray((color.clamp(0, 1).permute(1, 2, 0) * 255).round().byte().numpy()).save(
            folder / "images" / f"{index}.png")
        images.append(io.ColmapImage(index + 1, f"{index}.png", 1, np.array([1.0, 0, 0, 0]), -place.double().numpy()))
    points = io.Points(means.double().numpy(), (colors * 255).byte().numpy())
    io.write_colmap(str(folder / "sparse" / "0"), io.ColmapModel(cameras, images, points))
    return str(folder)


@pytest.mark.parametrize("model, k", [("OPENCV_FISHEYE", (0.03, -0.01, 0.004, -0.001)), ("THIN_PRISM_FISHEYE", (
    0.03, -0.01, 0.002, -0.001, 0.004, -0.001, 0.003, -0.002)), ("FULL_OPENCV", (
        -0.1, 0.05, 0.003, 0.002, 0.01, 0.02, -0.01, 0.005))])
def test_native_lenses_are_those_of_colmap(tmp_path, model, k):
    folder = write_scene(tmp_path, model, [FX, FY, CX, CY, *k], Image.new("RGB", (WIDTH, HEIGHT), (9, 8, 7)))
    view = load(folder, lenses="native").train[0]
    settings = view.camera.settings(torch.zeros(3), 0, "smoe")
    assert settings.camera_model == model.lower().replace("opencv_", "").replace("full_", "")
    assert settings.distortion == k and settings.principal_point == (CX, CY)
    assert view.mask is None and not (tmp_path / ".dsmoe_cache").exists() and (view.image[0] == 9).all()


def test_a_fisheye_of_190_degrees_trains_through_its_lens(tmp_path, capsys):
    """Also what lies beyond 90 degrees, which no pinhole shows; and a pinhole shows what is before the camera.

    Of 12 seeds the worst had 32.9 dB, 29.1 behind the camera and 32.7 by a pinhole; without steps by a pinhole the best
    had 23.8 there.
    """
    k = (0.03, -0.01, 0.004, -0.001)
    degrees = np.radians([90, 95])
    bent = degrees * (1 + sum(value * degrees ** (2 * power) for power, value in enumerate(k, 1)))
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - CX) / 27, (np.arange(HEIGHT) + 0.5 - CY) / 28)
    behind = np.hypot(x, y) > bent[0]
    assert min(CX, WIDTH - CX) / 27 > bent[1] and behind.mean() > 0.1
    folder = fisheye_scene(tmp_path / "scene", "OPENCV_FISHEYE", k)
    output = str(tmp_path / "out")
    assert main(["train", folder, "-o", output, "--iterations", "1000", "--blend-mode", "smoe", "--background-gate",
                 "0", "--device", "cpu", "--test-every", "4"]) == 0
    assert "model OPENCV_FISHEYE stay as they are, since undistortion would cut off much" in capsys.readouterr().out
    with open(os.path.join(output, "results.json"), encoding="utf-8") as file:
        row = json.load(file)
    row = row[0] if isinstance(row, list) else row
    assert row["protocol"]["lenses"] == "native"
    assert row["psnr"] > 30
    assert main(["eval", output, "--device", "cpu"]) == 0
    assert f"{row['psnr']:.2f}" in capsys.readouterr().out
    with open(os.path.join(output, "results.json"), encoding="utf-8") as file:
        assert json.load(file)[0]["protocol"]["pinhole_every"] == row["protocol"]["pinhole_every"] == EVERY
    assert main(["render", output, "--split", "test", "-o", str(tmp_path / "test"), "--device", "cpu"]) == 0
    shown, photograph = (np.asarray(Image.open(path).convert("RGB"), np.float64) for path in (
        next((tmp_path / "test").glob("**/0.png")), tmp_path / "scene" / "images" / "0.png"))
    error = (shown - photograph)[behind] ** 2
    assert 10 * math.log10(255**2 / error.mean()) > 25, "their mean colour has 16.8 dB"
    config = TrainConfig.of_run(output, "--scene")
    views, renderer = load_scene(config, progress=False).test, open_run(config, None, None, "cpu").renderer
    with torch.no_grad():
        assert evaluate(renderer, [straight(view) for view in views], "cpu", passes=1).metrics["psnr"] > 29
    with open(os.path.join(output, "cameras.json"), encoding="utf-8") as file:
        recorded = json.load(file)[0]
    assert recorded["camera_model"] == "fisheye" and tuple(recorded["distortion"]) == k
    assert _camera(recorded).lens.coefficients == k
    trained = open_trained(output)
    first = trained.cameras[0]
    assert first.lens is None and first.width / (2 * first.fx) <= 1, "what the page and the viewer begin with"
    assert main(["export", output, "-o", str(tmp_path / "model.html")]) == 0
    page = (tmp_path / "model.html").read_text(encoding="utf-8")
    assert f'"fx": {first.fx}' in page and f'"fy": {first.fy}' in page
    assert main(["render", output, "--orbit", "--frames", "2", "-o", str(tmp_path / "orbit"), "--device", "cpu"]) == 0
    assert main(["train", "--resume", output, "--lenses", "undistort", "--iterations", "1001"]) == 1
    assert "undistort" in capsys.readouterr().err


@pytest.mark.parametrize("scene_is_other", [False, True])
def test_a_run_without_results_says_that_pinhole_images_were_shown(tmp_path, scene_is_other):
    """Unless it is measured on another scene, whose lenses say nothing of the training."""
    folder, output = fisheye_scene(tmp_path / "scene", count=4), str(tmp_path / "out")
    config = TrainConfig(scene=folder, output=output, test_every=2, blend_mode="alpha", iterations=2, lenses="native")
    train(config.validate(), progress=False)
    os.remove(os.path.join(output, "results.json"))
    if scene_is_other:
        os.remove(os.path.join(folder, "images", "3.png"))
    protocol = evaluate_run(output, progress=False)["protocol"]
    assert protocol["lenses"] == "native"
    assert protocol.get("pinhole_every") == (None if scene_is_other else EVERY)


def test_a_training_through_a_lens_shows_pinhole_images_too(tmp_path):
    """Of so many steps one, by the pose of its photograph; else viewers would show haze that no view shows."""
    config = TrainConfig(scene=fisheye_scene(tmp_path), lenses="native", test_every=0, device="cpu", blend_mode="alpha",
                         iterations=2 * EVERY).validate()
    trainer = Trainer(config, load_scene(config, progress=False))
    shown = [trainer.step().view.camera for _ in range(config.iterations)]
    pinholes = [camera for camera in shown if not camera.lens]
    assert pinholes == [shown[0], shown[EVERY]]
    poses = {f"{view.camera.name} (pinhole)": view.camera for view in trainer.scene.train}
    for camera in pinholes:
        assert (camera.center == poses[camera.name].center).all() and camera.fx == WIDTH / 2, "90 degrees across"
    view = trainer.scene.train[0]
    for interval in PROGRESS_EVERY.values():
        samples = [trainer.straight.of(view, iteration) for iteration in range(interval, 20 * interval, interval)]
        assert all(sample is view for sample in samples), "of the loss curve, which would show two kinds of images"
    assert pinhole_every([view], 2) == EVERY and pinhole_every([view], 1) == 0, "the last step changes nothing"
    assert pinhole_every([straight(view)], 2) == 0


@pytest.mark.parametrize("most", [0, 2, 4, 9])
def test_pinhole_images_take_no_more_memory_than_is_told(monkeypatch, most):
    """Of four lenses, with room for so many images; what is shown does not depend on what was kept."""
    monkeypatch.setattr("dsmoe.scenes.straight.KEPT_BYTES", most * 5 * WIDTH * HEIGHT + 1)
    planes = torch.randint(0, 256, (4, HEIGHT, WIDTH), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    views = [View(Camera(f"{index}", np.eye(3), np.zeros(3), FX + index, FY, CX, CY, WIDTH, HEIGHT,
                         lens_of("OPENCV_FISHEYE", True, {"k1": 0.02})), planes[:3], planes[3:]) for index in range(4)]
    many, kept = StraightViews(views), []
    for view in [*views, *views]:
        shown, alone = many.of(view, 1), straight(view)
        for name in ("image", "opacity", "mask"):
            assert torch.equal(getattr(shown, name), getattr(alone, name))
        kept.append(shown)
    again = sum(one is other for one, other in zip(kept[:4], kept[4:]))
    assert again == (4 if most >= 4 else 0), "the oldest goes first"
    held = sum(tensor.nbytes for view in kept[:min(most, 4)] for tensor in (view.image, view.opacity, view.mask))
    assert many.most_bytes == held + sum(tensor.nbytes for tensor in _places(view.camera, view.camera.pinhole(), "cpu"))
    assert StraightViews([]).most_bytes == 0


def test_pinhole_images_keep_masks(tmp_path):
    folder = write_scene(tmp_path, "OPENCV_FISHEYE", [FX, FY, CX, CY, *LENSES[5][2]], Image.new("RGB", (WIDTH, HEIGHT)))
    half_mask(tmp_path)
    view = load(folder, "native").test[0]
    mask, middle = straight(view).mask[0].numpy(), WIDTH // 2  # near the axis, so it stays
    assert not mask[:, :middle - 3].any() and (mask[5:-5, middle + 3:-5] == 255).all()


def seen_by_pinhole(lens, width, height, fx, fy, cx, cy):
    """Whether each pixel of a fisheye without coefficients has a place in the pinhole image: tan(theta) for theta."""
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    angle = np.hypot(x, y)
    stretch = np.where(angle < math.pi / 2, np.tan(angle) / angle, np.inf)
    return (np.abs(x * stretch * fx + cx - width / 2) <= width / 2) & (
        np.abs(y * stretch * fy + cy - height / 2) <= height / 2)


@pytest.mark.parametrize("focal", [30.0, 60.0, 150.0])
def test_what_undistortion_cuts_off(focal):
    lens = lens_of("OPENCV_FISHEYE", True, {})
    camera = Camera("", np.eye(3), np.zeros(3), focal, 1.1 * focal, CX, CY, WIDTH, HEIGHT)
    kept = seen_by_pinhole(lens, WIDTH, HEIGHT, focal, 1.1 * focal, CX, CY).mean()
    # Two grids of 64x64 and 96x72 places: each may misplace its border, by half a cell on each side.
    assert undistortion.cut_off(camera, lens) == pytest.approx(1 - kept, abs=0.03)
    assert undistortion.cut_off(camera, lens_of("RADIAL", False, {"k1": 0.1})) == 0, "pincushion"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1e300, -1e300])
def test_coefficients_of_any_size_have_a_finite_range(value):
    """float64 overflows on the way."""
    for model, names in (("FULL_OPENCV", ("k1", "k3", "k4", "k6")), ("OPENCV_FISHEYE", ("k1", "k4"))):
        for name in names:
            radii, distorted = lens_of(model, "FISHEYE" in model, {name: value}).radii
            assert np.isfinite(distorted).all() and (np.diff(distorted) > 0).all() and radii[0] == 0


def test_a_mild_lens_is_undistorted_and_a_strong_one_kept(tmp_path):
    image = Image.new("RGB", (WIDTH, HEIGHT), (9, 9, 9))
    for k1, native in ((-0.02, False), (-0.3, True)):
        folder = write_scene(tmp_path / str(native), "SIMPLE_RADIAL", [FX, CX, CY, k1], image)
        layout = read_layout(TrainConfig(scene=folder))
        assert all((image.camera.lens is not None) == native for image in [*layout.train, *layout.test])
        assert all((image.lens is not None) != native for image in [*layout.train, *layout.test])


def test_pixels_beyond_a_native_lens_are_masked(tmp_path):
    """r (1 - 1.2 r^2) ends at 2/3 sqrt(1 / 3.6); pixels beyond that radius, and those of the mask, do not count."""
    folder = write_scene(tmp_path, "RADIAL", [FX, CX, CY, -1.2, 0.0], Image.new("RGB", (WIDTH, HEIGHT), (200, 90, 30)))
    mask = load(folder, "native").train[0].mask[0].numpy()
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - CX) / FX, (np.arange(HEIGHT) + 0.5 - CY) / FX)
    beyond = np.hypot(x, y) > 2 / 3 * math.sqrt(1 / 3.6)
    assert beyond.any() and (mask == np.where(beyond, 0, 255)).all()
    half_mask(tmp_path)
    both = load(folder, "native").test[0].mask[0].numpy()
    assert not both[:, :WIDTH // 2].any() and (both[:, WIDTH // 2:] == mask[:, WIDTH // 2:]).all()


def test_renderings_through_a_lens_are_masked(tmp_path, capsys):
    """A model is its own teacher through the lens of the test above; nothing weighed undistortion for it."""
    camera = Camera("a", np.eye(3), np.zeros(3), FX, FX, CX, CY, WIDTH, HEIGHT, lens_of("RADIAL", False, {"k1": -1.2}))
    folder, means = str(tmp_path / "model"), np.random.RandomState(0).normal([0, 0, 3], 0.5, (20, 3))
    ply = os.path.join(folder, "point_cloud", "iteration_1", "point_cloud.ply")
    os.makedirs(os.path.dirname(ply))
    arrays = dict(means3D=means, dc=np.ones((20, 1, 3)), shs=np.zeros((20, 0, 3)), opacity_logits=np.ones((20, 1)),
                  log_scales=np.full((20, 3), -2.0), rotations=np.tile([1.0, 0, 0, 0], (20, 1)))
    io.write_gaussians(ply, io.Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()}))
    with open(os.path.join(folder, "cameras.json"), "w", encoding="utf-8") as file:
        json.dump(cameras_content([camera, camera]), file)  # to train on and to test
    mask = load_scene(TrainConfig(scene=folder, test_every=0, device="cpu"), progress=False).train[0].mask[0].numpy()
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - CX) / FX, (np.arange(HEIGHT) + 0.5 - CY) / FX)
    beyond = np.hypot(x, y) > 2 / 3 * math.sqrt(1 / 3.6)
    assert beyond.any() and (mask == np.where(beyond, 0, 255)).all()
    output = str(tmp_path / "out")
    assert main(["simplify", folder, "--keep", "0.5", "-o", output, "--iterations", "4", "--device", "cpu"]) == 0
    text = capsys.readouterr().out
    assert "model FULL_OPENCV stay as they are; Gaussians" in text and "pixels beyond the lens are masked" in text
    with open(os.path.join(output, "results.json"), encoding="utf-8") as file:
        protocol = json.load(file)[0]["protocol"]
    assert protocol["scene_kind"] == "model" and protocol["masks"]


@pytest.mark.parametrize("model, params, words", [
    ("RADIAL", [FX, CX, CY, -1e5, 0.0], r"1.png: the lens folds the image back at 0.0\d+ pixels .* \[-100000.0, "),
    # r (1 - 45 r^2) ends at 2/3 sqrt(1 / 135) = 0.057, of 70 pixels 4.0: less than a tenth of 72
    ("RADIAL", [FX, CX, CY, -45.0, 0.0], "1.png: the lens folds the image back at 4 pixels"),
    ("EQUIRECTANGULAR", [WIDTH, HEIGHT], "1.png: an image of all directions must be twice as wide .* is 96x72")])
def test_impossible_lenses_are_named_with_their_image(tmp_path, model, params, words):
    folder = write_scene(tmp_path, model, params, Image.new("RGB", (WIDTH, HEIGHT)))
    for lenses in ("native", "undistort", "auto"):
        with pytest.raises(SceneError, match=words):
            load(folder, lenses)


@pytest.mark.parametrize("fields, words", [
    ({"camera_model": "fisheye", "distortion": [0.1] * 3}, "has 3 numbers; it must have 0, 1, 2 or 4: k1 k2 k3 k4"),
    ({"camera_model": "opencv", "distortion": [math.nan]}, r"distortion\[0\] is nan; it must be finite"),
    ({"camera_model": "equirectangular", "distortion": [0.1]}, "has 1 numbers; it must have 0"),
    ({"camera_model": "orthographic"}, "`camera_model` is 'orthographic'; it must be one of opencv, fisheye"),
    ({"camera_model": "opencv", "distortion": None}, "not the cameras of a 3DGS model"),
    ({"camera_model": "fisheye", "distortion": [-1e6]}, "folds the image back")])
def test_wrong_lenses_of_cameras_json_are_named(tmp_path, fields, words):
    entry = {**cameras_content([Camera("a", np.eye(3), np.zeros(3), FX, FY, CX, CY, WIDTH, HEIGHT)])[0], **fields}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    os.makedirs(tmp_path / "point_cloud" / "iteration_1")
    (tmp_path / "point_cloud" / "iteration_1" / "point_cloud.ply").write_text("")
    with pytest.raises(SceneError, match=words):
        read_layout(TrainConfig(scene=str(tmp_path)))


def test_panoramas_of_colmap(tmp_path):
    """Its model of all directions; the parameters are the image's size. Another size of the images is no matter."""
    folder = write_scene(tmp_path, "EQUIRECTANGULAR", [128, 64], Image.new("RGB", (64, 32)), size=(128, 64))
    config = TrainConfig(scene=folder, lenses="auto", test_every=0, device="cpu")
    layout = read_layout(config)
    scene = load_scene(config, progress=False, layout=layout)
    settings = scene.train[0].camera.settings(torch.zeros(3), 0, "smoe")
    assert settings.camera_model == "equirectangular" and (settings.image_width, settings.image_height) == (64, 32)
    said = describe_scene(scene, layout, config)
    assert "EQUIRECTANGULAR stay as they are, since OpenCV cannot undistort them; Gaussians" in said
    protocol = result_row(config, scene, 1, 0.0, Evaluation({}, None, []))["protocol"]
    assert protocol["ssim"].endswith("go across their seam") and "pinhole_every" not in protocol


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_a_panorama_has_no_seam(tmp_path, mode):
    """Rolled by half its width, its camera turned with it, it trains to the same Gaussians and shows the same image."""
    photograph, runs = colour(*np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 32))).astype(np.uint8), []
    for turned in (False, True):
        image = Image.fromarray(np.roll(photograph, 32 * turned, 1))
        folder = write_scene(tmp_path / str(turned), "EQUIRECTANGULAR", [64, 32], image, 1, (64, 32), turned)
        options = dict(blend_mode=mode, background_gate=0.0) if mode == "smoe" else dict(blend_mode=mode)
        config = TrainConfig(scene=folder, iterations=20, test_every=0, device="cpu", deterministic=True, **options)
        trainer = new_trainer(config, load_scene(config, progress=False))
        with torch.no_grad():
            trainer.model.raw["scales"] -= 1  # none is wider than the image
        losses = [float(trainer.step().loss) for _ in range(20)]  # more than EVERY: none by a pinhole
        losses.append(evaluate(trainer.renderer, trainer.scene.train, "cpu", passes=1).metrics["ssim"])
        rendering = trainer.renderer(trainer.scene.train[0].camera)
        color, look = rendering.color.detach(), next(iter(trainer.passes.look(trainer.scene.train[:1])))
        assert len(rendering.radii) == len(look.costs) == trainer.num_gaussians
        runs.append((losses, trainer.whole_model().raw["means3D"], color.roll(-32 * turned, 2), *look))
        cut = trainer.renderer.with_splats(trainer.scene.train[0].camera)[0].color
        assert not turned or (cut - color).abs().max() > 0.05, "the Gaussians are at the seam"
    for straight, turned in zip(*runs):
        torch.testing.assert_close(torch.as_tensor(straight), torch.as_tensor(turned), rtol=1e-4, atol=1e-4)


def test_lenses_that_opencv_does_not_undistort_name_the_way(tmp_path):
    folder = write_scene(tmp_path, "THIN_PRISM_FISHEYE", [FX, FY, CX, CY, 0.01, 0, 0, 0, 0, 0, 0, 0],
                         Image.new("RGB", (WIDTH, HEIGHT)))
    with pytest.raises(SceneError, match="camera model THIN_PRISM_FISHEYE; --lenses native trains through it"):
        load(folder)


def test_a_panorama_of_transforms_json(tmp_path):
    Image.new("RGB", (64, 32), (90, 120, 30)).save(tmp_path / "0.png")
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": [frame]}))
    camera = load(tmp_path, lenses="native", test_every=0).train[0].camera
    settings = camera.settings(torch.zeros(3), 0, "smoe")
    assert settings.camera_model == "equirectangular" and (camera.width, camera.height) == (64, 32)
    orbit = orbit_of_cameras([camera]).cameras(2, camera)[0]
    assert orbit.lens is None and orbit.fx == pytest.approx(32), "90 degrees"


@needs_opencv
def test_what_a_lens_would_show_twice_is_masked(tmp_path):
    """r (1 - 0.5 r^2) grows up to r = 0.816: further out the image would come back."""
    radii, distorted = lens_of("RADIAL", False, {"k1": -0.5}).radii
    assert radii[-1] == pytest.approx(math.sqrt(2 / 3), abs=1e-10)  # a slope of 0 is known to 1e-16
    assert distorted[-1] == pytest.approx(math.sqrt(2 / 3) * 2 / 3, abs=1e-10)
    assert lens_of("RADIAL", False, {"k1": 0.1}).radii[0][-1] == pytest.approx(1e3)
    radii, _ = lens_of("OPENCV_FISHEYE", True, {"k1": -0.3, "k2": 0.01}).radii
    highest = brentq(lambda angle: 1 - 3 * 0.3 * angle**2 + 5 * 0.01 * angle**4, 0.5, 1.4)
    assert radii[-1] == pytest.approx(highest, abs=1e-10)
    folder = write_scene(tmp_path, "RADIAL", [FX, CX, CY, -1.2, 0.0], Image.new("RGB", (WIDTH, HEIGHT), (200, 90, 30)))
    mask = load(folder).train[0].mask[0].numpy()
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - CX) / FX, (np.arange(HEIGHT) + 0.5 - CY) / FX)
    far = np.hypot(x, y) > math.sqrt(1 / 3.6) + 0.01
    assert far.any() and not mask[far].any() and (mask[~far] == 255).mean() > 0.95


@needs_opencv
def test_undistorted_images_are_kept_and_made_anew_where_something_changes(tmp_path, monkeypatch, capsys):
    scene = tmp_path / "scene"
    image = bent_image("OPENCV", [0.2, 0.05, 0, 0])
    folder = write_scene(scene, "OPENCV", [FX, FY, CX, CY, 0.2, 0.05, 0, 0], image)
    config = TrainConfig(scene=folder, lenses="undistort")
    first = load(folder)
    kept = sorted(os.listdir(scene / ".dsmoe_cache"))
    assert len(kept) == 2 and sum(name.startswith("mask-") for name in kept) == 1, "equal images share image and mask"
    told = describe_scene(first, read_layout(config), config).splitlines()[1]
    assert told == ("3 images of camera model OPENCV are undistorted by OpenCV (3 of them now) in "
                    f"{scene}/.dsmoe_cache, pixels beyond the lens are masked")
    again = load(folder)
    assert "(0 of them now)" in again.note and sorted(os.listdir(scene / ".dsmoe_cache")) == kept
    assert (again.train[0].image == first.train[0].image).all() and (again.train[0].mask == first.train[0].mask).all()
    Image.new("RGB", (WIDTH, HEIGHT), (9, 9, 9)).save(scene / "images" / "1.png")
    changed = load(folder)
    assert "(1 of them now)" in changed.note and (changed.train[0].image == 9).all()
    monkeypatch.setenv("DSMOE_CACHE", str(tmp_path / "elsewhere"))
    assert "(3 of them now)" in load(folder).note and len(os.listdir(tmp_path / "elsewhere")) == 1
    known, loaded = load_cameras(config, "train")[0], changed.train[0].camera
    assert (known.name, known.fx, known.cy, known.width) == (loaded.name, loaded.fx, loaded.cy, loaded.width)


def half_mask(folder, right=True, name="0.png"):
    """masks/NAME of a scene whose other masks are white: only one half of that image counts."""
    os.makedirs(folder / "masks", exist_ok=True)
    for index in range(3):
        mask = Image.new("L", (WIDTH, HEIGHT), 255)
        if f"{index}.png" == name:
            mask.paste(0, (0, 0, WIDTH // 2, HEIGHT) if right else (WIDTH // 2, 0, WIDTH, HEIGHT))
        mask.save(folder / "masks" / f"{index}.png")


def left_and_right(view):
    """How much of the pixels near the left and the right border counts."""
    mask = view.mask_float()
    return float(mask[0, 20:-20, 10:20].mean()), float(mask[0, 20:-20, -20:-10].mean())


@needs_opencv
@pytest.mark.parametrize("coefficients", [[0.2, 0.05, 0, 0], [-0.1, 0, 0, 0]], ids=["lens masks", "lens shows all"])
def test_what_is_made_from_a_mask_follows_the_mask(tmp_path, coefficients):
    """Added, edited and removed behind the cache; the pixels beyond the lens stay masked all along."""
    image = Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90))
    folder = write_scene(tmp_path, "OPENCV", [FX, FY, CX, CY, *coefficients], image)
    own = load(folder).test[0].mask
    assert (own is None) == (coefficients[0] < 0)
    half_mask(tmp_path)
    assert left_and_right(load(folder).test[0]) == (0, 1)
    before = [os.stat(tmp_path / "masks" / name) for name in ("0.png", "1.png")]
    half_mask(tmp_path, right=False)
    for name, status in zip(("0.png", "1.png"), before):
        os.utime(tmp_path / "masks" / name, ns=(status.st_atime_ns, status.st_mtime_ns))
    scene = load(folder)
    assert left_and_right(scene.test[0]) == (1, 0)
    beyond = slice(None) if own is None else own == 0
    if own is not None:
        assert beyond.any() and not scene.test[0].mask[beyond].any() and not scene.train[0].mask[beyond].any()
    shutil.rmtree(tmp_path / "masks")
    again = load(folder).test[0].mask
    assert own is None and again is None or (again == own).all()


@needs_opencv
def test_the_cache_is_of_what_files_hold(tmp_path):
    """Neither size nor time of a file says what it holds, and each file of the cache is missed by itself."""
    folder = write_scene(tmp_path, "OPENCV", [FX, FY, CX, CY, 0.2, 0.05, 0, 0], Image.new("RGB", (WIDTH, HEIGHT)))
    bitmap = tmp_path / "images" / "1.png"
    Image.new("RGB", (WIDTH, HEIGHT), (9, 9, 9)).save(bitmap, "BMP")  # of one size whatever it holds
    first, status = load(folder), os.stat(bitmap)
    checksums = [view.checksum for view in first.train]
    Image.new("RGB", (WIDTH, HEIGHT), (8, 8, 8)).save(bitmap, "BMP")
    os.utime(bitmap, ns=(status.st_atime_ns, status.st_mtime_ns))
    now = os.stat(bitmap)
    assert (now.st_size, now.st_mtime_ns) == (status.st_size, status.st_mtime_ns)
    changed = load(folder)
    assert (changed.train[0].image == 8).all() and [view.checksum for view in changed.train] != checksums
    cache = tmp_path / ".dsmoe_cache"
    shutil.rmtree(cache)  # the first image's too
    load(folder)
    for name in sorted(os.listdir(cache)):
        content = (cache / name).read_bytes()
        os.remove(cache / name)
        again = load(folder)
        assert (cache / name).read_bytes() == content, name
        assert (again.train[0].mask == changed.train[0].mask).all()
        (cache / name).write_bytes(content[:len(content) // 2])
        with pytest.raises(SceneError, match=f"{name}: not a readable image .*: remove it, and the same command"):
            load(folder)
        (cache / name).write_bytes(content)
    assert [view.checksum for view in load(folder).train] == [view.checksum for view in changed.train]


@needs_opencv
def test_files_of_the_cache_have_the_usual_rights_and_what_a_kill_left_goes(tmp_path):
    folder = write_scene(tmp_path, "OPENCV", [FX, FY, CX, CY, 0.2, 0.05, 0, 0], Image.new("RGB", (WIDTH, HEIGHT)))
    cache = tmp_path / ".dsmoe_cache"
    cache.mkdir()
    half, others = (cache / f"{PART}{number}-0123.png" for number in (1, 2))
    for path, age in ((half, 2 * ABANDONED), (others, 60)):  # a process may be writing the second one
        path.write_bytes(b"half")
        os.utime(path, (time.time() - age,) * 2)
    before = os.umask(0o027)
    try:
        load(folder)
    finally:
        os.umask(before)
    left = [name for name in os.listdir(cache) if name.startswith(PART)]
    assert left == [others.name]
    assert {os.stat(cache / name).st_mode & 0o777 for name in {*os.listdir(cache)} - {*left}} == {0o640}


@needs_opencv
def test_masks_before_a_lens_are_refused_as_without_one(tmp_path):
    folder = write_scene(tmp_path, "OPENCV", [FX, FY, CX, CY, 0.2, 0.05, 0, 0], Image.new("RGB", (WIDTH, HEIGHT)))
    for mask, words in ((Image.new("L", (HEIGHT, WIDTH), 255), "the mask is 72x96.*another shape"),
                        (Image.new("L", (WIDTH, HEIGHT), 1), "values 0 and 1"),
                        (Image.new("L", (WIDTH, HEIGHT), 0), "keeps no pixel"),
                        (Image.new("LA", (WIDTH, HEIGHT), (255, 0)), "keeps no pixel")):
        half_mask(tmp_path)
        mask.save(tmp_path / "masks" / "0.png")
        with pytest.raises(SceneError, match=f"masks/0.png: .*{words}"):
            load(folder)


@needs_opencv
def test_a_scene_of_masks_and_distortion_trains(tmp_path, capsys):
    folder = write_scene(tmp_path, "SIMPLE_RADIAL_FISHEYE", [FX, CX, CY, 0.05], bent_image(
        "SIMPLE_RADIAL_FISHEYE", [0.05]), count=4)
    os.makedirs(tmp_path / "masks")
    for index in range(4):
        mask = Image.new("L", (WIDTH // 2, HEIGHT // 2), 0)
        mask.paste(255, (WIDTH // 4, 0, WIDTH // 2, HEIGHT // 2))  # the right half
        mask.save(tmp_path / "masks" / f"{index}.png")
    mask = load(folder, resolution=2).train[0].mask[0].numpy()
    assert mask.shape == (HEIGHT // 2, WIDTH // 2) and not mask[:, :20].any() and (mask[:, 28:] == 255).all()
    run = str(tmp_path / "run")
    assert main(["train", folder, "-o", run, "--resolution", "2", "--iterations", "3", "--test-every", "3", "--lenses",
                 "undistort"]) == 0
    assert "4 images of camera model SIMPLE_RADIAL_FISHEYE are undistorted" in capsys.readouterr().out
    with open(os.path.join(run, "results.json"), encoding="utf-8") as file:
        row, = json.load(file)
    assert {"masks", "undistortion"} <= set(row["protocol"]) and row["psnr"] > 3
    assert main(["eval", run]) == 0 and f"{row['psnr']:.2f}" in capsys.readouterr().out


@needs_opencv
@pytest.mark.parametrize("model, fields, k", [
    ("OPENCV", {"camera_model": "OPENCV"}, {"k1": -0.15, "k2": 0.04, "p1": 0.004, "p2": -0.006}),
    ("OPENCV", {}, {"k1": -0.15, "k2": 0.04, "p1": 0.004, "p2": -0.006}),  # instant-ngp names no model
    ("OPENCV_FISHEYE", {"camera_model": "OPENCV_FISHEYE"}, {"k1": 0.03, "k2": -0.01, "k3": 0.004, "k4": -0.001}),
    ("OPENCV_FISHEYE", {"is_fisheye": True}, {"k1": 0.03, "k2": -0.01, "k3": 0.004, "k4": -0.001}),
])
def test_transforms_have_the_lenses_of_colmap(tmp_path, model, fields, k):
    """The same image by both kinds of file is the same, bit for bit."""
    image = bent_image(model, list(k.values()))
    colmap = load(write_scene(tmp_path / "colmap", model, [FX, FY, CX, CY, *k.values()], image))
    os.makedirs(tmp_path / "json")
    frames = []
    for index in range(2):
        image.save(tmp_path / "json" / f"{index}.png")
        frames.append({"file_path": f"{index}.png", "transform_matrix": np.eye(4).tolist()})
    (tmp_path / "json" / "transforms.json").write_text(json.dumps(
        {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT, **fields, **k, "frames": frames}))
    view = load(tmp_path / "json").train[0]
    assert (view.image == colmap.train[0].image).all()
    assert (view.mask is None) == (colmap.train[0].mask is None)


def test_without_opencv_it_is_named(tmp_path, monkeypatch):
    folder = write_scene(tmp_path, "OPENCV", [FX, FY, CX, CY, 0.1, 0, 0, 0], Image.new("RGB", (WIDTH, HEIGHT)))
    monkeypatch.setattr(undistortion, "_opencv", lambda: None)
    with pytest.raises(SceneError) as error:
        load(folder)
    assert "3 images have lens distortion (camera model OPENCV)" in str(error.value)
    assert "pip install opencv-python-headless" in str(error.value)
    shutil.rmtree(tmp_path / "sparse")
    write_scene(tmp_path, "OPENCV", [FX, FY, CX, CY, 0, 0, 0, 0], Image.new("RGB", (WIDTH, HEIGHT)))
    assert load(folder).note == "", "with coefficients of 0 nothing has to be undistorted"
