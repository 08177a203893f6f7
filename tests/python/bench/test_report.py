"""The benchmark's report: averages, tables beside the paper's, deltas, failures, refusals, curves."""
import csv
import io
import json
import math

import pytest
from report_rows import PROTOCOL, failed, row, write_rows

from dsmoe.bench import rows
from dsmoe.bench.report import ReportError, curves, groups, layouts, tables


def table_of(entries, name, suite="table1"):
    """The table NAME of rows; None if the suite has none."""
    made = layouts.tables_of(suite, entries)
    return next((table for table in made if table.name == f"{suite}_{name}"), None)


def shown(table, *columns, **labels):
    """The texts of these columns in the only row of ours with these labels; without columns {column: text}."""
    wanted = {table.labels.index(name): value for name, value in labels.items()}
    found = [line for line in table.rows if line.source == tables.OURS
             and all(line.labels[index] == value for index, value in wanted.items())]
    assert len(found) == 1, [line.labels for line in table.rows]
    texts = dict(zip((column.full_name for column in table.columns), table.shown(found[0])))
    return [texts[column] for column in columns] if columns else texts


def smoe(**changes):
    return row(blend_mode="smoe", **changes)


def test_a_cell_is_the_mean_over_seeds_with_its_spread():
    entries = [row(seed=seed, psnr=psnr) for seed, psnr in enumerate((23.0, 24.0, 25.0))]
    table = table_of(entries, "cells")
    assert shown(table, "PSNR [dB]", "PSNR at edges [dB]", "own size [MB]", "LPIPS Alex") == [
        "24.00 ± 1.00", "22.00 ± 1.00", "2.0 ± 0.0", "0.250 ± 0.000"]
    assert "GPU peak [MiB]" not in shown(table)  # no row has it
    averaged, single = csv.DictReader(io.StringIO(tables.to_csv(table_of([*entries, row("fox")], "cells"))))
    assert (averaged["source"], float(averaged["PSNR [dB]"]), float(averaged["PSNR [dB] sd"])) == ("ours", 24, 1)
    assert single["PSNR [dB] sd"] == ""
    assert shown(table_of(entries[:1], "cells"), "PSNR [dB]") == ["23.00"]  # one seed has no spread
    table = table_of([row(budget=40), row(budget=40, threshold=0.001)], "cells")
    assert [line.labels[2] for line in table.rows] == ["40 Gaussians at 0.005", "40 Gaussians at 0.001"]
    with pytest.raises(ReportError, match="same setting, scene and seed 0"):
        table_of([row(), {**row(), "cell": "again"}], "cells")


def test_an_average_is_of_the_seeds_that_every_scene_has_in_both_modes():
    """Seeds that differ by more than the modes do: an average over whichever there are would turn the sign."""
    lacking = (("truck", 1), ("truck", 2), ("train", 2))
    alpha = [row(scene, seed=seed, psnr=15.0 + 3 * seed) for scene in ("truck", "train") for seed in range(3)]
    gated = [(failed if (entry["scene"], entry["seed"]) in lacking else row)(
        scene=entry["scene"], blend_mode="smoe", seed=entry["seed"], psnr=entry["psnr"] + 1) for entry in alpha]
    columns = [f"Tanks and Temples {name}" for name in ("PSNR [dB]", "seeds")]
    table = table_of(alpha + gated, "table1")
    assert shown(table, *columns, method="native, alpha") == ["15.00", "1 of 3"]
    assert shown(table, *columns, method="native, smoe") == ["16.00", "1 of 3"]
    assert [note for note in table.notes if "averages leave" in note] == [
        "sparse, native: averages leave seed 1 out, since smoe failed on truck.",
        "sparse, native: averages leave seed 2 out, since smoe failed on train, smoe failed on truck."]
    apart = [row("truck", seed=0), row("train", seed=1)]
    assert shown(table_of(apart, "table1"), columns[0]) == ["no common seed"]


def test_an_average_is_of_the_scenes_that_all_blends_of_a_method_have_and_says_which():
    c3dgs = {"method": "c3dgs", "variant": "patched", "end": "sparse"}
    entries = [row("bonsai", psnr=30.0, **c3dgs), smoe(scene="bonsai", psnr=31.0, **c3dgs),
               smoe(scene="fox", psnr=20.0, **c3dgs), row("lego", psnr=10.0)]  # lego: of no method of Table 2
    columns = ["PSNR [dB]", "scenes"]
    table = table_of(entries, "table2")
    assert shown(table, *columns, method="c3dgs, alpha") == ["30.00", "bonsai"]
    assert shown(table, *columns, method="c3dgs, smoe") == ["31.00", "bonsai"]
    assert layouts.SCENES_NOTE in table.notes
    table = table_of([*entries, row("fox", psnr=18.0, **c3dgs)], "table2")
    assert shown(table, columns[0], method="c3dgs, alpha") == ["24.00"]
    assert shown(table, columns[0], method="c3dgs, smoe") == ["25.50"]
    assert layouts.SCENES_NOTE not in table.notes and any("averages over bonsai, fox:" in note for note in table.notes)
    assert "scenes" not in [column.name for column in table.columns]
    # A failure is a result: its scene is not left out.
    table = table_of([*entries, failed(scene="fox", **c3dgs)], "table2")
    assert shown(table, columns[0], method="c3dgs, alpha") == ["failed: fox"]
    assert shown(table, columns[0], method="c3dgs, smoe") == ["25.50"]
    apart = [row("bonsai", **c3dgs), smoe(scene="fox", **c3dgs)]
    assert shown(table_of(apart, "table2"), columns[0], method="c3dgs, smoe") == ["no common scene"]


def test_weights_that_were_not_there_are_named_without_a_path():
    reason = "$DSMOE_LPIPS_VGG: FileNotFoundError: [Errno 2] No such file or directory: '/a/b.npz'"
    table = table_of([row(lpips={"value": None, "kind": "lpips_vgg_std", "reason": reason})], "cells")
    assert "Not measured, lpips_vgg_std: $DSMOE_LPIPS_VGG: weights not at hand." in table.notes


def test_the_papers_figures_stand_beside_ours_and_are_marked():
    table = table_of([row(), row(threshold=0.0002, psnr=30.0), row("fox")], "table1")
    printed = {line.labels: line.cells for line in table.rows if line.source == tables.PAPER}
    columns = [column.full_name for column in table.columns]
    figures = [printed["sparse", "3DSMoES"][columns.index(f"Mip-NeRF 360 (ours: bonsai) {name}")].printed
               for name in ("PSNR [dB]", "SSIM", "LPIPS, paper's", "#G [M]", "own size [MB]")]
    assert figures == ["24.43", "0.69", "0.39", "0.064", "15.4"] and printed["dense", "2DGS"][0].printed == "26.88"
    assert printed["sparse", "3DSMoES"][columns.index("fox PSNR [dB]")].value is None
    assert any("only of bonsai; the paper averages 9 scenes" in note for note in table.notes)
    assert any("Deep Blending and Tanks and Temples are left out" in note for note in table.notes)


def test_a_scene_is_of_the_data_set_that_its_row_names():
    """A made-up scene may have the name of one of the paper's."""
    entries = [row("room", dataset=None), row("my_truck", dataset="Tanks and Temples")]
    assert table_of(entries[:1], "table1") is None
    table = table_of(entries[1:], "table1")
    assert shown(table, "Tanks and Temples (ours: my_truck) PSNR [dB]", end="sparse") == ["20.00"]


def test_other_trainers_stand_in_table_2():
    taming = {"scene": "truck", "method": "taming", "variant": "patched"}
    table = table_of([row(fps=100.0, **taming), smoe(psnr=21.0, **taming)], "table2")
    assert shown(table, "PSNR [dB]", method="taming, smoe") + shown(table, "FPS", method="taming, alpha") == [
        "21.00", "100"]
    printed = next(line for line in table.rows if line.labels == ("sparse", "3DSMoES-Taming"))
    assert printed.source == tables.PAPER and [cell.printed for cell in printed.cells][-3:-1] == ["280", "194"]
    assert table_of([row()], "table2") is None


@pytest.mark.parametrize("alpha, gated, delta", [
    ([20.0, 22.0, 50.0], [23.0, 24.0], "+2.50 ± 0.71"), ([20.0], [19.0], "-1.00"), ([20.001], [20.0], "0.00")])
def test_deltas_are_of_the_seeds_that_both_modes_have(alpha, gated, delta):
    entries = [row(seed=seed, psnr=psnr) for seed, psnr in enumerate(alpha)]
    entries += [smoe(seed=seed, psnr=psnr, num_gaussians=20000 + 10000 * seed) for seed, psnr in enumerate(gated)]
    told = [delta, {1: "0.50", 2: "0.62 ± 0.18"}[len(gated)]]  # 0.5 and 0.75: 0.625, to even
    assert shown(table_of(entries, "deltas"), "Δ PSNR [dB]", "#Gaussians ratio", seeds=str(len(gated))) == told


def test_each_gate_of_smoe_is_a_blend_of_its_own():
    """Rows of before there were gates are of gate 0; each gate is compared with alpha and with that."""
    entries = [row(background_gate=1.0), smoe(psnr=21.0), smoe(psnr=23.0, seed=1, background_gate=0.0),
               smoe(psnr=24.5, background_gate=0.05), row(blend_mode="smoe_tn", background_gate=0.0),
               smoe(psnr=24.0, background_gate="learned", protocol={"background_gate": 0.25})]
    cells = table_of(entries, "cells")
    assert [line.labels[1].partition(", ")[2] for line in cells.rows] == ["alpha", "smoe", "smoe 0.05", "smoe learned",
                                                                          "smoe_tn"]
    assert shown(cells, "PSNR [dB]", method="native, smoe", seeds="2") == ["22.00 ± 1.41"]
    assert shown(cells, "learned gate", method="native, smoe learned") == ["0.250"]
    for name, title, delta in (("deltas", "smoe against alpha", "+1.00"),
                               ("deltas_smoe_0.05_alpha", "smoe 0.05 against alpha", "+4.50"),
                               ("deltas_smoe_0.05_smoe", "smoe 0.05 against smoe", "+3.50"),
                               ("deltas_smoe_learned_smoe", "smoe learned against smoe", "+3.00")):
        table = table_of(entries, name)
        assert table.title == f"{title}, all else equal" and shown(table, "Δ PSNR [dB]", seeds="1") == [delta]
        assert any(line.source == tables.PAPER for line in table.rows) == (name == "deltas")
    averages = table_of([*entries, row(seed=1)], "table1")  # of all gates they are of the seeds that these share
    assert shown(averages, "Mip-NeRF 360 (ours: bonsai) PSNR [dB]", method="native, smoe") == ["21.00"]


def test_the_papers_program_is_compared_with_alpha_beside_what_the_paper_prints():
    paper = {"background_gate": 0.0, "faint_below": 2.0}
    entries = [row(), smoe(psnr=23.0, **paper), smoe(psnr=22.0)]
    assert [line.labels[1] for line in table_of(entries, "cells").rows] == ["native, alpha", "native, smoe",
                                                                           "native, smoe paper"]
    table = table_of(entries, "deltas_smoe_paper_alpha")
    assert shown(table, "Δ PSNR [dB]", seeds="1") == ["+3.00"]
    assert any(line.source == tables.PAPER for line in table.rows)


def test_the_ablation_compares_what_takes_the_same_gaussians():
    entries = [row(blend_mode=mode, threshold=0.0002) for mode in ("smoe", "smoe_eq7", "smoe_tn", "smoe_std")]
    table = table_of(entries, "table3")
    assert [line.labels[2].partition(":")[0] for line in table.rows if line.source == tables.OURS] == [
        "smoe_eq7", "smoe_tn", "smoe_std"]
    full, *_, classic = (line.cells for line in table.rows if line.source == tables.PAPER)
    assert full[2].printed == "0.17" and classic[0].printed == "22.328"


def test_times_are_drawn_over_the_number_of_gaussians_and_over_psnr():
    """Of cells that shared no GPU, of curves of three points and more."""
    entries = [row(threshold=threshold, num_gaussians=number, psnr=psnr, train_seconds=10 * psnr, fps=5000 / psnr)
               for threshold, number, psnr in ((0.005, 100, 20.0), (0.001, 200, 25.0), (0.0002, 400, 40.0))]
    entries += [row(method="taming", variant="patched"),
                smoe(psnr=21.0, threshold=0.0001, machine={"device": "Card X", "cells_per_gpu": 2})]
    axes = curves.speed(groups_of(entries)).axes
    assert [axis.get_ylabel() for axis in axes[::2]] == ["train [s]", "FPS"]
    assert [axis.get_xlabel() for axis in axes[-2:]] == ["#Gaussians", "PSNR [dB]"]
    assert [axis.containers[0].lines[0].get_xydata().tolist() for axis in axes] == [
        [[100, 200], [200, 250], [400, 400]], [[20, 200], [25, 250], [40, 400]],
        [[100, 250], [200, 200], [400, 125]], [[20, 250], [25, 200], [40, 125]]]
    assert curves.speed(groups_of(entries[:2])) is None


def test_renderings_that_equal_the_ground_truth_have_an_infinite_psnr(tmp_path):
    """json has no number for it: some write null, some Infinity."""
    entries = rows.read_rows(write_rows(tmp_path, [row(psnr=None), row(seed=1), smoe(psnr=math.inf),
                                                   smoe(seed=1, psnr=21.0)]))
    table = table_of(entries, "cells")
    assert [shown(table, "PSNR [dB]", method=f"native, {mode}") for mode in ("alpha", "smoe")] == [["inf"], ["inf"]]
    assert next(csv.DictReader(io.StringIO(tables.to_csv(table))))["PSNR [dB]"] == "inf"
    assert shown(table_of(entries, "deltas"), "Δ PSNR [dB]") == ["+1.00"]  # of seed 1
    nothing = row("fox", psnr=None, ssim=None, psnr_edge=None)  # without test views
    assert "PSNR [dB]" not in shown(table_of([nothing], "cells"))


def test_packed_rows_are_read_as_they_were_and_say_once_what_they_share(tmp_path):
    entries = [row(psnr=None), smoe(psnr=21.5, budget=10), row("fox", seed=1, background_gate=None),
               row("fox", protocol={"recipe": {"sh_degree": 2}, "split": "another"}),
               failed(scene="lego", protocol={})]
    text = rows.packed([{**entry, "per_view": [{"psnr": 20.0}]} for entry in entries])
    (tmp_path / "rows.jsonl").write_text(text, encoding="utf-8")
    kept = [{name: value for name, value in entry.items() if name != "history"} for entry in entries]
    assert rows.read_rows(str(tmp_path)) == sorted(kept, key=lambda entry: entry["cell"])
    assert text.count("abc1234") == 1 and "per_view" not in text and "history" not in text
    (tmp_path / "rows.jsonl").write_text(text + '{"cell": "more"}\n{"cell": "wrong", "seed": "0"}', encoding="utf-8")
    with pytest.raises(rows.ReportError, match=r"rows.jsonl, line 8: .*seed"):  # line 7 takes all from the shared line
        rows.read_rows(str(tmp_path))


def test_times_of_different_machines_are_neither_averaged_nor_divided():
    elsewhere = {"train_seconds": 1000.0, "fps": 20.0, "machine": {"device": "Card Y"}}
    entries = [row(**elsewhere), smoe(psnr=21.0), row(seed=1), smoe(seed=1)]
    differ = 2 * ["machines differ"]
    assert shown(table_of(entries, "deltas"), "train ratio", "FPS ratio", "Δ PSNR [dB]") == [*differ, "+0.50 ± 0.71"]
    table = table_of(entries, "cells")
    assert shown(table, "train [s]", "FPS", "PSNR [dB]", method="native, alpha") == [*differ, "20.00 ± 0.00"]
    assert shown(table, "FPS", method="native, smoe") == ["200 ± 0"]
    assert ("Measured on Card X (native, alpha; native, smoe), Card Y (native, alpha); times and FPS compare on one "
            "machine only.") in table.notes
    # Only seeds that both have are compared.
    assert shown(table_of(entries[1:], "deltas"), "train ratio", "FPS ratio") == ["1.00", "1.00"]
    taming = {"method": "taming", "variant": "patched"}
    table = table_of([row("truck", **taming), row("train", **taming, **elsewhere)], "table2")
    assert shown(table, "PSNR [dB]", "train [s]", "FPS", end="sparse") == ["20.00", *differ]


def test_times_of_cells_that_shared_their_gpu_are_left_out():
    alone, shared = ({"train_seconds": 7000.0, "wall_seconds": 8000.0, "fps": 3.0,
                      "machine": {"device": "Card X", "cells_per_gpu": count}} for count in (1, 2))
    entries = [row(**shared), smoe(psnr=21.0, **shared), row(threshold=0.0002, **alone),
               row(threshold=0.0002, seed=1, train_seconds=9000.0), row(threshold=0.0002, seed=2, **shared)]
    table, delta = table_of(entries, "cells"), table_of(entries, "deltas")
    assert shown(table, "train [s]", "wall [s]", "FPS", "PSNR [dB]", method="native, smoe") == [
        "shared", "shared", "shared", "21.00"]
    assert shown(table, "train [s]", threshold="0.0002") == ["8,000 ± 1,414"]  # of the seeds that did not share
    assert shown(delta, "Δ PSNR [dB]", "train ratio", "FPS ratio") == ["+1.00", "shared", "shared"]
    assert layouts.SHARED_NOTE in table.notes and layouts.SHARED_NOTE in delta.notes


def test_a_failed_cell_is_a_row_with_its_reason():
    entries = [row(), failed("out of memory | 12 GiB", blend_mode="smoe"), row("fox", seed=0),
               failed("killed", scene="fox", seed=1)]
    table = table_of(entries, "failures")
    assert {line.labels[1] for line in table.rows} == {"out of memory | 12 GiB", "killed"}
    assert "out of memory \\| 12 GiB" in tables.to_text(table, "md")
    assert shown(table_of(entries, "cells"), "PSNR [dB]", method="native, smoe") == ["failed"]
    assert shown(table_of(entries, "cells"), "PSNR [dB]", scene="fox", seeds="1 of 2") == ["20.00"]
    assert shown(table_of(entries, "deltas"), "Δ PSNR [dB]") == ["smoe failed"]


@pytest.mark.parametrize("name", ["table1", "table3", "deltas", "cells", "failures"])
def test_every_line_of_latex_and_markdown_has_all_columns(name):
    entries = [row(blend_mode=mode, seed=seed) for mode in ("alpha", "smoe", "smoe_tn") for seed in (0, 1)]
    table = table_of([*entries, failed("50 % of a_b & c\\d #1", scene="fox")], name)
    width = 1 + len(table.labels) + len(table.columns)
    lines = tables.to_text(table, "tex").split("\n")
    body = [line for line in lines if line.endswith(r"\\") and "multicolumn" not in line]
    assert {line.replace(r"\&", "").count("&") for line in body} == {width - 1} and len(body) == len(table.rows) + 1
    if name == "failures":
        assert r"50 \% of a\_b \& c\textbackslash{}d \#1" in body[-1]
    lines = [line for line in tables.to_text(table, "md").split("\n") if line.startswith("|")]
    assert {line.count("|") for line in lines} == {width + 1} and len(lines) == len(table.rows) + 2


@pytest.mark.parametrize("name, value", [("background", "white"), ("image_size", [96, 64]), ("split", "none"),
                                         ("downscaler", "box"), ("psnr", "floats"), ("sh_degree", 2),
                                         ("train_views", 7), ("test_views", 7), ("scale_recipe", True),
                                         ("recipe", {"lambda_dssim": 0.0})])
def test_rows_of_a_rarer_protocol_are_left_out_and_named(name, value):
    """If none is the commonest, nobody knows which: that is refused."""
    other = smoe(protocol={**PROTOCOL, name: value})
    with pytest.raises(ReportError, match=name) as caught:
        rows.of_one_protocol([row(), other])
    assert other["cell"] in str(caught.value) and row()["cell"] in str(caught.value)
    kept, (told,) = rows.of_one_protocol([other, row(), row(seed=1), row("fox", protocol=other["protocol"])])
    assert [(entry["scene"], entry["seed"]) for entry in kept] == [("bonsai", 0), ("bonsai", 1), ("fox", 0)]
    assert f"{name}" in told and told.endswith(f"in 2 others of bonsai: {other['cell']}")


def test_rules_that_one_row_does_not_state_are_not_compared():
    """A checkout's recipe lacks some names of the native one."""
    bare = {name: value for name, value in PROTOCOL.items() if name not in ("recipe", "sh_degree")}
    entries = [row(protocol={**bare, "scale_recipe": None}), row(seed=1),
               row(seed=2, protocol={**PROTOCOL, "recipe": {"feature_lr": 0.0025, "opacity_lr": None}})]
    assert rows.of_one_protocol(entries) == (entries, [])
    entries.append(row(seed=3, protocol={**PROTOCOL, "recipe": {"feature_lr": 0.01}}))
    kept, (told,) = rows.of_one_protocol(entries)
    assert kept == entries[:3] and "recipe.feature_lr is 0.01 in them and 0.0025 in 2 others" in told


@pytest.mark.parametrize("text, reason", [
    ("{", "line 1: not valid json"), ("[]", "line 1: expected one object"), ("", "no rows"),
    ('{"cell": "a"}', "lacks suite, ok, method"), ("\xff", "rows.jsonl: not text in UTF-8"),
    *((f"{json.dumps(row())}\n{json.dumps({**row(), name: value})}",
       rf"rows.jsonl, line 2: {name}[\[\]0-9]*(\.\w+)? is .*; it must be ")
      for name, value in (
          ("cell", ["a"]), ("psnr", "12.3"), ("ssim", math.nan), ("fps", math.inf), ("psnr", -math.inf),
          ("num_gaussians", True), ("train_seconds", 10 ** 400), ("seed", True), ("label", 1),
          ("lpips_all", [{"kind": 1}]), ("size_bytes", 3), ("size_bytes", {"own": "3"}), ("protocol", []),
          ("machine", {"cells_per_gpu": "2"}), ("commit", "abc"), ("background_gate", "0.05"),
          ("background_gate", math.nan)))])
def test_damaged_results_are_refused(tmp_path, text, reason):
    (tmp_path / "rows.jsonl").write_text(text, encoding="latin-1")
    with pytest.raises(ReportError, match=reason):
        rows.read_rows(str(tmp_path))


def groups_of(entries):
    return groups.grouped(entries, layouts.end_of)


def test_a_curve_goes_through_the_means_from_few_gaussians_to_many():
    entries = [row(threshold=0.0002, psnr=30.0, num_gaussians=900),
               row(threshold=0.005, psnr=20.0, num_gaussians=100), row(seed=1, psnr=22.0, num_gaussians=300),
               row(blend_mode="smoe", psnr=25.0, num_gaussians=50)]
    axes = curves.rate_distortion(groups_of(entries)).axes
    # Rows: PSNR, SSIM, LPIPS; columns: number, own size, common size.
    assert [axis.get_ylabel() for axis in axes[::3]] == ["PSNR [dB]", "SSIM", "LPIPS Alex (lower is better)"]
    assert [axis.get_xlabel() for axis in axes[-3:]] == ["#Gaussians", "own size [MB]", "common size [MB]"]
    alpha, smoe = (container.lines[0].get_xydata().tolist() for container in axes[0].containers)
    assert alpha == [[200, 21], [900, 30]] and smoe == [[50, 25]]
    whisker = axes[0].containers[0].lines[2][0].get_segments()[0]
    assert whisker[1, 1] - whisker[0, 1] == pytest.approx(2 * 2 ** 0.5)  # seeds 20 and 22: sd is the root of 2


def test_what_has_no_place_on_an_axis_is_left_out(tmp_path):
    entries = [row(psnr=float("inf")), row(threshold=0.002, num_gaussians=0), row(threshold=0.001, num_gaussians=7)]
    psnr = curves.rate_distortion(groups_of(entries)).axes[0]
    assert [line.get_xydata().tolist() for line in psnr.containers[0].lines[:1]] == [[[7, 20]]]
    for nothing in (row(num_gaussians=0, size_bytes={"own": 0, "common": 0}),
                    row(psnr=None, ssim=None, lpips=None, train_seconds=None, fps=None), failed()):
        assert curves.draw_all("table1", groups_of([nothing]), str(tmp_path)) == []


def test_the_legend_lies_inside_and_above_the_panels():
    entries = [row(blend_mode=mode, label=f"{'a long name of method ' * 2}{method}", strategy="steady",
                   threshold=threshold)
               for mode in ("alpha", "smoe") for method in range(4) for threshold in (0.005, 0.0002)]
    drawn = curves.rate_distortion(groups_of(entries))
    drawn.canvas.draw()
    box = drawn.legends[0].get_window_extent()
    assert box.x0 >= 0 and box.x1 <= drawn.bbox.x1 and box.y1 <= drawn.bbox.y1
    assert box.y0 >= max(axis.get_window_extent().y1 for axis in drawn.axes)
