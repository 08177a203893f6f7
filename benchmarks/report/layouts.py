"""Which tables a suite gets: those of the paper with its printed figures beside ours, every cell, deltas, failures."""
from __future__ import annotations

import functools
import json
import os
from typing import Any, Dict, List, Optional, Sequence, Tuple

from .rows import (Group, Measured, Row, Setting, figure, grouped, lpips_figures, lpips_reasons, order,
                   over_scenes, paired, safe_name, shared_gpu)
from .tables import (OURS, PAPER, Cell, Column, Table, TableRow, cell, column, printed, without_empty_columns)

Paper = Dict[str, Any]
END_NAMES = ("sparse", "dense")
ABLATION = {"smoe": "full", "smoe_tn": "without T_d", "smoe_std": "without T_n,d"}
SHARED = "shared"  # stands for a time or FPS where there is none for this reason
SHARED_NOTE = ("Times and FPS are of cells that had their GPU alone. shared: several cells had one GPU at once, so "
               "theirs are not the GPU's; the rows have them.")
SPREAD_NOTE = "± is the sample standard deviation over seeds; figures without it are of one seed."


@functools.lru_cache(maxsize=None)
def read_paper() -> Paper:
    """The figures that the paper prints, and which of our names stand for which of its rows."""
    with open(os.path.join(os.path.dirname(os.path.abspath(__file__)), "paper.json"), encoding="utf-8") as file:
        return json.load(file)


def end_of(row: Row) -> Optional[str]:
    """ "sparse" or "dense" where a row belongs to that end of the paper's tables: as it says, or by its threshold."""
    if row.get("end"):
        return row["end"]
    for end, threshold in read_paper()["ends"].items():
        if row.get("budget") is None and row.get("densify_grad_threshold") == threshold:
            return end
    return None


def tables_of(suite: str, rows: Sequence[Row], paper: Paper) -> List[Table]:
    """The tables of one suite's rows; those with nothing of ours in them are left out."""
    groups = grouped(rows, end_of)
    made = [table1(groups, paper), table2(groups, paper), table3(groups, paper), deltas(groups, paper),
            cells(groups), failures(rows)]
    return [table._replace(name=safe_name(f"{suite}_{table.name}")) for table in made
            if any(row.source == OURS for row in table.rows)]


def table1(groups: Sequence[Group], paper: Paper) -> Table:
    """The paper's Table 1: quality, number of Gaussians and size, sparse and dense.

    Columns for each of the paper's data sets that some scene at hand is of, then for each other scene.
    """
    ours = _by_dataset(groups, paper)
    if not ours:
        return Table("table1", "", (), (), ())
    known = [scene for scenes in ours.values() for scene in scenes]
    ours.update({scene: [scene] for scene in sorted({group.scene for group in groups}) if scene not in known})
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(_rows(groups)), "num_gaussians_m", "size_own_mb"]
    columns = tuple(column(name, place if scenes in ([place], sorted(paper["datasets"].get(place, [])))
                           else f"{place} (ours: {', '.join(scenes)})")
                    for place, scenes in ours.items() for name in names)
    rows: List[TableRow] = []
    for end in END_NAMES:
        for method, averages in paper["table1"][end].items():
            cells_ = tuple(_printed(paper["table1"]["columns"], averages.get(place), name)
                           for place in ours for name in names)
            rows.append(TableRow((end, method), cells_, PAPER))
        for setting, by_scene in _settings(groups, end, paper, "table1"):
            cells_ = tuple(_average(by_scene, scenes, name) for scenes in ours.values() for name in names)
            rows.append(TableRow((end, setting.label()), cells_))
    notes = [paper["source"] + ".", *_scene_notes(groups, paper), *_notes(groups)]
    return without_empty_columns(Table("table1", "Quality, number of Gaussians and size (the paper's Table 1)",
                                       ("end", "method"), columns, tuple(rows), tuple(notes)))


def table2(groups: Sequence[Group], paper: Paper) -> Table:
    """The paper's Table 2: other trainers with the gate put in; averages over all scenes at hand."""
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(_rows(groups)), "num_gaussians_m", "size_own_mb",
             "train_seconds", "fps"]
    scenes = sorted({group.scene for group in groups})
    rows: List[TableRow] = []
    for end in END_NAMES:
        for method, averages in paper["table2"][end].items():
            cells_ = tuple(_printed(paper["table2"]["columns"], averages, name) for name in names)
            rows.append(TableRow((end, method), cells_, PAPER))
        for setting, by_scene in _settings(groups, end, paper, "table2"):
            rows.append(TableRow((end, setting.label()), tuple(_average(by_scene, scenes, name) for name in names)))
    notes = [paper["source"] + "; averages of three data sets.",
             f"Ours are averages over {', '.join(scenes)}: not the paper's scenes, and not its GPU.", *_notes(groups)]
    return without_empty_columns(Table("table2", "The gate in other trainers (the paper's Table 2)", ("end", "method"),
                                       tuple(column(name) for name in names), tuple(rows), tuple(notes)))


def table3(groups: Sequence[Group], paper: Paper) -> Table:
    """The paper's Table 3: the gate without the transmittance, in its denominator and altogether."""
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(_rows(groups)), "train_seconds", "num_gaussians_m"]
    ablated = {(group.setting.pair, group.scene) for group in groups
               if group.setting.blend_mode in ("smoe_tn", "smoe_std")}
    printed_rows, where = paper["table3"]["rows"], f"{paper['table3']['dataset']}, {paper['table3']['end']}"
    rows = [TableRow((where, "", ABLATION[mode]), tuple(_printed(paper["table3"]["columns"], printed_rows[mode], name)
                                                        for name in names), PAPER) for mode in printed_rows]
    for group in groups:
        if (group.setting.pair, group.scene) in ablated and group.setting.blend_mode in ABLATION:
            labels = (f"{group.scene}, {group.setting.amount()}", group.setting.label(blend_mode=False),
                      f"{group.setting.blend_mode}: {ABLATION[group.setting.blend_mode]}")
            rows.append(TableRow(labels, tuple(_seeds_cell(group, name) for name in names)))
    notes = (paper["source"] + ".", "T_d: the transmittance in the denominator; T_n,d: in both.", *_notes(groups))
    return without_empty_columns(Table("table3", "Ablation of the transmittance (the paper's Table 3)",
                                       ("scene, threshold", "method", "gate"),
                                       tuple(column(name) for name in names), tuple(rows), notes))


def deltas(groups: Sequence[Group], paper: Paper) -> Table:
    """smoe against alpha in equal settings, seed by seed; beside it what the paper's printed averages differ by."""
    by_key = {(group.setting, group.scene): group for group in groups}
    differences = ["psnr", "psnr_edge", "ssim", *lpips_figures(_rows(groups))]
    ratios = ["num_gaussians", "size_own_mb", "train_seconds", "fps"]
    rows: List[TableRow] = []
    for end in END_NAMES:
        averages = paper["table1"][end]
        for dataset in paper["datasets"]:
            alpha, smoe = (dict(zip(paper["table1"]["columns"], map(float, averages[method][dataset])))
                           for method in ("3DGS", "3DSMoES"))
            found = {"psnr": smoe["psnr"] - alpha["psnr"], "ssim": smoe["ssim"] - alpha["ssim"],
                     "num_gaussians": smoe["num_gaussians_m"] / alpha["num_gaussians_m"],
                     "size_own_mb": smoe["size_own_mb"] / alpha["size_own_mb"]}
            rows.append(TableRow((dataset, "3DGS", f"{paper['ends'][end]:g}" + f" ({end})", ""),
                                 tuple(Cell(found.get(name)) for name in differences + ratios), PAPER))
    for group in groups:
        gated = by_key.get((group.setting._replace(blend_mode="smoe"), group.scene))
        if group.setting.blend_mode != "alpha" or gated is None:
            continue
        failed = [f"{mode.setting.blend_mode} failed" for mode in (group, gated) if not mode.rows]
        cells_ = [cell(paired(group, gated, name, lambda new, old: new - old)) for name in differences]
        cells_ += [_or_shared(paired(group, gated, name, lambda new, old: new / old if old else float("nan")),
                              (group, gated), name) for name in ratios]
        if failed:
            cells_[0] = Cell(text=", ".join(failed))
        seeds = len(set(group.by_seed("psnr")) & set(gated.by_seed("psnr")))
        rows.append(TableRow((group.scene, group.setting.label(blend_mode=False), group.setting.amount(), str(seeds)),
                             tuple(cells_)))
    columns = [column(name, difference=True) for name in differences]
    columns += [Column(f"{column(name).name.partition(' [')[0]} ratio", 2) for name in ratios]
    notes = ("Δ: smoe less alpha; ratio: smoe over alpha; of seeds that both have. The paper's are of its printed "
             "averages over a data set.", SPREAD_NOTE, *_shared_notes(_rows(groups)))
    return without_empty_columns(Table("deltas", "smoe against alpha, all else equal",
                                       ("scene", "method", "threshold", "seeds"), tuple(columns), tuple(rows), notes))


def cells(groups: Sequence[Group]) -> Table:
    """Every setting on every scene, averaged over seeds, with all that was measured."""
    names = ["psnr", "psnr_float", "psnr_edge", "ssim", *lpips_figures(_rows(groups)), "num_gaussians", "size_own_mb",
             "size_common_mb", "train_seconds", "wall_seconds", "fps", "peak_gpu_mib"]
    rows = [TableRow((group.scene, group.setting.label(), group.setting.amount(), group.seeds()),
                     tuple(_seeds_cell(group, name) for name in names)) for group in groups]
    return without_empty_columns(Table("cells", "All settings", ("scene", "method", "threshold", "seeds"),
                                       tuple(column(name) for name in names), tuple(rows), tuple(_notes(groups))))


def failures(rows: Sequence[Row]) -> Table:
    """The cells that failed, each with its reason."""
    failed = [row for row in rows if not row["ok"]]
    return Table("failures", "Cells that failed", ("cell", "reason"), (),
                 tuple(TableRow((row["cell"], row.get("reason") or "no reason was written"), ()) for row in failed))


def _rows(groups: Sequence[Group]) -> List[Row]:
    return [row for group in groups for row in group.rows]


def _settings(groups: Sequence[Group], end: str, paper: Paper,
              table: str) -> List[Tuple[Setting, Dict[str, Group]]]:
    """The settings of an end whose method stands in a table of the paper, each with its groups by scene."""
    found: Dict[Setting, Dict[str, Group]] = {}
    for group in groups:
        names = paper["names"].get(group.setting.method, {})
        if group.setting.end == end and any(name in paper[table][end] for name in names.values()):
            found.setdefault(group.setting, {})[group.scene] = group
    return sorted(found.items(), key=lambda item: order(item[0]))


def _average(by_scene: Dict[str, Group], scenes: Sequence[str], name: str) -> Cell:
    """The mean over scenes, or which of them failed or were not run: an average never leaves a scene out."""
    failed = [scene for scene in scenes if scene in by_scene and not by_scene[scene].rows]
    absent = [scene for scene in scenes if scene not in by_scene]
    if failed or absent:
        text = "failed" if failed else "not run"
        if len(scenes) > 1:
            text += ": " + ", ".join(failed or absent)
        return Cell(text=text if name == "psnr" else "")
    groups = [by_scene[scene] for scene in scenes]
    return _or_shared(over_scenes(groups, name), groups, name)


def _seeds_cell(group: Group, name: str) -> Cell:
    if name == "psnr" and group.failed and not group.rows:
        return Cell(text="failed")
    return _or_shared(group.measured(name), [group], name)


def _or_shared(measured: Measured, groups: Sequence[Group], name: str) -> Cell:
    """The figure; where it is absent because cells of a group shared their GPU, that."""
    if measured.mean is None and any(group.shared(name) for group in groups):
        return Cell(text=SHARED)
    return cell(measured)


def _printed(names: Sequence[str], values: Optional[Sequence[str]], name: str) -> Cell:
    return printed(values[names.index(name)]) if values and name in names else Cell()


def _by_dataset(groups: Sequence[Group], paper: Paper) -> Dict[str, List[str]]:
    """The scenes at hand of each of the paper's data sets that has some."""
    found = {dataset: sorted({group.scene for group in groups if group.dataset(paper["datasets"]) == dataset})
             for dataset in paper["datasets"]}
    return {dataset: scenes for dataset, scenes in found.items() if scenes}


def _scene_notes(groups: Sequence[Group], paper: Paper) -> List[str]:
    """Which scenes our averages are of, where the paper's are of more; which of its data sets are left out."""
    ours = _by_dataset(groups, paper)
    notes = [f"{dataset}: ours is of {', '.join(ours[dataset])} alone; the paper averages {len(scenes)} scenes."
             for dataset, scenes in paper["datasets"].items() if dataset in ours and ours[dataset] != sorted(scenes)]
    absent = [dataset for dataset in paper["datasets"] if dataset not in ours]
    if absent:
        notes.append(f"The paper's {' and '.join(absent)} are left out: no scene of theirs was run.")
    return notes


def _notes(groups: Sequence[Group]) -> List[str]:
    """What a reader must know of the figures: spread, megabytes, LPIPS, budget, machines."""
    rows = _rows(groups)
    notes = [SPREAD_NOTE]
    if any(figure(row, "size_own_mb") is not None or figure(row, "size_common_mb") is not None for row in rows):
        notes.append("1 MB is 1,000,000 bytes. Own size: the method's own container; common size: one for all methods.")
    notes += [f"Not measured, {reason.rstrip('.')}." for reason in lpips_reasons(rows)]
    if lpips_figures(rows):
        notes.append("LPIPS of different nets or normalisations cannot be compared.")
    machines = sorted({_machine(row) for row in rows if _machine(row)})
    if machines:
        notes.append(f"Measured on {', '.join(machines)}; times and FPS compare on one machine only.")
    notes += sorted({row["fps_note"] for row in rows if row.get("fps_note")})
    return notes + _shared_notes(rows)


def _shared_notes(rows: Sequence[Row]) -> List[str]:
    return [SHARED_NOTE] if any(map(shared_gpu, rows)) else []


def _machine(row: Row) -> str:
    machine = row.get("machine") or (row.get("protocol") or {}).get("machine") or ""
    if isinstance(machine, dict):
        return str(machine.get("gpu") or machine.get("name") or machine.get("cpu") or machine.get("device") or "")
    return str(machine)


def commits(rows: Sequence[Row]) -> List[str]:
    """The commits of this project and of trainers that rows were measured with."""
    found = set()
    for row in rows:
        commit = row.get("commit")
        named = commit.items() if isinstance(commit, dict) else [("project", commit)]
        found |= {f"{name} {value}" for name, value in named if value}
    return sorted(found)
