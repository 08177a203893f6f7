"""The benchmark's report: averages, tables beside the paper's, deltas, failures, survey rows, refusals."""
from __future__ import annotations

import csv
import io
import json
import math

import pytest
from report_rows import PROTOCOL, failed, row, write_rows

from diff_smoe_rasterization.benchmarks.suite import rows
from diff_smoe_rasterization.benchmarks.suite.report import ReportError, groups, layouts, survey, tables


def table_of(entries, name, suite="table1"):
    """The table NAME of rows; None where the suite has none."""
    made = layouts.tables_of(suite, entries, layouts.read_paper())
    return next((table for table in made if table.name == f"{suite}_{name}"), None)


def shown(table, **labels):
    """{column: text} of the only row of ours with these labels."""
    wanted = {table.labels.index(name): value for name, value in labels.items()}
    found = [line for line in table.rows if line.source == tables.OURS
             and all(line.labels[index] == value for index, value in wanted.items())]
    assert len(found) == 1, [line.labels for line in table.rows]
    return {column.full_name: cell.shown(column) for column, cell in zip(table.columns, found[0].cells)}


def test_a_cell_is_the_mean_over_seeds_with_its_spread():
    entries = [row(seed=seed, psnr=psnr) for seed, psnr in enumerate((23.0, 24.0, 25.0))]
    line = shown(table_of(entries, "cells"), scene="bonsai")
    assert line["PSNR [dB]"] == "24.00 ± 1.00"
    assert line["PSNR at edges [dB]"] == "22.00 ± 1.00"
    assert line["own size [MB]"] == "2.0 ± 0.0"
    assert line["LPIPS Alex"] == "0.250 ± 0.000"
    assert "GPU peak [MiB]" not in line  # no row has it
    assert shown(table_of(entries[:1], "cells"), scene="bonsai")["PSNR [dB]"] == "23.00"  # one seed has no spread


def test_an_average_is_of_the_seeds_that_every_scene_has_in_both_modes():
    """Seeds that differ by more than the modes do: an average over whichever there are would turn the sign."""
    alpha = [row(scene, seed=seed, psnr=15.0 + 3 * seed) for scene in ("truck", "train") for seed in range(3)]
    smoe = [row(entry["scene"], "smoe", seed=entry["seed"], psnr=entry["psnr"] + 1)
            if (entry["scene"], entry["seed"]) not in (("truck", 1), ("truck", 2), ("train", 2)) else
            failed(scene=entry["scene"], blend_mode="smoe", seed=entry["seed"]) for entry in alpha]
    table, name = table_of(alpha + smoe, "table1"), "Tanks and Temples"
    for mode, psnr in (("alpha", "15.00"), ("smoe", "16.00")):
        line = shown(table, method=f"native, {mode}")
        assert (line[f"{name} PSNR [dB]"], line[f"{name} seeds"]) == (psnr, "1 of 3")
    assert [note for note in table.notes if "averages leave" in note] == [
        "sparse, native: averages leave seed 1 out, since smoe failed on truck.",
        "sparse, native: averages leave seed 2 out, since smoe failed on train, smoe failed on truck."]
    # A mode that lacks a scene has no average, and takes no seed from the other.
    line = shown(table_of(alpha + [row("truck", "smoe")], "table1"), method="native, alpha")
    assert (line[f"{name} PSNR [dB]"], line[f"{name} seeds"]) == ("18.00 ± 3.00", "3")
    apart = [row("truck", seed=0), row("train", seed=1)]
    assert shown(table_of(apart, "table1"), end="sparse")[f"{name} PSNR [dB]"] == "no common seed"


def test_the_papers_figures_stand_beside_ours_and_are_marked():
    table = table_of([row(), row(threshold=0.0002, psnr=30.0), row("fox")], "table1")
    heading = "Mip-NeRF 360 (ours: bonsai)"
    printed = {line.labels: line for line in table.rows if line.source == tables.PAPER}
    columns = [column.full_name for column in table.columns]
    gated = printed["sparse", "3DSMoES"].cells
    figures = [gated[columns.index(f"{heading} {name}")].shown(None)
               for name in ("PSNR [dB]", "SSIM", "LPIPS, paper's", "#G [M]", "own size [MB]")]
    assert figures == ["24.43", "0.69", "0.39", "0.064", "15.4"]
    assert printed["dense", "2DGS"].cells[0].shown(None) == "26.88"
    assert gated[columns.index("fox PSNR [dB]")].value is None
    assert any("bonsai alone; the paper averages 9 scenes" in note for note in table.notes)
    assert any("Deep Blending and Tanks and Temples are left out" in note for note in table.notes)


def test_a_scene_is_of_the_data_set_that_its_row_names(tmp_path):
    """A made-up scene may have the name of one of the paper's."""
    assert table_of([row("room", dataset=None)], "table1") is None
    line = shown(table_of([row("my_truck", dataset="Tanks and Temples")], "table1"), end="sparse")
    assert line["Tanks and Temples (ours: my_truck) PSNR [dB]"] == "20.00"
    entries = [row("room", dataset=None), row("my_truck", dataset="Tanks and Temples")]
    survey.write_survey(entries, layouts.read_paper()["datasets"], str(tmp_path))
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.csv")} == {
        "other/room.csv", "TanksAndTemples/my_truck.csv"}


def test_other_trainers_stand_in_table_2():
    entries = [row("truck", method="taming", variant="patched", fps=100.0),
               row("truck", "smoe", method="taming", variant="patched", psnr=21.0)]
    table = table_of(entries, "table2")
    assert shown(table, method="taming, smoe")["PSNR [dB]"] == "21.00"
    assert shown(table, method="taming, alpha")["FPS"] == "100"
    printed = next(line for line in table.rows if line.labels == ("sparse", "3DSMoES-Taming"))
    assert printed.source == tables.PAPER and [cell.printed for cell in printed.cells][-3:-1] == ["280", "194"]
    assert table_of([row()], "table2") is None


def test_deltas_are_of_the_seeds_that_both_modes_have():
    entries = [row(seed=0, psnr=20.0), row(seed=1, psnr=22.0), row(seed=2, psnr=50.0),
               row(blend_mode="smoe", seed=0, psnr=23.0, num_gaussians=20000),
               row(blend_mode="smoe", seed=1, psnr=24.0, num_gaussians=30000)]
    line = shown(table_of(entries, "deltas"), seeds="2")
    assert line["Δ PSNR [dB]"] == "+2.50 ± 0.71"  # 3 and 2
    assert line["#Gaussians ratio"] == "0.62 ± 0.18"  # 0.5 and 0.75: 0.625, to even
    worse = [row(psnr=20.0), row(blend_mode="smoe", psnr=19.0)]
    assert shown(table_of(worse, "deltas"), scene="bonsai")["Δ PSNR [dB]"] == "-1.00"
    same = [row(psnr=20.001), row(blend_mode="smoe", psnr=20.0)]
    assert shown(table_of(same, "deltas"), scene="bonsai")["Δ PSNR [dB]"] == "0.00"


def test_each_gate_of_smoe_is_a_blend_of_its_own():
    """Rows of before there were gates are of gate 0; each gate is compared with alpha and with that."""
    smoe = {"blend_mode": "smoe"}
    entries = [row(background_gate=1.0), row(psnr=21.0, **smoe), row(psnr=23.0, seed=1, background_gate=0.0, **smoe),
               row(psnr=24.5, background_gate=0.05, **smoe), row(blend_mode="smoe_tn", background_gate=0.0),
               row(psnr=24.0, background_gate="learned", protocol={"background_gate": 0.25}, **smoe)]
    lines = table_of(entries, "cells").rows
    assert [line.labels[1].partition(", ")[2] for line in lines] == ["alpha", "smoe", "smoe 0.05", "smoe learned",
                                                                     "smoe_tn"]
    assert shown(table_of(entries, "cells"), method="native, smoe", seeds="2")["PSNR [dB]"] == "22.00 ± 1.41"
    assert shown(table_of(entries, "cells"), method="native, smoe learned")["learned gate"] == "0.250"
    for name, title, delta in (("deltas", "smoe against alpha", "+1.00"),
                               ("deltas_smoe_0.05_alpha", "smoe 0.05 against alpha", "+4.50"),
                               ("deltas_smoe_0.05_smoe", "smoe 0.05 against smoe", "+3.50"),
                               ("deltas_smoe_learned_smoe", "smoe learned against smoe", "+3.00")):
        table = table_of(entries, name)
        assert table.title == f"{title}, all else equal" and shown(table, seeds="1")["Δ PSNR [dB]"] == delta
        assert any(line.source == tables.PAPER for line in table.rows) == (name == "deltas")
    shared_out = table_of([*entries, row(seed=1)], "table1")  # averages of all gates are of the seeds they share
    assert shown(shared_out, method="native, smoe")["Mip-NeRF 360 (ours: bonsai) PSNR [dB]"] == "21.00"
    assert survey.submethod(groups.grouped(entries, layouts.end_of)[2]) == "-native-smoe-0.05-t0.005"


def test_renderings_that_equal_the_ground_truth_have_an_infinite_psnr(tmp_path):
    """json has no number for it: some write null, some Infinity."""
    entries = rows.read_rows(write_rows(tmp_path, [row(psnr=None), row(seed=1), row(blend_mode="smoe", psnr=math.inf),
                                                   row(blend_mode="smoe", seed=1, psnr=21.0)]))
    table = table_of(entries, "cells")
    assert {shown(table, method=f"native, {mode}")["PSNR [dB]"] for mode in ("alpha", "smoe")} == {"inf"}
    assert next(csv.DictReader(io.StringIO(tables.to_csv(table))))["PSNR [dB]"] == "inf"
    assert shown(table_of(entries, "deltas"), scene="bonsai")["Δ PSNR [dB]"] == "+1.00"  # of seed 1
    nothing = row("fox", psnr=None, ssim=None, psnr_edge=None)  # without test views
    assert "PSNR [dB]" not in shown(table_of([nothing], "cells"), scene="fox")


def elsewhere(**changes):
    """A row of another machine, which is ten times as slow."""
    return row(**{"train_seconds": 1000.0, "fps": 20.0, **changes, "machine": {"device": "Card Y"}})


def test_times_of_different_machines_are_neither_averaged_nor_divided():
    entries = [elsewhere(), row(blend_mode="smoe", psnr=21.0), row(seed=1), row(blend_mode="smoe", seed=1)]
    line = shown(table_of(entries, "deltas"), scene="bonsai")
    assert [line[name] for name in ("train ratio", "FPS ratio", "Δ PSNR [dB]")] == ["machines differ"] * 2 + [
        "+0.50 ± 0.71"]
    table = table_of(entries, "cells")
    line = shown(table, method="native, alpha")
    assert [line[name] for name in ("train [s]", "FPS", "PSNR [dB]")] == ["machines differ"] * 2 + ["20.00 ± 0.00"]
    assert shown(table, method="native, smoe")["FPS"] == "200 ± 0"
    assert ("Measured on Card X (native, alpha; native, smoe), Card Y (native, alpha); times and FPS compare on one "
            "machine only.") in table.notes
    # Only seeds that both have are compared.
    line = shown(table_of(entries[1:], "deltas"), scene="bonsai")
    assert (line["train ratio"], line["FPS ratio"]) == ("1.00", "1.00")
    taming = {"method": "taming", "variant": "patched"}
    line = shown(table_of([row("truck", **taming), elsewhere(scene="train", **taming)], "table2"), end="sparse")
    assert (line["PSNR [dB]"], line["train [s]"], line["FPS"]) == ("20.00", "machines differ", "machines differ")


def shared(cells_per_gpu=2, **changes):
    """A row of a cell that shared its GPU: its times are far from those of `row`."""
    return row(**{"train_seconds": 7000.0, "wall_seconds": 8000.0, "fps": 3.0, **changes,
                  "machine": {"device": "Card X", "cells_per_gpu": cells_per_gpu}})


def test_times_of_cells_that_shared_their_gpu_are_left_out():
    entries = [shared(), shared(blend_mode="smoe", psnr=21.0), shared(1, threshold=0.0002),
               row(threshold=0.0002, seed=1, train_seconds=9000.0), shared(threshold=0.0002, seed=2)]
    table = table_of(entries, "cells")
    line = shown(table, method="native, smoe")
    assert [line[name] for name in ("train [s]", "wall [s]", "FPS", "PSNR [dB]")] == ["shared"] * 3 + ["21.00"]
    line = shown(table, threshold="0.0002")  # of the seeds that were alone: 7000 and 9000
    assert line["train [s]"] == "8,000 ± 1,414"
    assert layouts.SHARED_NOTE in table.notes
    delta = table_of(entries, "deltas")
    line = shown(delta, scene="bonsai")
    assert (line["Δ PSNR [dB]"], line["train ratio"], line["FPS ratio"]) == ("+1.00", "shared", "shared")
    assert layouts.SHARED_NOTE in delta.notes and "shared" in tables.to_latex(delta)


def test_a_failed_cell_is_a_row_with_its_reason():
    entries = [row(), failed("out of memory | 12 GiB", blend_mode="smoe"), row("fox", seed=0),
               failed("killed", scene="fox", seed=1)]
    table = table_of(entries, "failures")
    assert {line.labels[1] for line in table.rows} == {"out of memory | 12 GiB", "killed"}
    assert "out of memory \\| 12 GiB" in tables.to_markdown(table)
    assert shown(table_of(entries, "cells"), method="native, smoe")["PSNR [dB]"] == "failed"
    assert shown(table_of(entries, "cells"), scene="fox", seeds="1 of 2")["PSNR [dB]"] == "20.00"
    assert shown(table_of(entries, "deltas"), scene="bonsai")["Δ PSNR [dB]"] == "smoe failed"


def test_csv_is_unrounded_and_complete():
    psnr = 24.123456789
    table = table_of([row(psnr=psnr), row(seed=1, psnr=psnr), row("fox, the \"red\" one")], "cells")
    lines = list(csv.DictReader(io.StringIO(tables.to_csv(table))))
    assert len(lines) == 2 and {line["source"] for line in lines} == {"ours"}
    bonsai = next(line for line in lines if line["scene"] == "bonsai")
    assert float(bonsai["PSNR [dB]"]) == psnr and float(bonsai["PSNR [dB] sd"]) == 0
    fox = next(line for line in lines if line["scene"] == "fox, the \"red\" one")
    assert fox["PSNR [dB] sd"] == "" and fox["#Gaussians"] == "40000"


@pytest.mark.parametrize("name", ["table1", "table3", "deltas", "cells", "failures"])
def test_every_line_of_latex_and_markdown_has_all_columns(name):
    entries = [row(blend_mode=mode, seed=seed) for mode in ("alpha", "smoe", "smoe_tn") for seed in (0, 1)]
    entries.append(failed("50 % of a_b & c\\d #1", scene="fox"))
    table = table_of(entries, name)
    width = 1 + len(table.labels) + len(table.columns)
    body = [line for line in tables.to_latex(table).split("\n") if line.endswith(r"\\") and "multicolumn" not in line]
    assert len(body) == len(table.rows) + 1
    assert {line.replace(r"\&", "").count("&") for line in body} == {width - 1}
    if name == "failures":
        assert r"50 \% of a\_b \& c\textbackslash{}d \#1" in body[-1]
    lines = [line for line in tables.to_markdown(table).split("\n") if line.startswith("|")]
    assert {line.count("|") for line in lines} == {width + 1} and len(lines) == len(table.rows) + 2


def test_survey_rows(tmp_path):
    inria = {"value": 0.2, "kind": "lpips_vgg_inria", "reason": None}
    entries = [row(psnr=31.25, lpips=inria), row(seed=1, psnr=31.75, lpips=inria, num_gaussians=40001),
               row(blend_mode="smoe", schedule="steady", threshold=0.0002), row("lego"), row("my room"),
               failed(scene="truck")]
    survey.write_survey(entries, layouts.read_paper()["datasets"], str(tmp_path))
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.csv")) == [
        "MipNeRF360/bonsai.csv", "SyntheticNeRF/lego.csv", "other/my_room.csv"]
    lines = (tmp_path / "MipNeRF360" / "bonsai.csv").read_text(encoding="utf-8").split("\n")
    assert lines == ["Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians",
                     "-native-alpha-t0.005,31.5,0.75,0.2,2000000,40000",  # 40000.5, to even
                     "-native-smoe-steady-t0.0002,20.0,0.75,,2000000,40000", ""]  # Alex's LPIPS may not stand there


@pytest.mark.parametrize("name, value", [("background", "white"), ("image_size", [96, 64]), ("split", "none"),
                                         ("downscaler", "box"), ("psnr", "floats"), ("sh_degree", 2),
                                         ("train_views", 7), ("test_views", 7), ("scale_recipe", True),
                                         ("recipe", {"lambda_dssim": 0.0})])
def test_mixed_protocols_are_refused(tmp_path, name, value):
    other = row(blend_mode="smoe", protocol={**PROTOCOL, name: value})
    with pytest.raises(ReportError, match=name) as caught:
        rows.read_rows(write_rows(tmp_path, [row(), other]))
    assert other["cell"] in str(caught.value) and row()["cell"] in str(caught.value)


def test_rules_that_one_row_does_not_state_are_not_compared(tmp_path):
    """Rows of earlier versions state fewer, and a checkout's recipe has not all names of the native one."""
    bare = {name: value for name, value in PROTOCOL.items() if name not in ("recipe", "sh_degree")}
    entries = [row(protocol={**bare, "scale_recipe": None}), row(seed=1),
               row(seed=2, protocol={**PROTOCOL, "recipe": {"feature_lr": 0.0025, "opacity_lr": None}})]
    assert len(rows.read_rows(write_rows(tmp_path, entries))) == 3
    entries.append(row(seed=3, protocol={**PROTOCOL, "recipe": {"feature_lr": 0.01}}))
    with pytest.raises(ReportError, match="recipe.feature_lr is 0.0025 in .* and 0.01 in "):
        rows.read_rows(write_rows(tmp_path, entries))


@pytest.mark.parametrize("text, reason", [("{", "line 1: not valid json"), ("[]", "line 1: expected one object"),
                                          ('{"cell": "a"}', "lacks suite, ok, method"), ("", "no rows"),
                                          (json.dumps({**row(), "cell": ["a"]}), r"line 1: cell is \['a'\]"),
                                          ("\xff", "rows.jsonl: not text in UTF-8")])
def test_damaged_results_are_refused(tmp_path, text, reason):
    (tmp_path / "rows.jsonl").write_text(text, encoding="latin-1")
    with pytest.raises(ReportError, match=reason):
        rows.read_rows(str(tmp_path))


@pytest.mark.parametrize("name, value", [
    ("psnr", "12.3"), ("ssim", math.nan), ("fps", math.inf), ("psnr", -math.inf), ("num_gaussians", True),
    ("train_seconds", 10 ** 400), ("seed", True), ("budget", "1"), ("iterations", [1]), ("label", 1),
    ("lpips_all", [1]), ("lpips_all", [{"kind": 1}]), ("lpips", {"kind": "lpips_alex", "value": "0.3"}),
    ("size_bytes", 3), ("size_bytes", {"own": "3"}), ("densify_grad_threshold", "0.005"), ("protocol", []),
    ("machine", "Card X"), ("machine", {"cells_per_gpu": "2"}), ("commit", "abc"), ("background_gate", "0.05"),
    ("background_gate", math.nan)])
def test_a_field_of_another_type_is_refused(tmp_path, name, value):
    with pytest.raises(ReportError, match=rf"rows.jsonl, line 2: {name}[\[\]0-9]*(\.\w+)? is .*; it must be "):
        rows.read_rows(write_rows(tmp_path, [row(), {**row(blend_mode="smoe"), name: value}]))


def test_one_setting_twice_is_refused():
    with pytest.raises(ReportError, match="same setting, scene and seed 0"):
        table_of([row(), {**row(), "cell": "again"}], "cells")
