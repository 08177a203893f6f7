"""`dsmoe render --orbit`: a way around a model as images or as a video."""
from __future__ import annotations

import os

import numpy as np
import pytest
import torch
from PIL import Image

from diff_smoe_rasterization import io
from dsmoe.cli import main
from dsmoe.inspection import to_image
from dsmoe.opening import open_trained
from dsmoe.results.video import write_video


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


def test_a_gif_has_every_frame(model, tiny_scene, tmp_path, capsys):
    assert orbit(model, tmp_path / "a.gif", "--scene", tiny_scene, "--fps", "10") == 0
    assert "a.gif: 3 frames, 0.3 s" in capsys.readouterr().out
    with Image.open(tmp_path / "a.gif") as film:
        assert (film.n_frames, film.size, film.info["duration"]) == (3, (32, 24), 100)
    assert sorted(os.listdir(tmp_path)) == ["a.gif", "model.ply"]
    (tmp_path / "a.gif").write_text("mine")
    assert orbit(model, tmp_path / "a.gif", "--scene", tiny_scene) == 1
    assert "a.gif is there already" in capsys.readouterr().err and (tmp_path / "a.gif").read_text() == "mine"
    assert orbit(model, tmp_path / "a.gif", "--scene", tiny_scene, "--overwrite") == 0
    assert Image.open(tmp_path / "a.gif").n_frames == 3


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
    ("a.gif", ["--fps", "0"], "--fps is 0")])
def test_what_cannot_be_filmed_is_refused(model, tmp_path, capsys, output, arguments, text):
    assert orbit(model, tmp_path / output, *arguments) == 1
    assert text in capsys.readouterr().err and not (tmp_path / output).exists()


def test_an_mp4_without_its_library_is_refused(model, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    assert orbit(model, tmp_path / "a.mp4") == 1
    assert "pip install imageio-ffmpeg; .gif" in capsys.readouterr().err
