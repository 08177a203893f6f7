"""Files of models, points and COLMAP scenes: against parsers and bytes of this test's own, and against real scenes."""
from __future__ import annotations

import os
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diff_smoe_rasterization import io

DATA = Path(os.environ.get("DSMOE_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data"))


def data_folder(name):
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"test data is absent: {folder}")
    return folder


def make_gaussians(count, sh_degree, **others):
    random = np.random.default_rng(sh_degree)
    shapes = {
        "means3D": (count, 3),
        "dc": (count, 1, 3),
        "shs": (count, (sh_degree + 1) ** 2 - 1, 3),
        "opacity_logits": (count, 1),
        "log_scales": (count, 3),
        "rotations": (count, 4),
    }
    arrays = {name: random.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}
    return io.Gaussians(**arrays, **others)


ARRAYS = ("means3D", "dc", "shs", "opacity_logits", "log_scales", "rotations")


def parse_float_ply(path):
    """The least parser that reads what 3DGS writes: binary little endian, float columns. Returns header and columns."""
    header, body = Path(path).read_bytes().split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    values = np.frombuffer(body, dtype="<f4").reshape(count, len(names))
    return lines, dict(zip(names, values.T))


@pytest.mark.parametrize("sh_degree", range(4))
def test_written_model_is_what_an_independent_parser_reads(tmp_path, sh_degree):
    model = make_gaussians(5, sh_degree, blend_mode="smoe")
    io.write_gaussians(tmp_path / "a.ply", model)
    lines, columns = parse_float_ply(tmp_path / "a.ply")
    assert "comment blend_mode smoe" in lines
    rest = (sh_degree + 1) ** 2 - 1
    expected = {axis: model.means3D[:, i] for i, axis in enumerate("xyz")}
    expected.update({f"n{axis}": np.zeros(5) for axis in "xyz"})
    expected.update({f"f_dc_{channel}": model.dc[:, 0, channel] for channel in range(3)})
    # Inria's order: all coefficients of red, then green, then blue.
    expected.update({f"f_rest_{c * rest + k}": model.shs[:, k, c] for c in range(3) for k in range(rest)})
    expected["opacity"] = model.opacity_logits[:, 0]
    expected.update({f"scale_{i}": model.log_scales[:, i] for i in range(3)})
    expected.update({f"rot_{i}": model.rotations[:, i] for i in range(4)})
    assert list(columns) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)


@pytest.mark.parametrize("sh_degree", range(4))
def test_model_reads_back_as_written(tmp_path, sh_degree):
    model = make_gaussians(5, sh_degree, blend_mode="smoe_std", comments=("made for a test",))
    io.write_gaussians(str(tmp_path / "a.ply"), model)
    read = io.read_gaussians(str(tmp_path / "a.ply"))
    for name in ARRAYS:
        array = getattr(read, name)
        assert array.dtype == np.float32 and array.flags.writeable
        np.testing.assert_array_equal(array, getattr(model, name), err_msg=name)
    assert read.sh_degree == sh_degree
    assert read.blend_mode == "smoe_std"
    assert read.comments == ("made for a test", "blend_mode smoe_std")


def test_blend_mode_that_a_file_does_not_record_is_none(tmp_path):
    io.write_gaussians(tmp_path / "a.ply", make_gaussians(1, 0))
    assert io.read_gaussians(tmp_path / "a.ply").blend_mode is None


def test_two_blend_modes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="two blend modes"):
        io.write_gaussians(tmp_path / "a.ply", make_gaussians(1, 0, blend_mode="smoe", comments=("blend_mode alpha",)))
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize("gate", [0.0, 0.1, float(np.float32(0.1)), 1 / 3])
def test_background_gate_reads_back_exactly(tmp_path, gate):
    io.write_gaussians(tmp_path / "a.ply", make_gaussians(1, 0, blend_mode="smoe", background_gate=gate))
    assert io.read_gaussians(tmp_path / "a.ply").background_gate == gate


def test_what_is_no_background_gate_is_refused(tmp_path):
    with pytest.raises(ValueError, match="a.ply: .*\"-1\".*0 or more"):
        io.write_gaussians(tmp_path / "a.ply", make_gaussians(1, 0, background_gate=-1.0))
    with pytest.raises(ValueError, match="two background gates"):
        io.write_gaussians(tmp_path / "a.ply", make_gaussians(1, 0, background_gate=0.1,
                                                              comments=("background_gate 0.2",)))
    io.write_gaussians(tmp_path / "a.ply", make_gaussians(1, 0))
    assert io.read_gaussians(tmp_path / "a.ply").background_gate is None
    content = (tmp_path / "a.ply").read_bytes().replace(b"element", b"comment background_gate faint\nelement", 1)
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match='a.ply, line 3: .*"faint"'):
        io.read_gaussians(tmp_path / "a.ply")


def test_other_dtypes_and_layouts_are_converted(tmp_path):
    model = make_gaussians(4, 1)
    strided = {name: np.asfortranarray(getattr(model, name).astype(np.float64)) for name in ARRAYS}
    io.write_gaussians(tmp_path / "a.ply", io.Gaussians(**strided))
    read = io.read_gaussians(tmp_path / "a.ply")
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(read, name), getattr(model, name), err_msg=name)


def test_empty_model_keeps_its_shapes(tmp_path):
    io.write_gaussians(tmp_path / "a.ply", make_gaussians(0, 3))
    read = io.read_gaussians(tmp_path / "a.ply")
    assert [getattr(read, name).shape for name in ARRAYS] == [(0, 3), (0, 1, 3), (0, 15, 3), (0, 1), (0, 3), (0, 4)]


@pytest.mark.parametrize("name", ARRAYS)
def test_wrong_shape_is_named(tmp_path, name):
    model = make_gaussians(4, 1)
    wrong = replace(model, **{name: getattr(model, name)[..., :-1]})
    with pytest.raises(ValueError, match=rf"write_gaussians: {name} has shape \[.*\]; it must be \["):
        io.write_gaussians(tmp_path / "a.ply", wrong)


def test_number_of_coefficients_must_be_a_whole_degree(tmp_path):
    model = make_gaussians(4, 1)
    with pytest.raises(ValueError, match=r"shs has shape \[4, 2, 3\]"):
        io.write_gaussians(tmp_path / "a.ply", replace(model, shs=model.shs[:, :2]))


def test_missing_file_is_not_found(tmp_path):
    for read in (io.read_gaussians, io.read_points, io.read_colmap_cameras):
        with pytest.raises(FileNotFoundError, match="missing.ply") as caught:
            read(tmp_path / "missing.ply")
        assert caught.value.filename == str(tmp_path / "missing.ply")
    with pytest.raises(IsADirectoryError):
        io.read_points(tmp_path)
    with pytest.raises(FileNotFoundError):
        io.write_points(tmp_path / "no folder" / "a.ply", io.Points(np.zeros((1, 3))))


def test_path_that_is_not_utf8(tmp_path):
    path = os.fsencode(tmp_path / "a") + b"\xff.ply"
    name = os.fsdecode(path)
    try:
        open(name, "wb").close()
    except OSError:
        pytest.skip("this file system stores UTF-8 names only")
    with pytest.raises(ValueError, match="no PLY file"):
        io.read_gaussians(name)
    io.write_gaussians(name, make_gaussians(1, 0))
    assert len(io.read_gaussians(name).means3D) == 1


def test_an_unfinished_file_is_not_written_through_a_link(tmp_path):
    (tmp_path / "precious").write_text("mine")
    os.symlink(tmp_path / "precious", tmp_path / "a.ply.partial")
    io.write_gaussians(tmp_path / "a.ply", make_gaussians(1, 0))
    assert (tmp_path / "precious").read_text() == "mine" and len(io.read_gaussians(tmp_path / "a.ply").means3D) == 1
    assert sorted(os.listdir(tmp_path)) == ["a.ply", "precious"]


def test_malformed_model_names_file_and_reason(tmp_path):
    path = tmp_path / "a.ply"
    io.write_gaussians(path, make_gaussians(3, 0))
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(ValueError, match="a.ply, byte .*truncated"):
        io.read_gaussians(path)
    path.write_bytes(content.replace(b"property float opacity\n", b"property float opaque_\n"))
    with pytest.raises(ValueError, match='a.ply: .*"opacity"'):
        io.read_gaussians(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    with pytest.raises(ValueError, match="no PLY file"):
        io.read_gaussians(path)


POINT_TYPES = [("x", "f4"), ("y", "f8"), ("z", "i2"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("w", "u4")]
PLY_NAMES = {"f4": "float", "f8": "double", "i2": "short", "u1": "uchar", "u4": "uint"}


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_of_any_layout(tmp_path, layout):
    values = np.zeros(3, dtype=POINT_TYPES)
    values["x"], values["y"], values["z"] = [0.5, -1, 2], [1e-3, 0, -7], [-300, 0, 300]
    values["red"], values["green"], values["blue"] = [255, 0, 1], [2, 3, 4], [0, 128, 9]
    header = f"ply\nformat {layout} 1.0\nelement vertex 3\n"
    header += "".join(f"property {PLY_NAMES[kind]} {name}\n" for name, kind in POINT_TYPES) + "end_header\n"
    if layout == "ascii":
        body = "".join(" ".join(str(value) for value in row.tolist()) + "\n" for row in values).encode()
    else:
        order = "<" if layout == "binary_little_endian" else ">"
        body = values.astype([(name, order + kind) for name, kind in POINT_TYPES]).tobytes()
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    points = io.read_points(tmp_path / "a.ply")
    assert points.positions.dtype == np.float64 and points.colors.dtype == np.uint8 and points.normals is None
    np.testing.assert_array_equal(points.positions, np.stack([values[c].astype(np.float64) for c in "xyz"], 1))
    np.testing.assert_array_equal(points.colors, np.stack([values[c] for c in ("red", "green", "blue")], 1))


def test_points_read_back_as_written(tmp_path):
    random = np.random.default_rng(0)
    positions = random.standard_normal((6, 3)).astype(np.float32)  # what the file can hold
    colors = random.integers(0, 256, (6, 3), dtype=np.uint8)
    normals = random.standard_normal((6, 3)).astype(np.float32)
    io.write_points(tmp_path / "a.ply", io.Points(positions, colors, normals, ("one", "two")))
    read = io.read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.positions, positions)
    np.testing.assert_array_equal(read.colors, colors)
    np.testing.assert_array_equal(read.normals, normals)
    assert read.comments == ("one", "two")
    io.write_points(tmp_path / "b.ply", io.Points(positions))
    assert io.read_points(tmp_path / "b.ply").colors is None


def test_points_with_wrong_arrays_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"write_points: positions has shape \[4, 2\]"):
        io.write_points(tmp_path / "a.ply", io.Points(np.zeros((4, 2))))
    with pytest.raises(ValueError, match="colors has type float64; it must be uint8"):
        io.write_points(tmp_path / "a.ply", io.Points(np.zeros((4, 3)), np.ones((4, 3))))
    with pytest.raises(ValueError, match=r"colors has shape \[3, 3\]; it must be \[4, 3\]"):
        io.write_points(tmp_path / "a.ply", io.Points(np.zeros((4, 3)), np.ones((3, 3), np.uint8)))


def write_binary_scene(folder):
    """A model of one camera, two images (one with observations) and two points (one with a track), byte by byte."""
    folder.mkdir(parents=True)
    camera = struct.pack("<IiQQ4d", 7, 1, 640, 480, 500.0, 510.0, 320.5, 239.5)
    images = struct.pack("<I7dI", 2, 1, 0, 0, 0, 0.5, -1.0, 2.0, 7) + b"b/two.jpg\0" + struct.pack("<Q", 0)
    images += struct.pack("<I7dI", 1, 0, 3, 0, 0, 0, 0, 0, 7) + b"one.jpg\0" + struct.pack("<Q", 1)
    images += struct.pack("<ddq", 1.0, 2.0, -1)
    points = struct.pack("<Q3d3BdQ", 5, 1.0, 2.0, 3.0, 10, 20, 30, 0.25, 1) + struct.pack("<II", 1, 0)
    points += struct.pack("<Q3d3BdQ", 2**40, -1.0, -2.0, -3.0, 255, 0, 1, 0.5, 0)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + images)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 2) + points)


def check_scene(model):
    assert list(model.cameras) == [7]
    camera = model.cameras[7]
    assert (camera.id, camera.model, camera.width, camera.height) == (7, "PINHOLE", 640, 480)
    assert camera.params.tolist() == [500.0, 510.0, 320.5, 239.5]
    assert [(image.id, image.name) for image in model.images] == [(2, "b/two.jpg"), (1, "one.jpg")]
    assert [image.camera_id for image in model.images] == [7, 7]
    assert model.images[0].tvec.tolist() == [0.5, -1.0, 2.0]
    assert model.images[1].qvec.tolist() == [0.0, 1.0, 0.0, 0.0]  # stored with length 3
    assert model.points.positions.tolist() == [[1, 2, 3], [-1, -2, -3]]
    assert model.points.colors.tolist() == [[10, 20, 30], [255, 0, 1]]
    assert model.point_errors.tolist() == [0.25, 0.5]


@pytest.mark.parametrize("place", ["", "sparse/0", "sparse"])
def test_colmap_model_is_found_and_read(tmp_path, place):
    write_binary_scene(tmp_path / "scene" / place)
    model = io.read_colmap(tmp_path / "scene")
    check_scene(model)
    assert Path(model.folder) == tmp_path / "scene" / place


@pytest.mark.parametrize("text", [False, True])
def test_colmap_model_reads_back_as_written(tmp_path, text):
    write_binary_scene(tmp_path / "a")
    io.write_colmap(tmp_path / "b", io.read_colmap(tmp_path / "a"), text=text)
    extension = "txt" if text else "bin"
    assert sorted(os.listdir(tmp_path / "b")) == [f"{name}.{extension}" for name in ("cameras", "images", "points3D")]
    check_scene(io.read_colmap(tmp_path / "b"))


def test_colmap_folder_without_a_model_says_where_it_looked(tmp_path):
    with pytest.raises(FileNotFoundError, match="cameras.bin nor cameras.txt.*sparse/0.*sparse"):
        io.read_colmap(tmp_path)


def test_colmap_errors_name_the_file(tmp_path):
    write_binary_scene(tmp_path / "a")
    images = tmp_path / "a" / "images.bin"
    content = images.read_bytes()
    images.write_bytes(content[:-3])
    with pytest.raises(ValueError, match="images.bin, byte"):
        io.read_colmap(tmp_path / "a")
    images.write_bytes(content.replace(struct.pack("<I", 7) + b"one.jpg", struct.pack("<I", 8) + b"one.jpg"))
    with pytest.raises(ValueError, match="one.jpg.*refers to camera 8"):
        io.read_colmap(tmp_path / "a")
    images.unlink()
    with pytest.raises(FileNotFoundError, match="images.bin"):
        io.read_colmap(tmp_path / "a")


def test_colmap_camera_model_must_be_known_to_be_written(tmp_path):
    write_binary_scene(tmp_path / "a")
    model = io.read_colmap(tmp_path / "a")
    cameras = {7: replace(model.cameras[7], model="PIN_HOLE")}
    with pytest.raises(ValueError, match="unknown camera model PIN_HOLE"):
        io.write_colmap(tmp_path / "b", replace(model, cameras=cameras))


# Scene, images and points as the README of the data states them, and the size of the images it names.
SCENES = [("bonsai", 292, 105145, (800, 533)), ("fox", 50, 13710, (534, 948)), ("room35", 35, 5740, (960, 540))]


@pytest.mark.parametrize("name, num_images, num_points, size", SCENES)
def test_real_scenes(name, num_images, num_points, size):
    folder = data_folder(name)
    model = io.read_colmap(folder)
    assert len(model.images) == num_images
    assert model.points.positions.shape == model.points.colors.shape == (num_points, 3)
    assert {(camera.model, camera.width, camera.height) for camera in model.cameras.values()} == {("PINHOLE", *size)}
    listed = {path.name for path in (folder / "images").iterdir()}
    assert {image.name for image in model.images} <= listed
    assert colour_agreement(folder, model) > 0.4


def colour_agreement(folder, model):
    """Correlation of the points' colours with the pixels of the first image that they project to.

    Hidden points pull it below 1. Measured: 0.53 (bonsai), 0.61 (fox), 0.82 (room35); with the rotation transposed
    -0.13, -0.05, 0.15.
    """
    image_module = pytest.importorskip("PIL.Image")
    image = model.images[0]
    camera = model.cameras[image.camera_id]
    w, x, y, z = image.qvec
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    view = model.points.positions @ rotation.T + image.tvec
    in_front = view[:, 2] > 0
    fx, fy, cx, cy = camera.params
    pixels = np.floor(view[in_front, :2] / view[in_front, 2:] * [fx, fy] + [cx, cy])
    inside = np.all((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=1)
    column, row = pixels[inside].astype(int).T
    seen = np.asarray(image_module.open(folder / "images" / image.name).convert("RGB"))[row, column]
    return np.corrcoef(seen.ravel(), model.points.colors[in_front][inside].ravel())[0, 1]


@pytest.mark.parametrize("name, num_points", [("garden_geometry", 138766), ("bicycle_geometry", 54275)])
def test_real_geometry_without_images(name, num_points):
    folder = data_folder(name)
    assert len(io.read_points(folder / "points3D.ply").positions) == num_points
    cameras = io.read_colmap_cameras(folder / "cameras.bin")
    assert [camera.model for camera in cameras.values()] == ["PINHOLE"]
