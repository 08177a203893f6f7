"""`dsmoe export`: files that other programs read, what they lose, and what is refused."""
from __future__ import annotations

import dataclasses
import os
import struct
import warnings

import numpy as np
import pytest

from diff_smoe_rasterization import io
from dsmoe.cli import main
from dsmoe.export import html
from dsmoe.results.splat import splat_bytes

QUARTER = np.sqrt(0.5)  # cos and sin of an eighth turn


def gaussians(blend_mode="smoe_eq7", background_gate=0.25, **arrays):
    """Two Gaussians: the second is larger, and both turned by quarter turns."""
    arrays = {"means3D": [[1, 2, 3], [4, 5, 6]], "dc": [[[0, 1, -1]], [[9, 0, -9]]],
              "shs": np.arange(48 * 2 - 6).reshape(2, 15, 3) / 50 - 0.5, "opacity_logits": [[0], [np.log(3)]],
              "log_scales": np.log([[0.1, 0.2, 0.3], [1, 2, 3]]),
              "rotations": [[2, 0, 0, 2], [0, 1, 0, 0]], **arrays}
    arrays = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    return io.Gaussians(**arrays, blend_mode=blend_mode, background_gate=background_gate)


@pytest.fixture
def model(tmp_path):
    path = str(tmp_path / "trained.ply")
    io.write_gaussians(path, gaussians())
    return path


def test_a_ply_records_its_blend_and_says_that_viewers_show_it_wrongly(model, tmp_path, capsys):
    copy = str(tmp_path / "copy.ply")
    assert main(["export", model, "-o", copy, "--sh-degree", "1"]) == 0
    assert "the smoe_eq7 .ply holds gates; viewers of 3DGS blend them by alpha" in capsys.readouterr().out
    before, after = io.read_gaussians(model), io.read_gaussians(copy)
    assert (after.blend_mode, after.background_gate, after.sh_degree) == ("smoe_eq7", 0.25, 1)
    assert np.array_equal(after.shs, before.shs[:, :3]) and np.array_equal(after.log_scales, before.log_scales)


def test_a_model_of_alpha_goes_without_a_warning(tmp_path, capsys):
    model, copy = str(tmp_path / "trained.ply"), str(tmp_path / "copy.ply")
    io.write_gaussians(model, gaussians("alpha", None))
    assert main(["export", model, "-o", copy]) == 0
    assert "viewers" not in capsys.readouterr().out


def test_a_splat_file_has_32_bytes_a_gaussian_the_largest_first(model, tmp_path, capsys):
    path = tmp_path / "model.splat"
    assert main(["export", model, "-o", str(path)]) == 0
    assert "the smoe_eq7 .splat holds gates" in capsys.readouterr().out
    content = path.read_bytes()
    assert len(content) == 64
    first, second = struct.iter_unpack("<6f8B", content)
    assert first[:3] == (4, 5, 6) and first[3:6] == pytest.approx((1, 2, 3))
    assert first[6:10] == (255, 128, 0, 191)  # colours are cut to [0, 1]; opacity 3/4
    assert first[10:] == (128, 255, 128, 128)  # half a turn about x
    assert second[:3] == (1, 2, 3) and second[3:6] == pytest.approx((0.1, 0.2, 0.3))
    # 0.5 + 0.2821 (0, 1, -1)
    assert second[6:10] == (128, 199, 56, 128)
    eighth = round(128 + 128 * QUARTER)
    assert second[10:] == (eighth, 128, 128, eighth)


@pytest.mark.parametrize("arrays", [
    {"rotations": [[0, 0, 0, 0], [0, 1, 0, 0]]}, {"means3D": [[np.nan, 2, 3], [4, 5, 6]]},
    {"opacity_logits": [[np.inf], [np.log(3)]]}, {"log_scales": [[1e4, 0, 0], np.log([1, 2, 3])]}])
def test_a_splat_file_leaves_out_what_no_viewer_can_show(arrays):
    whole = splat_bytes(gaussians())
    assert splat_bytes(gaussians(**arrays)) == whole[:32], "the second, which is first in the file"


def test_an_opacity_of_nothing_is_no_overflow_of_a_splat_file():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        records = np.frombuffer(splat_bytes(gaussians(opacity_logits=[[1000], [-1000]])), np.uint8).reshape(-1, 32)
    assert records[:, 27].tolist() == [255, 0]


def test_a_model_without_gaussians_is_an_empty_page(tmp_path):
    nothing = gaussians(**{name: np.zeros((0, *shape)) for name, shape in [
        ("means3D", (3,)), ("dc", (1, 3)), ("shs", (15, 3)), ("opacity_logits", (1,)), ("log_scales", (3,)),
        ("rotations", (4,))]})
    assert html.pack(nothing) == (0, b"", b"")
    path, page = str(tmp_path / "nothing.ply"), tmp_path / "page.html"
    io.write_gaussians(path, nothing)
    assert main(["export", path, "-o", str(page)]) == 0
    assert '"count": 0' in page.read_text()


def test_a_page_holds_every_gaussian_to_the_bits_it_promises():
    random = np.random.RandomState(0)
    model = gaussians(means3D=random.normal(0, 9, (50, 3)), dc=random.normal(0, 1, (50, 1, 3)),
                      shs=random.normal(0, 0.3, (50, 15, 3)), opacity_logits=random.normal(0, 4, (50, 1)),
                      log_scales=random.normal(-4, 2, (50, 3)), rotations=random.normal(0, 1, (50, 4)))
    count, first, second = html.pack(model)
    assert (count, len(first), len(second)) == (50, 50 * 32, 50 * 48)
    records = np.frombuffer(first, html.RECORD)
    assert np.array_equal(records["position"], model.means3D)
    opacity = 1 / (1 + np.exp(-model.opacity_logits[:, 0]))
    assert np.allclose(records["opacity"], opacity, rtol=2**-11, atol=2**-25)  # float16 has 11 bits
    assert np.allclose(records["log_scales"], model.log_scales, rtol=2**-11)
    vectors = records["rotation"] / 32767 / np.sqrt(2)
    real = np.sqrt(1 - (vectors**2).sum(axis=1))
    assert (real > 0.5 - 1e-4).all(), "of a unit quaternion's components the largest is 1/2 or more"
    for mine, theirs in zip(np.column_stack([real, vectors]), model.rotations):
        # The same axes but for their signs; 16 bits of each component make 1e-4 of a turn.
        assert np.allclose(np.abs(axes(mine).T @ axes(theirs / np.linalg.norm(theirs))), np.eye(3), atol=2e-4)
    bytes_of = np.frombuffer(second, np.uint8).reshape(50, 48)
    scale = bytes_of[:, :2].copy().view("<f2").astype(float)
    steps = bytes_of[:, 2:47].copy().view(np.int8).reshape(50, 15, 3)
    assert np.abs(steps * scale[:, :, None] / 127 - model.shs).max() <= (scale.max() / 127) * 0.51


def axes(q):
    w, x, y, z = q
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


def test_a_page_leaves_out_what_the_rasterizer_culls():
    positions = np.array([[1, 2, np.nan], [4, 5, 6]], np.float32)
    count, first, _ = html.pack(dataclasses.replace(gaussians(), means3D=positions))
    assert count == 1 and np.frombuffer(first, html.RECORD)["position"].tolist() == [[4, 5, 6]]


@pytest.mark.filterwarnings("error")
def test_a_page_holds_extreme_numbers():
    extreme = gaussians(opacity_logits=[[-1e38], [1e38]], log_scales=[[-1e38, 0, 1], [1, 2, 3]])
    count, first, _ = html.pack(extreme)
    records = np.frombuffer(first, html.RECORD)
    assert count == 2 and records["opacity"].tolist() == [0, 1]
    assert np.isfinite(records["log_scales"]).all() and records["log_scales"][0, 0] < -60_000


@pytest.mark.parametrize("lost", [[np.nan, 2, 3], [1, -np.inf, 3], [1e30, 2, 3]])
def test_one_gaussian_without_a_place_spoils_no_page(tmp_path, lost):
    path, page = str(tmp_path / "model.ply"), tmp_path / "page.html"
    io.write_gaussians(path, gaussians(means3D=[[4, 5, 6], lost]))
    assert main(["export", path, "-o", str(page)]) == 0
    assert '"target": [4.0, 5.0, 6.0]' in page.read_text()


@pytest.mark.parametrize("array", ["means3D", "opacity_logits", "log_scales", "shs"])
def test_a_model_of_which_nothing_can_be_shown_is_refused(tmp_path, capsys, array):
    path, value = str(tmp_path / "model.ply"), np.inf if array == "log_scales" else np.nan
    io.write_gaussians(path, gaussians(**{array: np.full(getattr(gaussians(), array).shape, value)}))
    for arguments in (["export"], ["render", "--orbit"]):
        assert main([*arguments, path, "-o", str(tmp_path / "out.html")]) == 1
        assert f"{path}: each of its 2 Gaussians has a number that is NaN or infinite" in capsys.readouterr().err


def test_a_page_is_one_file_that_loads_nothing(model, tmp_path):
    path = tmp_path / "page.html"
    assert main(["export", model, "-o", str(path)]) == 0
    text = path.read_text(encoding="utf-8")
    assert "{{" not in text and "http" not in text and "src=" not in text
    assert '"mode": "smoe_eq7", "gate": 0.25' in text


@pytest.mark.parametrize("mode, said, drawn, warns", [
    ("smoe", (), 0.25, False), ("smoe", ("faint_below 2",), 2.0, False),
    ("smoe_eq7", (), 0.25, False), ("smoe_eq7", ("faint_below 0.9",), 0.9, True)])
def test_a_page_draws_faint_pairs_where_the_model_has_them(tmp_path, capsys, monkeypatch, mode, said, drawn, warns):
    monkeypatch.setenv("DSMOE_FAINT_BELOW", "0.5")  # is for trainings
    model, page = str(tmp_path / "trained.ply"), tmp_path / "page.html"
    io.write_gaussians(model, dataclasses.replace(gaussians(mode, 0.0), comments=said))
    assert main(["export", model, "-o", str(page)]) == 0
    assert f'"faintBelow": {drawn},' in page.read_text()
    assert ("note: of smoe_eq7 the page draws all pairs" in capsys.readouterr().out) == warns


@pytest.mark.parametrize("arguments, text", [
    (["-o", "model.obj"], "model.obj: its ending is none of html, ply, splat"),
    (["-o", "model.PLY", "--format", "splat"], "model.PLY: its ending says ply, and --format says splat"),
    (["-o", "trained.ply"], "trained.ply is there already; --overwrite replaces it"),
    *((["-o", "trained.ply", "--overwrite", *form], "is the model itself") for form in ([], ["--format", "ply"])),
    (["-o", "a.html", "--blend-mode", "alpha"], "trained with the blend mode smoe_eq7, not alpha"),
    (["-o", "a.html", "--background-gate", "0.5"], "trained with the background gate 0.25, not 0.5"),
])
def test_what_cannot_be_written_is_refused(model, tmp_path, monkeypatch, capsys, arguments, text):
    monkeypatch.chdir(tmp_path)
    assert main(["export", model, *arguments]) == 1
    assert text in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["trained.ply"]


@pytest.mark.parametrize("name", ["thesis.html", "thesis.ply", "thesis.splat"])
def test_a_file_that_is_there_is_replaced_only_where_asked(model, tmp_path, capsys, name):
    path = tmp_path / name
    path.write_text("mine")
    assert main(["export", model, "-o", str(path)]) == 1
    assert f"{name} is there already; --overwrite replaces it" in capsys.readouterr().err
    assert path.read_text() == "mine"
    assert main(["export", model, "-o", str(path), "--overwrite"]) == 0
    assert path.stat().st_size > 50 and sorted(os.listdir(tmp_path)) == sorted([name, "trained.ply"])
    path.unlink()
    os.mkfifo(path)
    assert main(["export", model, "-o", str(path), "--overwrite"]) == 1
    assert "is not a regular file" in capsys.readouterr().err and not path.is_file()


def test_a_page_refuses_the_ablations(tmp_path, capsys):
    model = str(tmp_path / "trained.ply")
    io.write_gaussians(model, gaussians("smoe_tn", None))
    assert main(["export", model, "-o", str(tmp_path / "a.html")]) == 1
    assert "a page shows alpha, smoe and smoe_eq7, but the model was trained with smoe_tn" in capsys.readouterr().err
