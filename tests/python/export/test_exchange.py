"""`dsmoe export` to .glb and .spz: against the texts of the two formats, and read by programs that are not ours."""
from __future__ import annotations

import dataclasses
import json
import struct
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diff_smoe_rasterization import io, rasterize, settings_from_camera
from diff_smoe_rasterization.reference import sh_basis
from dsmoe.cli import main
from dsmoe.errors import TrainerError
from dsmoe.inspection import open_trained
from dsmoe.results.glb import glb_bytes
from dsmoe.results.shown import y_up
from dsmoe.starting import read_start

COUNT = 20
KHR = "KHR_gaussian_splatting"
OURS = "DSMOE_gaussian_splatting_blend"
HARMONICS = [f"{KHR}:SH_DEGREE_{degree}_COEF_{place}" for degree in (1, 2, 3) for place in range(2 * degree + 1)]


def cloud(blend_mode="alpha", background_gate=None, **arrays):
    random = np.random.RandomState(0)
    arrays = {"means3D": random.uniform(-9, 9, (COUNT, 3)), "dc": random.uniform(-1.5, 1.5, (COUNT, 1, 3)),
              "shs": random.uniform(-0.9, 0.9, (COUNT, 15, 3)), "opacity_logits": random.normal(0, 2, (COUNT, 1)),
              "log_scales": random.uniform(-6, 1, (COUNT, 3)), "rotations": random.normal(0, 1, (COUNT, 4)), **arrays}
    arrays = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    return io.Gaussians(**arrays, blend_mode=blend_mode, background_gate=background_gate)


@pytest.fixture
def export(tmp_path):
    """Exports a model to a file of this name; returns its path."""
    def to(gaussians, name, *arguments):
        model, path = str(tmp_path / "trained.ply"), tmp_path / name
        io.write_gaussians(model, gaussians)
        assert main(["export", model, "-o", str(path), *arguments]) == 0
        return path
    return to


def read_glb(content):
    """The JSON and the arrays by attribute, as section 4.4 of glTF 2.0 says."""
    magic, version, length, json_length, json_type = struct.unpack_from("<4sII I4s", content)
    assert (magic, version, length, json_type) == (b"glTF", 2, len(content), b"JSON")
    assert json_length % 4 == 0 and content[20:20 + json_length].rstrip(b" ").endswith(b"}")
    document = json.loads(content[20:20 + json_length])
    binary_length, binary_type = struct.unpack_from("<I4s", content, 20 + json_length)
    binary = content[28 + json_length:]
    assert binary_type == b"BIN\0" and len(binary) == binary_length and binary_length % 4 == 0
    assert document["buffers"] == [{"byteLength": binary_length}], "without uri it is the BIN chunk"
    arrays = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        kind, size = {5126: ("<f4", 4), 5123: ("<u2", 2)}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteOffset"] % 4 == 0 and view["byteLength"] == accessor["count"] * width * size
        data = binary[view["byteOffset"]:view["byteOffset"] + view["byteLength"]]
        arrays[name] = np.frombuffer(data, kind).reshape(accessor["count"], width)
    return document, arrays


def test_a_glb_of_alpha_is_what_the_specification_says(export):
    document, arrays = read_glb(export(cloud(), "model.glb").read_bytes())
    assert document["asset"]["version"] == "2.0"
    assert document["extensionsUsed"] == [KHR] and "extensionsRequired" not in document
    assert document["scenes"][document["scene"]]["nodes"] == [0] and document["nodes"] == [{"mesh": 0}]
    primitive, = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0, "POINTS"
    assert primitive["extensions"] == {KHR: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    # The table of attributes: type and component type of each.
    expected = {"POSITION": ("VEC3", 5126), f"{KHR}:ROTATION": ("VEC4", 5126), f"{KHR}:SCALE": ("VEC3", 5126),
                f"{KHR}:OPACITY": ("SCALAR", 5126), "COLOR_0": ("VEC4", 5123),
                **{name: ("VEC3", 5126) for name in [f"{KHR}:SH_DEGREE_0_COEF_0", *HARMONICS]}}
    accessors = {name: document["accessors"][index] for name, index in primitive["attributes"].items()}
    assert {name: (of["type"], of["componentType"]) for name, of in accessors.items()} == expected
    assert all(of["count"] == COUNT and "byteOffset" not in of for of in accessors.values())
    assert accessors["COLOR_0"]["normalized"] is True
    # glTF: min and max are required of POSITION, as exact float32 numbers.
    assert accessors["POSITION"]["min"] == arrays["POSITION"].min(axis=0).tolist()
    assert accessors["POSITION"]["max"] == arrays["POSITION"].max(axis=0).tolist()
    for name, array in arrays.items():
        assert np.isfinite(array).all(), name


def test_the_values_of_a_glb_are_in_its_units_and_axes(export):
    model = cloud()
    _, arrays = read_glb(export(model, "model.glb").read_bytes())
    x, y, z = model.means3D.T
    assert np.array_equal(arrays["POSITION"], np.stack([x, -y, -z], axis=1)), "y points up, and z backward"
    # Linear scales, opacity after the sigmoid: a rounding of float32 each.
    assert np.allclose(arrays[f"{KHR}:SCALE"], np.exp(model.log_scales), rtol=1e-6)
    opacity = 1 / (1 + np.exp(-model.opacity_logits))
    assert np.allclose(arrays[f"{KHR}:OPACITY"], opacity, rtol=1e-6)
    # The covariance, by the specification's matrix C of quaternions (x, y, z, w), is the model's in turned axes.
    rotations, turn = arrays[f"{KHR}:ROTATION"], np.diag([1.0, -1, -1])
    assert np.allclose(np.linalg.norm(rotations, axis=1), 1, atol=1e-6)
    for (qx, qy, qz, qw), scale, mine, logs in zip(rotations, arrays[f"{KHR}:SCALE"], model.rotations,
                                                   model.log_scales):
        c = matrix(qx, qy, qz, qw) * scale
        w, i, j, k = mine / np.linalg.norm(mine)
        own = matrix(i, j, k, w) * np.exp(logs)
        # A float32 rounding of each factor, against the largest entry.
        assert np.allclose(c @ c.T, turn @ own @ own.T @ turn, atol=1e-5 * np.exp(2 * logs.max()))


def matrix(x, y, z, w):
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_colours_of_a_glb_are_the_models_from_every_side(export, degree):
    """The specification's sum of harmonics, in its axes, against the oracle's in the scene's."""
    model = cloud()
    _, arrays = read_glb(export(model, "model.glb", "--sh-degree", str(degree)).read_bytes())
    kept = (degree + 1) ** 2 - 1
    assert [name for name in HARMONICS if name in arrays] == HARMONICS[:kept]
    directions = np.random.RandomState(1).normal(0, 1, (COUNT, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = sh_basis(degree, torch.tensor(directions)).numpy()
    coefficients = np.concatenate([model.dc, model.shs[:, :kept]], axis=1)
    expected = (basis[:, :, None] * coefficients).sum(axis=1)
    x, y, z = directions[:, 0], -directions[:, 1], -directions[:, 2]
    functions = [
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.092548430592079 * x * y, -1.092548430592079 * y * z, 0.3153915652525200 * (2 * z**2 - x**2 - y**2),
        -1.092548430592079 * x * z, 0.5462742152960395 * (x**2 - y**2),
        -0.5900435899266435 * y * (3 * x**2 - y**2), 2.890611442640554 * x * y * z,
        -0.4570457994644657 * y * (4 * z**2 - x**2 - y**2), 0.3731763325901154 * z * (2 * z**2 - 3 * x**2 - 3 * y**2),
        -0.4570457994644657 * x * (4 * z**2 - x**2 - y**2), 1.445305721320277 * z * (x**2 - y**2),
        -0.5900435899266435 * x * (x**2 - 3 * y**2)]
    colour = 0.2820947917738781 * arrays[f"{KHR}:SH_DEGREE_0_COEF_0"].astype(float)
    for name, function in zip(HARMONICS[:kept], functions):
        colour += arrays[name] * function[:, None]
    assert np.allclose(colour, expected, atol=1e-6), "constants have 7 digits in the oracle's float32"


def test_a_glb_is_rendered_as_the_model_is(export):
    """By the rasterizer, from its arrays, with the camera in its axes."""
    model = cloud(log_scales=np.random.RandomState(1).uniform(-1.5, 1, (COUNT, 3)))
    _, arrays = read_glb(export(model, "model.glb").read_bytes())

    def rendered(turn, means, opacities, scales, rotations, shs):
        settings = settings_from_camera([[60, 0, 40], [0, 60, 30], [0, 0, 1]], turn, torch.tensor([0.0, 0, 15]), 80, 60,
                                        blend_mode="alpha", sh_degree=3)
        values = [torch.tensor(np.array(array, np.float32)) for array in (means, opacities, scales, rotations, shs)]
        return rasterize(*values[:2], settings, scales=values[2], shs=values[4],
                         rotations=torch.nn.functional.normalize(values[3])).color

    expected = rendered(torch.eye(3), model.means3D, 1 / (1 + np.exp(-model.opacity_logits)), np.exp(model.log_scales),
                        model.rotations, np.concatenate([model.dc, model.shs], axis=1))
    shs = np.stack([arrays[name] for name in [f"{KHR}:SH_DEGREE_0_COEF_0", *HARMONICS]], axis=1)
    image = rendered(torch.diag(torch.tensor([1.0, -1, -1])), arrays["POSITION"], arrays[f"{KHR}:OPACITY"],
                     arrays[f"{KHR}:SCALE"], arrays[f"{KHR}:ROTATION"][:, [3, 0, 1, 2]], shs)
    assert expected.std() > 0.1 and (image - expected).abs().max() < 1e-5, "float32 roundings of what was activated"


def test_a_glb_shows_points_where_gaussians_are_unknown(export):
    """COLOR_0 is linear: 0.5 in sRGB is 0.2140, 1 is 1; its fourth number is the opacity."""
    half_and_full = cloud(dc=np.tile([[[0, 1 / 0.5641896, -9]]], (COUNT, 1, 1)), opacity_logits=np.zeros((COUNT, 1)))
    _, arrays = read_glb(export(half_and_full, "model.glb").read_bytes())
    steps = arrays["COLOR_0"] / 65535
    assert np.allclose(steps, [0.21404, 1, 0, 0.5], atol=1e-4)


def test_viewers_refuse_a_glb_of_another_blend(export, capsys):
    path = export(cloud("smoe", 0.25), "model.glb")
    document, arrays = read_glb(path.read_bytes())
    mode = open_trained(str(path.parent / "trained.ply")).renderer.blend_mode
    assert f"the .glb requires {OURS}, so that no viewer shows its {mode} by alpha" in capsys.readouterr().out
    assert set(document["extensionsRequired"]) == set(document["extensionsUsed"]) == {KHR, OURS}
    splatting = document["meshes"][0]["primitives"][0]["extensions"][KHR]
    assert mode != "alpha" and splatting["extensions"] == {OURS: {"blendMode": mode, "backgroundGate": 0.25}}
    assert "COLOR_0" not in arrays, "nothing to fall back to"


def test_a_glb_says_which_faint_pairs_count_and_is_read_so(export, tmp_path):
    path = export(dataclasses.replace(cloud("smoe", 0.0), comments=("faint_below 2",)), "model.glb")
    content = path.read_bytes()
    splatting = read_glb(content)[0]["meshes"][0]["primitives"][0]["extensions"][KHR]
    assert splatting["extensions"][OURS] == {"blendMode": "smoe", "backgroundGate": 0, "faintBelow": 2}
    assert read_start(str(path)).faint_below == 2
    assert read_start(str(export(cloud("smoe", 0.0), "usual.glb"))).faint_below is None
    bad = tmp_path / "bad.glb"
    bad.write_bytes(content.replace(b'"faintBelow":2.0', b'"faintBelow":-20'))
    with pytest.raises(TrainerError, match="faint_below '-20'; it must be a number of at least 0"):
        read_start(str(bad))


def test_smoe_with_the_gate_of_alpha_is_alpha(export, capsys):
    document, _ = read_glb(export(cloud("smoe_eq7", 1.0), "model.glb").read_bytes())
    assert document["extensionsUsed"] == [KHR] and "note:" not in capsys.readouterr().out


def test_a_glb_leaves_out_what_no_viewer_can_show(export):
    positions, rotations = cloud().means3D.copy(), cloud().rotations.copy()
    positions[0, 1], rotations[1] = np.nan, 0
    _, arrays = read_glb(export(cloud(means3D=positions, rotations=rotations), "model.glb").read_bytes())
    assert {len(array) for array in arrays.values()} == {COUNT - 2}
    assert np.array_equal(arrays["POSITION"][0], positions[2] * [1, -1, -1])


@pytest.mark.parametrize("ending", ["splat", "spz", "glb"])
def test_a_model_that_shows_nothing_is_refused(tmp_path, monkeypatch, capsys, ending):
    monkeypatch.setitem(sys.modules, "gsply", SimpleNamespace())
    nothing, path = str(tmp_path / "nothing.ply"), tmp_path / f"nothing.{ending}"
    io.write_gaussians(nothing, cloud(rotations=np.zeros((COUNT, 4))))
    assert main(["export", nothing, "-o", str(path)]) == 1
    assert capsys.readouterr().err == ("dsmoe export: error: the model has no Gaussian that can be shown; a .splat, "
                                       ".spz or .glb holds one at least\n")
    assert not path.exists()


def with_document(path, change):
    """Changes the JSON of a .glb."""
    content = path.read_bytes()
    length, = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20:20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length:]
    path.write_bytes(struct.pack("<4sII I4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest)


@pytest.mark.parametrize("change, words", [
    (lambda d: d["nodes"][0].update(rotation=[0.7071, 0, 0, 0.7071]), "its node 0 moves the Gaussians by a rotation"),
    (lambda d: d.update(nodes=[{"mesh": 0}, {"children": [0], "scale": [2, 2, 2]}]), "its node 1 moves the Gaussians"),
    (lambda d: d["meshes"].append(d["meshes"][0]), "it holds 2 clouds of Gaussians; only a file of one is read"),
    (lambda d: d["meshes"][0]["primitives"][0]["extensions"][KHR].update(colorSpace="lin_rec709_display"),
     "the colour space 'lin_rec709_display'; only srgb_rec709_display is read")])
def test_a_glb_that_viewers_show_otherwise_is_refused(export, tmp_path, capsys, change, words):
    path = export(cloud(), "model.glb")
    with_document(path, change)
    assert main(["export", str(path), "-o", str(tmp_path / "copy.ply")]) == 1
    assert words in capsys.readouterr().err


def test_nodes_that_do_not_move_the_gaussians_change_nothing(export, tmp_path):
    path = export(cloud(), "model.glb")
    with_document(path, lambda d: d.update(nodes=[
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        {"camera": 0, "translation": [1, 2, 3]}, {"children": [0, 1], "scale": [1, 1, 1]}]))
    assert main(["export", str(path), "-o", str(tmp_path / "copy.ply")]) == 0
    assert np.array_equal(io.read_gaussians(str(tmp_path / "copy.ply")).means3D, cloud().means3D)


def test_pygltflib_reads_a_glb(export):
    pygltflib = pytest.importorskip("pygltflib", reason="pip install pygltflib")
    path = export(cloud("smoe_tn"), "model.glb")
    document = pygltflib.GLTF2().load_binary(str(path))
    assert sorted(document.extensionsRequired) == sorted([KHR, OURS])
    primitive = document.meshes[0].primitives[0]
    assert primitive.extensions[KHR]["extensions"][OURS] == {"blendMode": "smoe_tn", "backgroundGate": 0}
    accessor = document.accessors[primitive.attributes.POSITION]
    view = document.bufferViews[accessor.bufferView]
    data = document.binary_blob()[view.byteOffset:view.byteOffset + view.byteLength]
    assert np.array_equal(np.frombuffer(data, "<f4").reshape(-1, 3), cloud().means3D * [1, -1, -1])


def test_gsply_reads_an_spz_to_the_bits_of_the_format(export, capsys):
    """The format's steps: 24-bit positions, 1/255, 1/16 in log scales, 1/(0.15 255) and 1/128 in harmonics."""
    gsply = pytest.importorskip("gsply", reason="pip install gsply")
    model = y_up(cloud())
    read = gsply.read_spz(str(export(cloud("smoe", 0.25), "model.spz")))
    assert ".spz holds gates; viewers of 3DGS blend them by alpha" in capsys.readouterr().out
    assert np.allclose(read.means, model.means3D, rtol=0, atol=2.0**-20), "coordinates below 16 leave 19 bits"
    assert np.allclose(1 / (1 + np.exp(-read.opacities)), 1 / (1 + np.exp(-model.opacity_logits[:, 0])),
                       atol=0.51 / 255)
    assert np.allclose(read.scales, model.log_scales, atol=0.51 / 16)
    assert np.allclose(read.sh0, model.dc[:, 0], atol=0.51 / (0.15 * 255))
    assert np.allclose(read.shN, model.shs, atol=0.51 / 128)
    unit = model.rotations / np.linalg.norm(model.rotations, axis=1, keepdims=True)
    same = np.abs((read.quats * unit).sum(axis=1))  # q and -q are one rotation
    assert (same > 1 - 1e-5).all(), "three components of 9 bits and a sign: 0.0014 / 2 each"


@pytest.mark.parametrize("largest, bits", [(0.5, 20), (7.9, 20), (8.0, 19), (1000.0, 13), (8000.0, 10), (1e9, 10)])
def test_an_spz_has_as_many_bits_behind_the_point_as_there_is_room_for(largest, bits):
    from dsmoe.results.spz import fractional_bits

    assert fractional_bits(np.array([[0, -largest, 0.1]], np.float32)) == bits


def test_an_spz_brings_what_is_too_far_nearer_along_its_ray(export):
    """8192 units are the most; the far Gaussian stays where it is seen from the origin, and as large there."""
    gsply = pytest.importorskip("gsply", reason="pip install gsply")
    positions, log_scales = cloud().means3D, cloud().log_scales
    positions[0], log_scales[0] = [30000, -60000, 6000], 1
    read = gsply.read_spz(str(export(cloud(means3D=positions, log_scales=log_scales), "model.spz")))
    near = 8192 / 60000
    assert np.allclose(read.means[0], np.array([30000, 60000, -6000]) * near, atol=0.01)
    assert np.allclose(read.scales[0], 1 + np.log(near), atol=0.51 / 16)
    assert np.allclose(read.means[1:], positions[1:] * [1, -1, -1], rtol=0, atol=2.0**-11), "10 bits are left"


def test_an_spz_without_gsply_is_refused_with_the_command_that_helps(export, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "gsply", None)
    model, path = str(tmp_path / "trained.ply"), tmp_path / "model.spz"
    io.write_gaussians(model, cloud())
    assert main(["export", model, "-o", str(path)]) == 1
    assert "pip install gsply; it needs Python 3.10" in capsys.readouterr().err and not path.exists()


@pytest.mark.parametrize("ending, content, words", [
    ("glb", b"", "not a .glb of Gaussians: it has 0 bytes, of 20 at least"),
    ("glb", b"glTF" + bytes(6), "not a .glb of Gaussians: it has 10 bytes, of 20 at least"),
    ("glb", bytes(20), "it is not a binary glTF"),
    ("glb", struct.pack("<4s2II4s", b"glTF", 2, 30, 10, b"JSON") + b"{}",
     "not a .glb of Gaussians: it has 22 bytes, but its JSON ends at byte 30 (truncated file?)"),
    ("glb", struct.pack("<4s2II4s", b"glTF", 2, 22, 2, b"JSON") + b"{}", "not a .glb of Gaussians: it has no 'meshes'"),
    ("glb", struct.pack("<4s2II4s", b"glTF", 2, 22, 2, b"JSON") + b"{{",
     "not a .glb of Gaussians: its JSON is not valid (Expecting property name"),
    ("spz", b"", "gsply cannot read it: too short\n")])
def test_what_cannot_be_read_is_named_in_a_line(tmp_path, monkeypatch, capsys, ending, content, words):
    """With its own path, not that of the copy that gsply reads, whose errors end with it."""
    def read_spz(path):
        raise ValueError(f"too short: {path}")

    monkeypatch.setitem(sys.modules, "gsply", SimpleNamespace(read_spz=read_spz))
    path = tmp_path / f"model.{ending}"
    path.write_bytes(content)
    assert main(["export", str(path), "-o", str(tmp_path / "copy.ply")]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"dsmoe export: error: {path}: {words}") and said.count("\n") == 1


def test_a_glb_of_more_than_4_GiB_is_refused(monkeypatch):
    from dsmoe.results import glb

    monkeypatch.setattr(glb, "LARGEST", 4000)
    with pytest.raises(TrainerError, match="a lower --sh-degree makes it smaller"):
        glb_bytes(cloud(), None)


def test_gsply_reads_a_ply_as_it_was_written(export):
    gsply = pytest.importorskip("gsply", reason="pip install gsply")
    model = cloud()
    read = gsply.plyread(str(export(model, "model.ply")))
    for mine, theirs in ((model.means3D, read.means), (model.log_scales, read.scales), (model.rotations, read.quats),
                         (model.opacity_logits[:, 0], read.opacities), (model.dc[:, 0], read.sh0),
                         (model.shs, read.shN)):
        assert np.array_equal(mine, theirs)
