"""The benchmark commands run, and the memory that a rendering keeps is what the project promises."""
from __future__ import annotations

import json
import os
import sys

import pytest
import torch
from devices import without_cuda_because

from diff_smoe_rasterization.settings import BLEND_MODES

BENCHMARKS = os.path.join(os.path.dirname(__file__), "..", "..", "benchmarks")
sys.path[:0] = [BENCHMARKS, os.path.join(BENCHMARKS, "timing")]
import cpu_rasterizer  # noqa: E402
import gpu_floor  # noqa: E402
import gpu_rasterizer  # noqa: E402
import memory  # noqa: E402
import models  # noqa: E402
import tables  # noqa: E402


@pytest.fixture(autouse=True)
def same_number_of_threads_afterwards():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_the_command_measures_every_case(tmp_path, capsys):
    path = tmp_path / "out.json"
    assert cpu_rasterizer.main(["--synthetic", "300", "--repeats", "1", "--threads", "1,2",
                                "--modes", "alpha,smoe_eq7,smoe_eq7:0.5", "--no-memory", "--json", str(path)]) == 0
    rows = {(row["mode"], row["threads"]): row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}
    assert sorted(rows) == [(mode, threads) for mode in ("alpha", "smoe_eq7", "smoe_eq7:0.5") for threads in (1, 2)]
    for row in rows.values():
        stages = [row[name] for name in cpu_rasterizer.STAGES]
        assert min(stages) > 0
        assert sum(stages) <= row["total"]
        # A gate reaches 4.8 sigma, an alpha at most 3.33, the background's gate lies between. Threads change nothing.
        assert 0 < rows["alpha", 1]["forward_pairs"] < rows["smoe_eq7:0.5", 1]["forward_pairs"]
        assert rows["smoe_eq7:0.5", 1]["forward_pairs"] < rows["smoe_eq7", 1]["forward_pairs"]
        assert row["forward_pairs"] == rows[row["mode"], 1]["forward_pairs"]
    assert "times the floor" in capsys.readouterr().out


def test_the_command_refuses_what_does_not_fit(capsys):
    for arguments, reason in ((["--synthetic", "9", "--modes", "alpha:0.5"], "--modes"), ([], "--synthetic"),
                              (["--ply", "a.ply"], "--scene"), (["--synthetic", "9", "--views", "1"], "--views")):
        with pytest.raises(SystemExit):
            cpu_rasterizer.main(arguments)
        assert reason in capsys.readouterr().err


@pytest.mark.parametrize("mode", BLEND_MODES)
def test_a_graph_keeps_less_than_the_limits(mode):
    model = models.synthetic(2000)
    counts, kept = memory.kept_tensors(model.inputs, model.settings(0, mode))
    assert counts[:2] == (2000, 800 * 533)
    assert counts.instances > 2000
    by_unit = memory.per_unit(counts, kept)
    assert all(0 < by_unit[unit] <= memory.LIMITS[unit] for unit in memory.UNITS)
    # Whatever no unit explains is one number a tile.
    unexplained = sum(size for _, size in kept) - sum(count * by_unit[unit] for count, unit in zip(counts, by_unit))
    assert 0 <= unexplained <= 8 * (800 // 16 * (533 // 16 + 1) + 1)


def test_a_packed_model_is_the_model(tmp_path):
    model = models.synthetic(50, 64, 48)
    models.to_npz(model, str(tmp_path / "model.npz"))
    packed = models.from_npz(str(tmp_path / "model.npz"))
    for name, tensor in model.inputs.items():
        torch.testing.assert_close(packed.inputs[name], tensor, rtol=1e-5, atol=1e-6)  # log and exp, logit and sigmoid
    assert packed.settings(0, "smoe")[:4] == model.settings(0, "smoe")[:4]
    assert torch.equal(packed.settings(0, "smoe").projmatrix, model.settings(0, "smoe").projmatrix)
    assert packed.sh_degree == 3
    smaller = packed._replace(cameras=packed.cameras * 5).seen(2, 32, 24)
    assert [(camera.width, camera.height, camera.fx) for camera in smaller.cameras] == [(32, 24, 32.0)] * 2


def test_the_gpu_floor_by_hand():
    """One Gaussian of 236 parameter bytes in one tile of one pixel."""
    counts = gpu_floor.Counts(gaussians=1, visible=1, instances=1, pixels=1, forward_pairs=0, backward_pairs=0,
                              parameter_bytes=236)
    moved = {"project": 12 + 4 + 224 + 48, "sort": 4 + 4 * 16, "bin": 32 + 4, "blend": 4 + 48 + 24,
             "blend_backward": 4 + 48 + 24 + 12 + 40, "project_backward": 40 + 32 + 236 + 236}
    floors = gpu_floor.floors("alpha", counts)
    assert {name: floor.seconds * 4.2e12 for name, floor in floors.items()} == pytest.approx(moved)
    many = gpu_floor.floors("smoe", counts._replace(forward_pairs=33.4e12))["blend"]
    assert many.seconds == many.instructions == pytest.approx(gpu_floor.FORWARD["smoe"])


def test_the_gpu_tables():
    rows = [{"renderer": "inria", "forward_ms": 2.0, "total_ms": 6.0, "note": "first"},
            {"renderer": "ours alpha", "forward_ms": 0.5, "total_ms": 2.0, "psnr_worst": 71.26, "psnr": 72.0,
             "stages": {"blend": dict(ms=0.3, floor_ms=0.1, bytes_ms=0.05, instructions_ms=0.1)},
             "counts": dict(visible=5e5, gaussians=1e6, instances=2e6, pixels=1e6, forward_pairs=9e7,
                            backward_pairs=5e7)},
            {"renderer": "gsplat", "error": "ImportError: no gsplat"}]
    table = gpu_rasterizer.comparison_table(rows)
    assert "| ours alpha | 0.500 | 2.000 | 4.00 | 3.00 |" in table and "| 71.3 |" in table
    assert "- gsplat: ImportError: no gsplat" in table and "- inria: first" in table
    stages = gpu_rasterizer.stage_table(rows)
    assert "| floor, ms | 0.100 (pairs) | 0.100 |" in stages and "| times the floor | 3.0 |" in stages
    assert "2.00 M tile instances, 90 and 50 pairs a pixel" in stages


def test_the_gpu_command_refuses_what_does_not_fit(capsys, tmp_path):
    (tmp_path / "inria").mkdir()
    (tmp_path / "inria" / "diff_gaussian_rasterization").mkdir()
    (tmp_path / "gsplat").mkdir()  # empty: not installed
    options = gpu_rasterizer.parse(["--synthetic", "9", "--peers-path", str(tmp_path)])
    assert options.renderers[:2] == ["inria", "ours alpha"] and "gsplat" not in options.renderers
    options = gpu_rasterizer.parse(["--synthetic", "9", "--renderers", "ours smoe:0.3,ours smoe,ours alpha"])
    assert options.renderers == ["ours alpha", "ours smoe", "ours smoe:0.3"]
    for arguments, reason in (([], "--synthetic"), (["--ply", "a.ply"], "--scene"),
                              (["--synthetic", "9", "--renderers", "none"], "--renderers"),
                              (["--synthetic", "9", "--renderers", "ours alpha,ours smoe:-1"], "--renderers"),
                              (["--synthetic", "9", "--renderers", "ours smoe"], "--renderers")):
        with pytest.raises(SystemExit):
            gpu_rasterizer.parse(arguments)
        assert reason in capsys.readouterr().err


@pytest.mark.skipif(without_cuda_because() is not None, reason=f"without CUDA: {without_cuda_because()}")
def test_frames_without_room_are_slower(capsys):
    import gpu_overflow
    assert gpu_overflow.main(["--synthetic", "100000", "--repeats", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    times = {name: float(value.split()[0]) for name, value in (line.split(": ") for line in lines)}
    for name in ("forward", "forward + backward"):
        assert times[name + ", no room"] > 2 * times[name + ", room"] > 0  # they look at all Gaussians in every tile


@pytest.mark.skipif(without_cuda_because() is not None, reason=f"without CUDA: {without_cuda_because()}")
def test_the_gpu_command_measures(tmp_path, capsys):
    path = tmp_path / "out.json"
    assert gpu_rasterizer.main(["--synthetic", "3000", "--repeats", "2", "--warmup", "1", "--renderers",
                                "ours alpha,ours smoe:0.3,ours alpha deterministic", "--json", str(path)]) == 0
    rows = {row["renderer"]: row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}
    assert [row.get("error") for row in rows.values()] == [None] * 3
    assert all(row["forward_ms"] > 0 and row["total_ms"] > 0 and row["peak_mib"] > 0 for row in rows.values())
    twin = rows["ours alpha deterministic"]
    assert twin["psnr_worst"] > 80 and twin["cosine"] > 0.9999
    assert "times the floor" in capsys.readouterr().out


needs_rows = pytest.mark.skipif(not any(tables.RESULTS.glob("*.jsonl")),
                                reason="the rows are in the repository, not in its source distribution")


@needs_rows
def test_the_tables_of_the_pages_are_those_of_the_rows():
    for page, texts in tables.tables().items():
        with open(os.path.join(BENCHMARKS, "..", page), encoding="utf-8") as file:
            said = file.read()
        for text in texts:
            assert text in said, f"{page}: `python benchmarks/tables.py` prints another table:\n{text}"


def test_a_table_has_the_mean_and_the_deviation_of_its_rows():
    rows = [dict(scene="fox", strategy="importance", budget=4000, densify_grad_threshold=0.0002, blend_mode=blend,
                 seed=seed, psnr=psnr, psnr_edge=psnr - 2 * seed, ssim=ssim, lpips={"value": ssim / 2})
            for blend, seed, psnr, ssim in (("alpha", 0, 30.0, 0.5), ("smoe", 1, 31.5, 0.75), ("alpha", 1, 32.0, 0.7),
                                            ("smoe", 0, 30.5, 0.85))]
    assert tables.budget_table(rows).splitlines()[2] == (
        "| fox, 4,000 | 31.00±1.41, 0.300 | 31.00±0.71, 0.400 | +0.50, -0.50 | +0.00 |")
    assert tables.thousands([{"num_gaussians": 1_198_600}]) == "1,199k"
    assert tables.thousands([{"num_gaussians": 99_940}]) == "99.9k"


@needs_rows
def test_rows_are_read_as_the_report_reads_them():
    pytest.importorskip("pydantic")
    from dsmoe.bench.rows import read_rows

    read = {row["cell"]: row for row in read_rows(str(tables.RESULTS / "near_h100.jsonl"))}
    assert {row["cell"]: row for row in tables.rows_of("near_h100.jsonl")} == read


@pytest.mark.parametrize("name, told", [("nowhere/x.png", "its folder is not there"), ("x.xyz", "name a .png")])
def test_a_figure_that_cannot_be_written_is_told_before_the_tables(tmp_path, capsys, name, told):
    with pytest.raises(SystemExit):
        tables.main(["--figure", str(tmp_path / name)])
    said = capsys.readouterr()
    assert said.out == "" and f"error: --figure {tmp_path / name}: {told}" in said.err


@needs_rows
def test_the_figure_has_a_point_for_each_number(tmp_path):
    pytest.importorskip("matplotlib")
    series = tables.points_of_bonsai()
    assert {"alpha", "smoe"} == {blend for _, blend in series}
    assert [round(number, -3) for number, _ in series["importance", "alpha"]] == [
        1000, 3000, 10000, 30000, 100000, 256000, 512000]
    tables.draw(str(tmp_path / "figure.png"))
    assert (tmp_path / "figure.png").stat().st_size > 10_000
