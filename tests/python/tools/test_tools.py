"""The C++ tools as programs: pictures of a made-up model against the package's, messages, figures."""
from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from diff_smoe_rasterization import (
    blend_footprints,
    io,
    project_gaussians,
    rasterize,
    settings_from_camera,
)
from diff_smoe_rasterization.gaussians import activate
from diff_smoe_rasterization.settings import GATED_MODES

ROOT = Path(__file__).resolve().parents[3]
FOLDER = Path(os.environ.get("DSMOE_TOOLS", ROOT / "build" / "cpp" / "tools"))
WIDTH, HEIGHT, FOCAL = 61, 47, 55.0
LEVELS = 1  # of 255: both round the same float32 image, up to the order of a sum
MODES = [("alpha", None), ("smoe", 0.0), ("smoe", 0.25), ("smoe_eq7", 0.0), ("smoe_eq7", 0.05),
         ("smoe_eq7", 1.0), ("smoe_tn", None), ("smoe_std", None)]


def tool(name, *arguments, status=0):
    """Runs a tool; returns what it said. Skips the test if the tool is not built."""
    path = FOLDER / name
    if not path.is_file():
        pytest.skip(f"{path} is not built: cmake needs OpenCV (apt-get install libopencv-dev)")
    done = subprocess.run([path, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                          timeout=120)
    assert done.returncode == status, done.stdout
    return done.stdout


def model(mode=None, gate=None):
    random = np.random.RandomState(7)
    n = 150

    def uniform(low, high, *shape):
        return random.uniform(low, high, (n, *shape)).astype(np.float32)

    return io.Gaussians(means3D=uniform(-1, 1, 3), dc=uniform(-1, 1, 1, 3), shs=uniform(-0.3, 0.3, 8, 3),
                        opacity_logits=uniform(-2, 3, 1), log_scales=uniform(-4, -1.5, 3),
                        rotations=uniform(-1, 1, 4), blend_mode=mode, background_gate=gate)


def pose():
    """World to view: turned about y, and 3 in front of the origin."""
    angle = 0.4
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return R, np.array([0.1, -0.2, 3.0])


def package_rendering(gaussians, mode, gate, background=(0.0, 0.0, 0.0), **options):
    R, t = pose()
    K = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    if mode in GATED_MODES:
        options["background_gate"] = gate
    settings = settings_from_camera(K, R, t, WIDTH, HEIGHT, torch.tensor(background), 2, blend_mode=mode, **options)
    values = [torch.from_numpy(np.asarray(array)) for array in (gaussians.opacity_logits, gaussians.log_scales,
                                                                gaussians.rotations)]
    opacities, scales, rotations = activate(*values)
    return rasterize(torch.from_numpy(gaussians.means3D), opacities, settings, scales=scales, rotations=rotations,
                     dc=torch.from_numpy(gaussians.dc), shs=torch.from_numpy(gaussians.shs), outputs=("alpha",))


def write_cameras(folder, kind):
    """One camera at `pose` in a file of that kind; returns its path."""
    R, t = pose()
    path = folder / kind
    if kind == "colmap":
        camera = io.ColmapCamera(1, "PINHOLE", WIDTH, HEIGHT, np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]))
        angle = np.arctan2(R[0, 2], R[0, 0])
        image = io.ColmapImage(1, "view.jpg", 1, np.array([np.cos(angle / 2), 0, np.sin(angle / 2), 0]), t)
        io.write_colmap(path, io.ColmapModel({1: camera}, [image], io.Points(np.zeros((1, 3)))))
    elif kind == "cameras.json":
        path.write_text(json.dumps([{"id": 0, "img_name": "view", "width": WIDTH, "height": HEIGHT, "fx": FOCAL,
                                     "fy": FOCAL, "rotation": R.T.tolist(), "position": (-R.T @ t).tolist()}]))
    else:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = R.T @ np.diag([1.0, -1.0, -1.0]), -R.T @ t
        path.write_text(json.dumps({"fl_x": FOCAL, "w": WIDTH, "h": HEIGHT, "frames": [
            {"file_path": "./images/view.png", "transform_matrix": matrix.tolist()}]}))
    return path


def levels(image):
    """[3, H, W] from 0 to 1 -> [H, W, 3] as a PNG has it."""
    return np.rint(np.clip(np.asarray(image), 0, 1) * 255).astype(int).transpose(1, 2, 0)


@pytest.mark.parametrize("mode, gate", MODES)
def test_render_draws_what_the_package_draws(tmp_path, mode, gate):
    gaussians = model(mode, gate)
    io.write_gaussians(tmp_path / "model.ply", gaussians)
    cameras = write_cameras(tmp_path, "cameras.json")
    tool("dsmoe_render", tmp_path / "model.ply", "--cameras", cameras, "--background", "0.2,0.4,0.6", "--device", "cpu",
         "-o", tmp_path / "out.png")
    actual = np.asarray(Image.open(tmp_path / "out.png").convert("RGB")).astype(int)
    expected = levels(package_rendering(gaussians, mode, gate, (0.2, 0.4, 0.6)).color)
    assert actual.shape == expected.shape and expected.std() > 20
    assert np.abs(actual - expected).max() <= LEVELS


@pytest.mark.parametrize("kind", ["colmap", "transforms.json", "cameras.json"])
def test_all_camera_files_mean_the_same_view(tmp_path, kind):
    gaussians = model()
    io.write_gaussians(tmp_path / "model.ply", gaussians)
    tool("dsmoe_render", tmp_path / "model.ply", "--cameras", write_cameras(tmp_path, kind), "--blend", "alpha",
         "--device", "cpu", "-o", tmp_path / "out")
    files = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert [path.name for path in files] == ["view.png"]
    actual = np.asarray(Image.open(files[0]).convert("RGB")).astype(int)
    assert np.abs(actual - levels(package_rendering(gaussians, "alpha", None).color)).max() <= LEVELS


@pytest.mark.parametrize("mode, gate", MODES)
def test_a_panorama_has_no_seam(tmp_path, mode, gate):
    gaussians = model(mode, gate)
    io.write_gaussians(tmp_path / "model.ply", gaussians)
    size, position = (96, 48), np.array([0.1, -0.2, 0.3])  # in the middle of the Gaussians
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[:3, 3] = position
    (tmp_path / "transforms.json").write_text(json.dumps({
        "camera_model": "EQUIRECTANGULAR", "w": size[0], "h": size[1],
        "frames": [{"file_path": "view.png", "transform_matrix": matrix.tolist()}]}))
    words = [tmp_path / "model.ply", "--cameras", tmp_path / "transforms.json", "--view", 0]
    tool("dsmoe_render", *words, "-o", tmp_path / "out.png")
    options = {"background_gate": gate} if mode in GATED_MODES else {}
    settings = settings_from_camera(None, np.eye(3), -position, *size, sh_degree=2, blend_mode=mode,
                                    camera_model="equirectangular", **options)
    values = [torch.from_numpy(np.asarray(array)) for array in (gaussians.opacity_logits, gaussians.log_scales,
                                                                gaussians.rotations)]
    opacities, scales, rotations = activate(*values)
    footprints = project_gaussians(torch.from_numpy(gaussians.means3D), opacities, settings, scales=scales,
                                   rotations=rotations, dc=torch.from_numpy(gaussians.dc),
                                   shs=torch.from_numpy(gaussians.shs))
    seam = levels(blend_footprints(footprints, settings).color)
    expected = levels(blend_footprints(footprints.around(size[0]), settings).color)
    actual = np.asarray(Image.open(tmp_path / "out.png").convert("RGB")).astype(int)
    assert np.abs(actual - expected).max() <= LEVELS < np.abs(seam - expected).max()
    said = tool("dsmoe_render", *words, "--device", "cuda", "-o", tmp_path / "no.png", status=2)
    assert "panoramas are rendered by cpu" in said


def test_no_name_in_a_file_leads_out_of_the_folder(tmp_path):
    io.write_gaussians(tmp_path / "model.ply", model("alpha"))
    cameras = write_cameras(tmp_path, "transforms.json")
    cameras.write_text(cameras.read_text().replace("./images/view.png", "../../outside/view.png"))
    tool("dsmoe_render", tmp_path / "model.ply", "--cameras", cameras, "--device", "cpu", "-o", tmp_path / "a" / "out")
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.png")] == ["a/out/outside/view.png"]


def test_equal_names_of_views_get_pictures_of_their_own(tmp_path):
    io.write_gaussians(tmp_path / "model.ply", model("alpha"))
    cameras = write_cameras(tmp_path, "cameras.json")
    camera = json.loads(cameras.read_text())[0]
    names = ["view", "view", "frame.0001", "view_2", "frame.0002", "view"]
    cameras.write_text(json.dumps([{**camera, "img_name": name, "width": 10 + i} for i, name in enumerate(names)]))
    words = [tmp_path / "model.ply", "--cameras", cameras, "--device", "cpu", "-o", tmp_path / "out"]
    tool("dsmoe_render", *words)
    widths = {path.name: Image.open(path).width for path in (tmp_path / "out").iterdir()}
    assert widths == {"view.png": 10, "view_2.png": 11, "frame.png": 12, "view_2_2.png": 13, "frame_2.png": 14,
                      "view_3.png": 15}
    assert 'view.png" is there already' in tool("dsmoe_render", *words, status=2)


def test_what_cannot_be_written_is_said_before_the_work(tmp_path):
    io.write_gaussians(tmp_path / "model.ply", model("alpha"))
    orbit = [tmp_path / "model.ply", "--orbit", "--frames", 1, "--device", "cpu"]
    for end in ("mp4", "png"):
        said = tool("dsmoe_render", *orbit, "--size", 32, "-o", tmp_path / "no" / f"out.{end}", status=2)
        assert f'make "{tmp_path / "no"}"' in said
    said = tool("dsmoe_render", *orbit, "--size", "100000x100000", "-o", tmp_path / "out.png", status=2)
    assert '"100000x100000"; it must be at most 16384' in said
    said = tool("dsmoe_render", *orbit, "--size", 32, "-o", f"{tmp_path / 'model.ply'}/", status=1)
    assert re.search(r"model\.ply/?: Not a directory", said) and "filesystem error" not in said


def test_alpha_is_the_packages(tmp_path):
    gaussians = model("smoe", 0.05)
    io.write_gaussians(tmp_path / "model.ply", gaussians)
    cameras = write_cameras(tmp_path, "cameras.json")
    tool("dsmoe_render", tmp_path / "model.ply", "--cameras", cameras, "--show", "alpha", "--device", "cpu", "-o",
         tmp_path / "alpha.png")
    alpha = np.asarray(Image.open(tmp_path / "alpha.png")).astype(int)
    expected = levels(package_rendering(gaussians, "smoe", 0.05).alpha.reshape(1, HEIGHT, WIDTH))[..., 0]
    assert np.abs(alpha - expected).max() <= LEVELS


@pytest.mark.parametrize("show, end", [("depth", "png"), ("depth", "exr"), ("gates", "png"), ("count", "png"),
                                       ("gates", "mp4")])
def test_an_orbit_becomes_pictures_and_videos(tmp_path, show, end):
    io.write_gaussians(tmp_path / "model.ply", model("smoe", 0.0))
    frames = 3 if end == "mp4" else 1
    out = tmp_path / f"out.{end}"
    tool("dsmoe_render", tmp_path / "model.ply", "--orbit", "--frames", frames, "--size", "65x33", "--show", show,
         "--device", "cpu", "-o", out)
    if end == "png":
        picture = np.asarray(Image.open(out))
        assert picture.shape == (33, 65, 3) and len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
    assert out.stat().st_size > 1000


def test_a_view_of_an_orbit(tmp_path):
    io.write_gaussians(tmp_path / "model.ply", model("smoe", 0.0))
    orbit = ["--orbit", "--frames", 5, "--size", "33x21", "--device", "cpu"]
    tool("dsmoe_render", tmp_path / "model.ply", *orbit, "-o", tmp_path / "all")
    tool("dsmoe_render", tmp_path / "model.ply", *orbit, "--view", 3, "-o", tmp_path / "one.png")
    pictures = {name: (tmp_path / name).read_bytes() for name in ("one.png", "all/orbit_3.png", "all/orbit_0.png")}
    assert pictures["one.png"] == pictures["all/orbit_3.png"] != pictures["all/orbit_0.png"]
    said = tool("dsmoe_render", tmp_path / "model.ply", *orbit, "--view", 5, "-o", tmp_path / "no.png", status=2)
    assert "--view" in said and not (tmp_path / "no.png").exists()


def test_a_model_that_records_no_blend_is_alpha_and_says_so(tmp_path):
    picture = ["--orbit", "--frames", 1, "--size", 32, "--device", "cpu", "-o", tmp_path / "out.png", "--overwrite"]
    said, pictures = [], []
    for record, more in ((None, []), (None, ["--blend", "alpha"]), ("alpha", [])):
        io.write_gaussians(tmp_path / "model.ply", model(record))
        said.append("records no blend, so it is alpha" in tool("dsmoe_render", tmp_path / "model.ply", *picture, *more))
        pictures.append((tmp_path / "out.png").read_bytes())
    assert said == [True, False, False] and pictures[0] == pictures[1] == pictures[2]


def test_another_blend_than_the_trained_one_is_said(tmp_path):
    io.write_gaussians(tmp_path / "model.ply", model("smoe", 0.0))
    said = tool("dsmoe_render", tmp_path / "model.ply", "--orbit", "--frames", 1, "--size", 32, "--blend", "alpha",
                "--device", "cpu", "-o", tmp_path / "out.png")
    assert 'trained with the blend "smoe";' in said


def test_a_splat_is_drawn_as_its_ply(tmp_path):
    gaussians = model("alpha")
    flat = io.Gaussians(gaussians.means3D, gaussians.dc, np.zeros((150, 0, 3), np.float32), gaussians.opacity_logits,
                        gaussians.log_scales, gaussians.rotations, "alpha")
    io.write_gaussians(tmp_path / "model.ply", flat)
    rotation = flat.rotations / np.linalg.norm(flat.rotations, axis=1, keepdims=True)
    rows = np.zeros(150, dtype=[("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
    rows["mean"], rows["scale"] = flat.means3D, np.exp(flat.log_scales)
    rows["color"][:, :3] = np.rint(np.clip(0.5 + 0.28209479 * flat.dc[:, 0], 0, 1) * 255)
    rows["color"][:, 3] = np.rint(255 / (1 + np.exp(-flat.opacity_logits[:, 0])))
    rows["rotation"] = np.clip(np.rint(rotation * 128 + 128), 0, 255)
    (tmp_path / "model.splat").write_bytes(rows.tobytes())
    pictures = []
    for words, note in (["model.ply"], ""), (["model.splat"], "no blend, so"), (["model.splat", "--blend", "smoe"], ""):
        said = tool("dsmoe_render", tmp_path / words[0], "--cameras", write_cameras(tmp_path, "cameras.json"),
                    "--device", "cpu", "--overwrite", "-o", tmp_path / "out.png", *words[1:])
        assert ("note: " in said) == bool(note) and note in said
        pictures.append(np.asarray(Image.open(tmp_path / "out.png")).astype(int))
    # 8 bits of a quaternion turn a Gaussian by up to half a degree, and 30 Gaussians lie on a pixel.
    assert np.abs(pictures[0] - pictures[1]).mean() < 1 and np.abs(pictures[0] - pictures[1]).max() < 12
    assert np.abs(pictures[0] - pictures[2]).mean() > 5, "declared to be of smoe"


@pytest.mark.parametrize("name", ["view.png", "out.mp4", "out.png"])
def test_a_file_that_is_there_is_replaced_only_where_asked(tmp_path, name):
    io.write_gaussians(tmp_path / "model.ply", model("alpha"))
    (tmp_path / name).write_text("mine")
    words = [tmp_path / "model.ply", "--cameras", write_cameras(tmp_path, "cameras.json"), "--device", "cpu", "-o",
             tmp_path if name == "view.png" else tmp_path / name]
    said = tool("dsmoe_render", *words, status=2)
    assert f'{name}" is there already; --overwrite' in said and (tmp_path / name).read_text() == "mine"
    tool("dsmoe_render", *words, "--overwrite")
    assert (tmp_path / name).stat().st_size > 100


@pytest.mark.parametrize("name, file", [("dsmoe_fit2d", "profile.csv"), ("dsmoe_occluder", "a.png")])
def test_results_that_are_there_stay(tmp_path, name, file):
    (tmp_path / file).write_text("mine")
    words = ["--edge", 64, "--kernels", 2, "-o", tmp_path] if name == "dsmoe_fit2d" else ["-o", tmp_path / file]
    assert f'{file}" is there already' in tool(name, *words, status=2)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_a_name_that_no_view_has_is_said_with_some_that_are(tmp_path):
    io.write_gaussians(tmp_path / "model.ply", model("alpha"))
    cameras = write_cameras(tmp_path, "cameras.json")
    camera = json.loads(cameras.read_text())[0]
    cameras.write_text(json.dumps([{**camera, "img_name": f"street_{i}"} for i in range(4)]))
    words = [tmp_path / "model.ply", "--cameras", cameras, "--device", "cpu", "-o", tmp_path / "out.png", "--view"]
    said = tool("dsmoe_render", *words, "images/street.png", status=2)
    assert ('--view is "images/street.png", and there is no such view; it must be a number from 0 to 3, or a name: '
            '"street_0", "street_1", "street_2", ... (') in said
    assert '--view is "4"; it must be a number from 0 to 3' in tool("dsmoe_render", *words, 4, status=2)
    tool("dsmoe_render", *words, "street_2")


def test_a_picture_that_is_not_there_is_said_without_a_warning_of_opencv(tmp_path):
    said = tool("dsmoe_fit2d", tmp_path / "no.png", "-o", tmp_path / "out", status=1)
    assert said == f"dsmoe_fit2d: {tmp_path / 'no.png'}: no such file\n"
    (tmp_path / "text.png").write_text("mine")
    assert "is not a picture" in tool("dsmoe_fit2d", tmp_path / "text.png", "-o", tmp_path / "out", status=1)


@pytest.mark.parametrize("name", ["dsmoe_render", "dsmoe_fit2d"])
def test_help_and_wrong_options(name):
    assert f"usage: {name}" in tool(name, "--help")
    assert "--colour" in tool(name, "--colour", status=2)


def psnr_of(said):
    return float(said.split("PSNR ")[1].split()[0])


def test_two_equal_kernels_make_a_sharp_edge_under_the_gate(tmp_path):
    """Figure 2."""
    said = tool("dsmoe_fit2d", "--edge", 64, "--kernels", 2, "--shape", "equal", "-o", tmp_path)
    assert psnr_of(said) >= 40
    names = {"reconstruction.png", "gates.png", "segments.png", "profile.png", "profile.csv", "kernels.csv"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_two_kernels_cannot_under_the_weighted_sum(tmp_path):
    """Figure 3."""
    said = tool("dsmoe_fit2d", "--edge", 64, "--kernels", 2, "--mixture", "sum", "-o", tmp_path)
    assert psnr_of(said) < 20
