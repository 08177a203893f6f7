"""The orbit about what a scene's cameras look at, and `dsmoe render --orbit`: images or a video of it."""
from __future__ import annotations

import dataclasses
import math
import os
import resource

import numpy as np
import pytest
import torch
from PIL import Image

from diff_smoe_rasterization import io
from dsmoe import filming
from dsmoe.cli import main
from dsmoe.errors import SceneError
from dsmoe.inspection import open_trained, to_image
from dsmoe.results.video import write_video
from dsmoe.scenes.orbit import default_camera, look_at, orbit_of_cameras, orbit_of_points, upright


def ring(target, up, count=7):
    """Cameras around a point that look at it."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    side = np.cross(up, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    cameras = []
    for angle in 2 * np.pi * np.arange(count) / count:
        eye = target + 3 * (np.cos(angle) * side + np.sin(angle) * np.cross(up, side)) + 1.5 * up
        rotation = look_at(eye, target, up)
        cameras.append(dataclasses.replace(default_camera(), rotation=rotation, translation=-rotation @ eye))
    return cameras


@pytest.mark.parametrize("up", [[0, 1, 0], [0, 0, -1], [1, 2, -1]])
def test_an_orbit_of_a_ring_is_that_ring(up):
    target = np.array([1.0, -2.0, 0.5])
    cameras = ring(target, up)
    orbit = orbit_of_cameras(cameras)
    assert np.allclose(orbit.target, target)
    assert np.allclose(orbit.up, np.asarray(up) / np.linalg.norm(up))
    for mine, theirs in zip(orbit.cameras(7, cameras[0]), cameras):
        assert np.allclose(mine.center, theirs.center) and np.allclose(mine.rotation, theirs.rotation)


def rolled(camera, angle):
    """The camera turned about its viewing axis by an angle in radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotation = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) @ camera.rotation
    return dataclasses.replace(camera, rotation=rotation, translation=-rotation @ camera.center)


@pytest.mark.parametrize("up", [[0, 1, 0], [0, 0, -1], [1, 2, -1]])
def test_half_a_ring_of_tilted_photographs_has_its_up_and_is_turned_upright(up):
    """All look down by 27 degrees to one side, to which the mean of the images' vertical axes leans."""
    up = np.asarray(up) / np.linalg.norm(up)
    level = ring(np.array([1.0, -2.0, 0.5]), up, count=40)[:20]
    assert np.allclose(orbit_of_cameras(level).up, up)
    tilts = np.radians(12) * np.sin(np.arange(20))
    tilted = [rolled(camera, angle) for camera, angle in zip(level, tilts)]
    found = orbit_of_cameras(tilted).up
    assert np.degrees(math.acos(min(1.0, found @ up))) < 3  # their mean tilt and how it is spread
    for camera, straight in zip(tilted, level):
        turned = upright(camera, up)
        assert np.allclose(turned.rotation, straight.rotation) and np.allclose(turned.center, camera.center)
    down = dataclasses.replace(level[0], rotation=look_at(up * 5, np.zeros(3), np.roll(up, 1)))
    assert upright(down, up) is down


def test_photographs_that_all_look_one_way_do_not_say_what_is_level():
    """Their horizontal axes run parallel, so it is the vertical one of the images, here 30 degrees off the world's."""
    eye = np.array([0.0, -math.sin(math.pi / 6), -math.cos(math.pi / 6)])
    rotation = look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0]))
    cameras = [dataclasses.replace(default_camera(), rotation=rotation, translation=-rotation @ (eye + [x, 0, 0]))
               for x in (-1.0, 0.0, 1.0)]
    assert np.allclose(orbit_of_cameras(cameras).up, -rotation[1])


def test_photographs_of_both_formats_have_the_up_of_most():
    """A camera that is held upright has another one's vertical axis as its horizontal one."""
    up = np.array([0.0, 0.0, 1.0])
    cameras = [rolled(camera, math.pi / 2 * (index % 3 == 0)) for index, camera in enumerate(ring(np.zeros(3), up, 30))]
    assert orbit_of_cameras(cameras).up @ up > 0.9


def test_cameras_side_by_side_have_their_target_in_front():
    rotation = np.eye(3)
    cameras = [dataclasses.replace(default_camera(), translation=np.array([x, 0.0, 0.0])) for x in (-1.0, 0.0, 1.0)]
    orbit = orbit_of_cameras(cameras)
    assert np.allclose(orbit.target, [0, 0, 2]) and np.allclose(orbit.up, -rotation[1])


def test_one_camera_is_enough():
    camera = dataclasses.replace(default_camera(), translation=np.array([0.0, 0.0, 5.0]))
    orbit = orbit_of_cameras([camera])
    first, *_ = orbit.cameras(4, camera)
    assert np.isfinite(first.translation).all() and np.allclose(orbit.target, [0, 0, -3])


def test_points_are_seen_from_outside_upright():
    points = np.random.RandomState(0).normal(5, 1, (500, 3))
    lost = np.array([[math.nan, 0, 0], [0, math.inf, 0], [0, 0, -1e30]])
    for camera in orbit_of_points(np.concatenate([lost, points])).cameras(5, default_camera()):
        seen = points @ camera.rotation.T + camera.translation
        pixels = camera.fx * seen[:, :2] / seen[:, 2:] + [camera.cx, camera.cy]
        inside = (seen[:, 2] > 0.2) & (pixels > 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
        assert inside.mean() > 0.7
        assert camera.rotation[1] @ [0, -1, 0] < 0, "the image's y is down"
    with pytest.raises(SceneError, match="none of the 3 Gaussians lies within 1e[+]09 of the origin"):
        orbit_of_points(lost)


@pytest.fixture
def model(tmp_path):
    """A cloud that looks different from every side."""
    random, path = np.random.RandomState(0), str(tmp_path / "model.ply")
    io.write_gaussians(path, io.Gaussians(
        random.normal(0, 1, (80, 3)), random.normal(0, 1, (80, 1, 3)), np.zeros((80, 0, 3)),
        random.normal(0, 1, (80, 1)), random.normal(-1.5, 0.3, (80, 3)), random.normal(0, 1, (80, 4)), "smoe", 0.03))
    return path


def orbit(model, output, *arguments):
    return main(["render", model, "--orbit", "--frames", "3", "-o", str(output), *arguments])


def test_a_folder_of_images_goes_once_around(model, tiny_scene, tmp_path, capsys):
    assert orbit(model, tmp_path / "images", "--depth", "--scene", tiny_scene) == 0
    assert "3 images in" in capsys.readouterr().out
    trained = open_trained(model, scene=tiny_scene)
    for index, camera in enumerate(trained.orbit.cameras(3, trained.cameras[0])):
        with torch.no_grad():
            expected = np.asarray(to_image(trained.renderer(camera).color))
        written = np.asarray(Image.open(tmp_path / "images" / f"orbit_{index:04d}.png"))
        assert np.array_equal(written, expected) and written.shape == (24, 32, 3) and expected.std() > 10
        assert (tmp_path / "images" / f"orbit_{index:04d}.depth.npy").is_file()
    assert orbit(model, tmp_path / "images", "--scene", tiny_scene, "--frames", "2") == 0
    assert len(list((tmp_path / "images").glob("*.png"))) == 2, "no image of the longer orbit stays"


def test_an_orbit_needs_no_scene(model, tmp_path):
    assert main(["render", model, "--orbit", "--frames", "1", "-o", str(tmp_path / "images")]) == 0
    image = np.asarray(Image.open(tmp_path / "images" / "orbit_0000.png"))
    assert image.shape == (600, 800, 3) and (image > 0).any(axis=2).mean() > 0.2, "the model is in the picture"


@pytest.mark.parametrize("name", ["a.gif", "a.webp"])
def test_a_loop_has_every_frame(model, tiny_scene, tmp_path, capsys, name):
    assert orbit(model, tmp_path / name, "--scene", tiny_scene, "--fps", "10") == 0
    assert f"{name}: 3 frames, 0.3 s" in capsys.readouterr().out
    with Image.open(tmp_path / name) as film:
        film.load()
        assert (film.n_frames, film.size, film.info["duration"]) == (3, (32, 24), 100) and film.info["loop"] == 0
    assert sorted(os.listdir(tmp_path)) == [name, "model.ply"]
    (tmp_path / name).write_text("mine")
    assert orbit(model, tmp_path / name, "--scene", tiny_scene) == 1
    assert f"{name} is there already" in capsys.readouterr().err and (tmp_path / name).read_text() == "mine"
    assert orbit(model, tmp_path / name, "--scene", tiny_scene, "--overwrite") == 0
    assert Image.open(tmp_path / name).n_frames == 3


def test_an_mp4_plays_every_frame(tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    colours = [(200, 30, 30), (30, 200, 30), (30, 30, 200)]
    write_video(str(tmp_path / "a.mp4"), [Image.new("RGB", (65, 49), colour) for colour in colours], 10)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert next(reader)["size"] == (64, 48)
    frames = [np.frombuffer(frame, np.uint8).reshape(48, 64, 3) for frame in reader]
    assert len(frames) == 3
    for frame, colour in zip(frames, colours):  # within what the compression of a plain colour changes
        assert np.abs(frame.mean(axis=(0, 1)) - colour).max() < 12


@pytest.mark.parametrize("output, arguments, text", [
    ("a.gif", ["--depth"], "a video has room for colours only"), ("a", ["--frames", "0"], "--frames is 0"),
    *(("a.gif", ["--fps", fps], f"--fps is {fps}; it must be from 0.01 to 1000")
      for fps in ("0", "1e-308", "0.009", "-1", "1001", "inf", "nan")),
    ("a.gif", ["--frames", "100001"], "--frames is 100001; it must be from 1 to 100000"),
    *(("a" + ending, [], f"a{ending}: -o names a folder for images")
      for ending in (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".JPG")),
    ("a.mov", [], "a video can end in .mp4, .gif or .webp; .mov is not written")])
def test_what_cannot_be_filmed_is_refused(model, tmp_path, capsys, monkeypatch, output, arguments, text):
    for name in ("write_images", "write_video"):
        monkeypatch.setattr(filming, name, lambda *_: pytest.fail("it is filmed"))
    assert orbit(model, tmp_path / output, *arguments) == 1
    assert text in capsys.readouterr().err and not (tmp_path / output).exists()


@pytest.mark.parametrize("ending", [".gif", ".webp"])
@pytest.mark.parametrize("fps", ["0.01", "1000"])
def test_the_slowest_and_the_fastest_video_are_written(model, tmp_path, fps, ending):
    assert orbit(model, tmp_path / f"a{ending}", "--fps", fps, "--frames", "2") == 0


@pytest.fixture
def little_room():
    """No file may have more than 700 bytes, as on a disk that is full."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (700, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("name, left", [("a.gif", []), ("a", ["a"])])
def test_a_full_disk_leaves_no_half_of_a_file(model, tmp_path, capsys, little_room, name, left):
    assert orbit(model, tmp_path / name) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"{tmp_path / name}" in said and said.endswith("File too large\n")
    assert sorted(os.listdir(tmp_path)) == [*left, "model.ply"]
    assert not left or sorted(os.listdir(tmp_path / name)) == [".dsmoe.json", ".dsmoe.lock"]


def test_an_mp4_without_its_library_is_refused(model, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    assert orbit(model, tmp_path / "a.mp4") == 1
    assert "pip install imageio-ffmpeg; .gif" in capsys.readouterr().err
