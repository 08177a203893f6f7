"""Which tables a suite gets: those of the paper with its printed figures beside ours, every cell, deltas, failures."""
from __future__ import annotations

import functools
import json
import os
import statistics
from typing import Any, Dict, List, Optional, Sequence, Set, Tuple

from ..rows import Row
from .groups import (
    SHARED,
    Cell,
    Group,
    Setting,
    device_of,
    difference,
    grouped,
    is_alone,
    lpips_figures,
    lpips_reasons,
    over,
    ratio,
    safe_name,
    some,
)
from .tables import OURS, PAPER, Column, Table, TableRow, column, printed, without_empty_columns

Paper = Dict[str, Any]
END_NAMES = ("sparse", "dense")
ABLATION = {"smoe": "full", "smoe_tn": "without T_d", "smoe_std": "without T_n,d"}
COMPARED = ("alpha", "smoe")
SEEDS = "seeds"  # the column that says how many seeds an average over scenes is of
MOST_PAIRS = 20  # are named in a note
SHARED_NOTE = (f"Times and FPS are of cells that had their GPU or CPU alone. {SHARED}: several cells had it at once, "
               "so theirs are not the machine's; the rows have them.")
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
    blends = {group.setting.blend: group.setting.mode for group in groups}
    made = [table1(groups, paper), table2(groups, paper), table3(groups, paper),
            *(deltas(groups, paper, base, blend) for base in COMPARED for blend, mode in blends.items()
              if mode == "smoe" and blend != base),
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
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(groups), "num_gaussians_m", "size_own_mb", SEEDS]
    columns = tuple(column(name, place if scenes in ([place], sorted(paper["datasets"].get(place, [])))
                           else f"{place} (ours: {', '.join(scenes)})")
                    for place, scenes in ours.items() for name in names)
    rows, seed_notes = _both_ends(groups, paper, "table1", list(ours.items()), names)
    notes = [paper["source"] + ".", *_scene_notes(groups, paper), *seed_notes, *_notes(groups)]
    return without_empty_columns(Table("table1", "Quality, number of Gaussians and size (the paper's Table 1)",
                                       ("end", "method"), columns, rows, tuple(notes)))


def table2(groups: Sequence[Group], paper: Paper) -> Table:
    """The paper's Table 2: other trainers with the gate put in; averages over all scenes at hand."""
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(groups), "num_gaussians_m", "size_own_mb", "train_seconds",
             "fps", SEEDS]
    scenes = sorted({group.scene for group in groups})
    rows, seed_notes = _both_ends(groups, paper, "table2", [(None, scenes)], names)
    notes = [paper["source"] + "; averages of three data sets.",
             f"Ours are averages over {', '.join(scenes)}: not the paper's scenes, and not its GPU.", *seed_notes,
             *_notes(groups)]
    return without_empty_columns(Table("table2", "The gate in other trainers (the paper's Table 2)", ("end", "method"),
                                       tuple(map(column, names)), rows, tuple(notes)))


def _both_ends(groups: Sequence[Group], paper: Paper, table: str, places: Sequence[Tuple[Optional[str], List[str]]],
               names: Sequence[str]) -> Tuple[Tuple[TableRow, ...], List[str]]:
    """The rows of Table 1 or 2, the paper's and ours at each end, and notes of the seeds that are left out.

    places: the paper's name of a set of scenes, or None where it prints one figure for all, and our scenes of it.
    """
    rows: List[TableRow] = []
    notes: List[str] = []
    for end in END_NAMES:
        for method, averages in paper[table][end].items():
            cells_ = [_printed(paper[table]["columns"], averages.get(place) if place else averages, name)
                      for place, _ in places for name in names]
            rows.append(TableRow((end, method), tuple(cells_), PAPER))
        settings = _settings(groups, end, paper, table)
        for setting in settings:
            cells_ = [entry for _, scenes in places for entry in _averages(setting, settings, scenes, names)]
            rows.append(TableRow((end, setting.label()), tuple(cells_)))
        notes += _seed_notes(settings, [scenes for _, scenes in places])
    return tuple(rows), notes


def table3(groups: Sequence[Group], paper: Paper) -> Table:
    """The paper's Table 3: the gate without the transmittance, in its denominator and altogether."""
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(groups), "train_seconds", "num_gaussians_m"]
    ablated = {(group.setting.pair, group.scene) for group in groups
               if group.setting.blend in ("smoe_tn", "smoe_std")}
    printed_rows, where = paper["table3"]["rows"], f"{paper['table3']['dataset']}, {paper['table3']['end']}"
    rows = [TableRow((where, "", ABLATION[mode], ""),
                     tuple(_printed(paper["table3"]["columns"], figures, name) for name in names), PAPER)
            for mode, figures in printed_rows.items()]
    for group in groups:
        if (group.setting.pair, group.scene) in ablated and group.setting.blend in ABLATION:
            labels = (f"{group.scene}, {group.setting.amount()}", group.setting.label(blend=False),
                      f"{group.setting.blend}: {ABLATION[group.setting.blend]}", group.seeds())
            rows.append(TableRow(labels, tuple(_seeds_cell(group, name) for name in names)))
    notes = (paper["source"] + ".", "T_d: the transmittance in the denominator; T_n,d: in both.", *_notes(groups))
    return without_empty_columns(Table("table3", "Ablation of the transmittance (the paper's Table 3)",
                                       ("scene, threshold", "method", "gate", "seeds"),
                                       tuple(column(name) for name in names), tuple(rows), notes))


def deltas(groups: Sequence[Group], paper: Paper, base: str, blend: str) -> Table:
    """A blend against another in equal settings, seed by seed; beside smoe against alpha what the paper prints."""
    is_papers = (base, blend) == COMPARED
    by_key = {(group.setting, group.scene): group for group in groups}
    differences = ["psnr", "psnr_edge", "ssim", *lpips_figures(groups)]
    ratios = ["num_gaussians", "size_own_mb", "train_seconds", "fps"]
    rows: List[TableRow] = []
    unequal: List[str] = []
    for end in END_NAMES if is_papers else ():
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
        gated = by_key.get((group.setting._replace(blend=blend), group.scene))
        if group.setting.blend != base or gated is None:
            continue
        failed = [f"{either.setting.blend} failed" for either in (group, gated) if not either.rows]
        cells_ = [over((group, gated), name, difference) for name in differences]
        cells_ += [over((group, gated), name, ratio) for name in ratios]
        if failed:
            cells_[0] = Cell(text=", ".join(failed))
        labels = (group.scene, group.setting.label(blend=False), group.setting.amount())
        both = sorted({*group.by_seed} & {*gated.by_seed})
        rows.append(TableRow((*labels, str(len(both))), tuple(cells_)))
        unequal += [f"{', '.join(labels)}, seed {seed}: {commits_}" for seed in both
                    for commits_ in [_unequal(group.by_seed[seed], gated.by_seed[seed])] if commits_]
    columns = [column(name, difference=True) for name in differences]
    columns += [Column(f"{column(name).name.partition(' [')[0]} ratio", 2) for name in ratios]
    papers = " The paper's are of its printed averages over a data set." if is_papers else ""
    notes = (f"Δ: {blend} less {base}; ratio: {blend} over {base}; of seeds that both have.{papers}", SPREAD_NOTE,
             *_shared_notes(_rows(groups)))
    if unequal:
        notes += (f"{base} and {blend} are of different commits in {len(unequal)} "
                  f"{'pair' if len(unequal) == 1 else 'pairs'}: {some(unequal, MOST_PAIRS)}.",)
    return without_empty_columns(Table("deltas" if is_papers else f"deltas_{blend}_{base}",
                                       f"{blend} against {base}, all else equal",
                                       ("scene", "method", "threshold", "seeds"), tuple(columns), tuple(rows), notes))


def cells(groups: Sequence[Group]) -> Table:
    """Every setting on every scene, averaged over seeds, with all that was measured."""
    names = ["psnr", "psnr_float", "psnr_edge", "ssim", *lpips_figures(groups), "num_gaussians", "size_own_mb",
             "size_common_mb", "train_seconds", "wall_seconds", "fps", "peak_gpu_mib", "learned_gate"]
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


def _settings(groups: Sequence[Group], end: str, paper: Paper, table: str) -> Dict[Setting, Dict[str, Group]]:
    """The settings of an end whose method stands in a table of the paper, each with its groups by scene, in order."""
    found: Dict[Setting, Dict[str, Group]] = {}
    for group in groups:
        names = paper["names"].get(group.setting.method, {})
        if group.setting.end == end and any(name in paper[table][end] for name in names.values()):
            found.setdefault(group.setting, {})[group.scene] = group
    return dict(sorted(found.items(), key=lambda item: item[0].order()))


def _averages(setting: Setting, settings: Dict[Setting, Dict[str, Group]], scenes: Sequence[str],
              names: Sequence[str]) -> List[Cell]:
    """The means over scenes, or which of them failed or were not run: an average never leaves a scene out."""
    by_scene = settings[setting]
    failed = [scene for scene in scenes if scene in by_scene and not by_scene[scene].rows]
    absent = [scene for scene in scenes if scene not in by_scene]
    common, left_out = _seeds(_beside(setting, settings, scenes))
    if failed or absent or not common:
        text = "failed" if failed else "not run" if absent else "no common seed"
        if len(scenes) > 1 and (failed or absent):
            text += ": " + ", ".join(failed or absent)
        return [Cell(text=text if name == "psnr" else "") for name in names]
    seeds = Cell(text=f"{len(common)} of {len(common) + len(left_out)}") if left_out else Cell(len(common))
    groups = [by_scene[scene] for scene in scenes]
    return [seeds if name == SEEDS else over(groups, name, statistics.fmean, common) for name in names]


def _beside(setting: Setting, settings: Dict[Setting, Dict[str, Group]], scenes: Sequence[str]) -> List[Group]:
    """What takes its averages of the same seeds: every scene, in alpha and smoe too where these have all scenes."""
    blends = [by_scene for other, by_scene in settings.items() if other == setting
             or (other.pair == setting.pair and other.mode in COMPARED)]
    return [by_scene[scene] for by_scene in blends for scene in scenes
            if all(scene in by_scene and by_scene[scene].rows for scene in scenes)]


def _seeds(groups: Sequence[Group]) -> Tuple[Set[int], Set[int]]:
    """The seeds that all groups have, and those that some lack."""
    common = set.intersection(*({*group.by_seed} for group in groups)) if groups else set()
    return common, {row["seed"] for group in groups for row in group.rows + group.failed} - common


def _seed_notes(settings: Dict[Setting, Dict[str, Group]], places: Sequence[Sequence[str]]) -> List[str]:
    """Which seeds averages leave out, and why."""
    notes = []
    for setting in settings:
        for groups in (_beside(setting, settings, scenes) for scenes in places):
            for seed in sorted(_seeds(groups)[1]):
                lacking = [f"{group.setting.blend} "
                           f"{'failed' if any(row['seed'] == seed for row in group.failed) else 'was not run'} on "
                           f"{group.scene}" for group in groups if seed not in group.by_seed]
                notes.append(f"{setting.end}, {setting.label(blend=False)}: averages leave seed {seed} out, "
                             f"since {', '.join(lacking)}.")
    return list(dict.fromkeys(notes))


def _unequal(one: Row, other: Row) -> str:
    """The commits of two rows where they differ."""
    first, second = one.get("commit") or {}, other.get("commit") or {}
    return ", ".join(f"{name} {first.get(name) or 'unknown'} and {second.get(name) or 'unknown'}"
                     for name in sorted({*first, *second}) if first.get(name) != second.get(name))


def _seeds_cell(group: Group, name: str) -> Cell:
    if name == "psnr" and group.failed and not group.rows:
        return Cell(text="failed")
    return group.measured(name)


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
    if any({"size_own_mb", "size_common_mb"} & {*figures} for group in groups for figures in group.figures.values()):
        notes.append("1 MB is 1,000,000 bytes. Own size: the method's own container; common size: one for all methods.")
    notes += [f"Not measured, {reason.rstrip('.')}." for reason in lpips_reasons(rows)]
    if lpips_figures(groups):
        notes.append("LPIPS of different nets or normalisations cannot be compared.")
    machines: Dict[str, List[str]] = {}
    for group in groups:
        for device in filter(None, map(device_of, group.rows)):
            machines.setdefault(device, []).append(group.setting.label())
    of = {device: f" ({'; '.join(dict.fromkeys(labels))})" if len(machines) > 1 else ""
          for device, labels in sorted(machines.items())}
    if of:
        notes.append(f"Measured on {', '.join(device + whose for device, whose in of.items())}; times and FPS compare "
                     "on one machine only.")
    return notes + _shared_notes(rows)


def _shared_notes(rows: Sequence[Row]) -> List[str]:
    return [] if all(map(is_alone, rows)) else [SHARED_NOTE]


def commits(rows: Sequence[Row]) -> List[str]:
    """The commits of this project and of trainers that rows were measured with."""
    return sorted({f"{name} {value}" for row in rows for name, value in (row.get("commit") or {}).items() if value})
