"""Which tables a suite gets: those of the paper with its printed figures beside ours, every cell, deltas, failures."""
from __future__ import annotations

import statistics
from pathlib import Path
from typing import Dict, Iterator, List, Optional, Sequence, Set, Tuple

from diff_smoe_rasterization.settings import GATED_MODES
from diff_smoe_rasterization.settings import PAPER as PAPER_WORD

from ..names import read_json
from ..rows import Row
from . import groups as grouping
from . import tables
from .groups import Cell, Group, Setting, device_of, grouped, is_alone, lpips_figures, over, safe_name, some
from .tables import OURS, Column, Table, TableRow, column

PAPER = read_json(Path(__file__).with_name("paper.json"))  # what it prints, and which names of ours stand for its rows
SOURCE = PAPER["source"] + "."
END_NAMES = ("sparse", "dense")
ABLATION = {"smoe_eq7": "full", "smoe_tn": "without T_d", "smoe_std": "without T_n,d"}  # their cuts are the same
PAPERS = f"smoe {PAPER_WORD}"  # the program that made the paper's figures
COMPARED = ("alpha", "smoe")
SCENES, SEEDS = "scenes", "seeds"  # the columns that say of which scenes and how many seeds an average is
MOST_PAIRS = 20  # are named in a note
SHARED_NOTE = (f"Times and FPS are of cells that shared no GPU or CPU. {grouping.SHARED}: several cells ran on "
               "it at once, so their times are left out; the rows have them.")
SCENES_NOTE = "A method's averages are over the scenes that all of its blends have: compare rows of equal scenes only."
SPREAD_NOTE = "± is the sample standard deviation over seeds; figures without it are of one seed."

ByScene = Dict[str, Group]
Place = Tuple[Optional[str], List[str]]  # the paper's name of a set of scenes, None if it prints one figure for all


def end_of(row: Row) -> Optional[str]:
    """ "sparse" or "dense" if a row belongs to that end of the paper's tables: as it says, or by its threshold."""
    by_threshold = {threshold: end for end, threshold in PAPER["ends"].items()}
    own = None if row.get("budget") is not None else by_threshold.get(row.get("densify_grad_threshold"))
    return row.get("end") or own


def tables_of(suite: str, rows: Sequence[Row]) -> List[Table]:
    """The tables of one suite's rows; those with nothing of ours in them are left out."""
    groups = grouped(rows, end_of)
    blends = {group.setting.blend: group.setting.mode for group in groups}
    made = [table1(groups), table2(groups), table3(groups),
            *(deltas(groups, base, blend) for base in COMPARED for blend, mode in blends.items()
              if mode in GATED_MODES and blend != base),
            cells(groups), failures(rows)]
    return [table.without_empty_columns()._replace(name=safe_name(f"{suite}_{table.name}")) for table in made
            if any(row.source == OURS for row in table.rows)]


def table1(groups: Sequence[Group]) -> Table:
    """The paper's Table 1: quality, number of Gaussians and size, sparse and dense.

    Columns for each of the paper's data sets that some scene at hand is of, then for each other scene.
    """
    ours = _by_dataset(groups)
    notes = [SOURCE, *_scene_notes(ours)]
    known = [scene for scenes in ours.values() for scene in scenes]
    ours.update({scene: [scene] for scene in sorted({group.scene for group in groups}) if known and scene not in known})
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(groups), "num_gaussians_m", "size_own_mb", SCENES, SEEDS]
    columns = [column(name, place if scenes in ([place], sorted(PAPER["datasets"].get(place, [])))
                      else f"{place} (ours: {', '.join(scenes)})")
               for place, scenes in ours.items() for name in names]
    rows, seed_notes = _both_ends(groups, "table1", list(ours.items()), names)
    return Table("table1", "Quality, number of Gaussians and size (the paper's Table 1)", ("end", "method"), columns,
                 rows if ours else [], [*notes, *seed_notes, *_notes(groups)])


def table2(groups: Sequence[Group]) -> Table:
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(groups), "num_gaussians_m", "size_own_mb", "train_seconds",
             "fps", SCENES, SEEDS]
    scenes = sorted({scene for end in END_NAMES for by_scene in _settings(groups, end, "table2").values()
                     for scene in by_scene})
    rows, seed_notes = _both_ends(groups, "table2", [(None, scenes)], names)
    notes = [f"{PAPER['source']}; averages of three data sets.",
             f"Ours are averages over {', '.join(scenes)}: not the paper's scenes, and not its GPU."]
    return Table("table2", "The gate in other trainers (the paper's Table 2)", ("end", "method"),
                 list(map(column, names)), rows, [*notes, *seed_notes, *_notes(groups)])


def _both_ends(groups: Sequence[Group], table: str, places: Sequence[Place],
               names: Sequence[str]) -> Tuple[List[TableRow], List[str]]:
    """The rows of Table 1 or 2, the paper's and ours at each end, and notes of the seeds that are left out."""
    rows: List[TableRow] = []
    notes: Dict[str, None] = {}
    of_end = {end: _settings(groups, end, table) for end in END_NAMES}
    if any(_common(setting, settings, scenes) != [*scenes]
           for settings in of_end.values() for setting in settings for _, scenes in places):
        notes[SCENES_NOTE] = None
    for end, settings in of_end.items():
        for method, averages in PAPER[table][end].items():
            figures = [cell for place, _ in places
                       for cell in _printed(table, averages.get(place) if place else averages, names)]
            rows.append(TableRow((end, method), figures, tables.PAPER))
        for setting in settings:
            means = [mean for _, scenes in places
                     for mean in _averages(setting, settings, scenes, names, SCENES_NOTE in notes)]
            rows.append(TableRow((end, setting.label()), means))
            notes.update(dict.fromkeys(
                note for _, scenes in places
                for note in _seed_notes(setting, _beside(setting, settings, _common(setting, settings, scenes)))))
    return rows, list(notes)


def table3(groups: Sequence[Group]) -> Table:
    names = ["psnr", "ssim", "lpips:paper", *lpips_figures(groups), "train_seconds", "num_gaussians_m"]
    ablated = {(group.setting.pair, group.scene) for group in groups
               if group.setting.blend in ("smoe_tn", "smoe_std")}
    where = f"{PAPER['table3']['dataset']}, {PAPER['table3']['end']}"
    rows = [TableRow((where, "", ABLATION[mode], ""), _printed("table3", figures, names), tables.PAPER)
            for mode, figures in PAPER["table3"]["rows"].items()]
    rows += [TableRow((f"{group.scene}, {group.setting.amount()}", group.setting.label(blend=False),
                       f"{group.setting.blend}: {ABLATION[group.setting.blend]}", group.seeds()),
                      group.measured_or_failed(names))
             for group in groups if (group.setting.pair, group.scene) in ablated and group.setting.blend in ABLATION]
    notes = [SOURCE, "T_d: the transmittance in the denominator; T_n,d: in both.", *_notes(groups)]
    return Table("table3", "Ablation of the transmittance (the paper's Table 3)",
                 ("scene, threshold", "method", "gate", "seeds"), list(map(column, names)), rows, notes)


def deltas(groups: Sequence[Group], base: str, blend: str) -> Table:
    """A blend against another in equal settings, seed by seed; beside smoe against alpha what the paper prints."""
    is_papers = base == "alpha" and blend in ("smoe", PAPERS)
    differences = ["psnr", "psnr_edge", "ssim", *lpips_figures(groups)]
    ratios = ["num_gaussians", "size_own_mb", "train_seconds", "fps"]
    rows = list(_papers_deltas([*differences, *ratios])) if is_papers else []
    unequal: List[str] = []
    by_key = {(group.setting, group.scene): group for group in groups}
    for group in groups:
        gated = by_key.get((group.setting._replace(blend=blend), group.scene))
        if group.setting.blend != base or gated is None:
            continue
        failed = [f"{either.setting.blend} failed" for either in (group, gated) if not either.rows]
        found = [over((group, gated), name, grouping.difference) for name in differences]
        found += [over((group, gated), name, grouping.ratio) for name in ratios]
        if failed:
            found[0] = Cell(text=", ".join(failed))
        labels = (group.scene, group.setting.label(blend=False), group.setting.amount())
        both = sorted({*group.by_seed} & {*gated.by_seed})
        rows.append(TableRow((*labels, str(len(both))), found))
        commits_ = {seed: _unequal(group.by_seed[seed], gated.by_seed[seed]) for seed in both}
        unequal += [f"{', '.join(labels)}, seed {seed}: {words}" for seed, words in commits_.items() if words]
    columns = [column(name, difference=True) for name in differences]
    columns += [Column(f"{column(name).name.partition(' [')[0]} ratio", 2) for name in ratios]
    papers = " The paper's are of its printed averages over a data set." if is_papers else ""
    notes = [f"Δ: {blend} less {base}; ratio: {blend} over {base}; of seeds that both have.{papers}", SPREAD_NOTE,
             *_shared_notes(groups)]
    if unequal:
        notes.append(f"{base} and {blend} are of different commits in {len(unequal)} "
                     f"{'pair' if len(unequal) == 1 else 'pairs'}: {some(unequal, MOST_PAIRS)}.")
    name = "deltas" if (base, blend) == COMPARED else f"deltas_{blend}_{base}"
    return Table(name, f"{blend} against {base}, all else equal",
                 ("scene", "method", "threshold", "seeds"), columns, rows, notes)


def _papers_deltas(names: Sequence[str]) -> Iterator[TableRow]:
    for end in END_NAMES:
        for dataset in PAPER["datasets"]:
            alpha, smoe = (dict(zip(PAPER["table1"]["columns"], map(float, PAPER["table1"][end][method][dataset])))
                           for method in ("3DGS", "3DSMoES"))
            found = {"psnr": smoe["psnr"] - alpha["psnr"], "ssim": smoe["ssim"] - alpha["ssim"],
                     "num_gaussians": smoe["num_gaussians_m"] / alpha["num_gaussians_m"],
                     "size_own_mb": smoe["size_own_mb"] / alpha["size_own_mb"]}
            yield TableRow((dataset, "3DGS", f"{PAPER['ends'][end]:g} ({end})", ""),
                           [Cell(found.get(name)) for name in names], tables.PAPER)


def cells(groups: Sequence[Group]) -> Table:
    names = ["psnr", "psnr_float", "psnr_edge", "ssim", *lpips_figures(groups), "num_gaussians", "size_own_mb",
             "size_common_mb", "train_seconds", "wall_seconds", "fps", "peak_gpu_mib", "learned_gate"]
    rows = [TableRow((group.scene, group.setting.label(), group.setting.amount(), group.seeds()),
                     group.measured_or_failed(names)) for group in groups]
    return Table("cells", "All settings", ("scene", "method", "threshold", "seeds"), list(map(column, names)), rows,
                 _notes(groups))


def failures(rows: Sequence[Row]) -> Table:
    return Table("failures", "Cells that failed", ("cell", "reason"), [],
                 [TableRow((row["cell"], row.get("reason") or "no reason was written"), [])
                  for row in rows if not row["ok"]], [])


def _settings(groups: Sequence[Group], end: str, table: str) -> Dict[Setting, ByScene]:
    """The settings of an end whose method stands in a table of the paper, each with its groups by scene, in order."""
    found: Dict[Setting, ByScene] = {}
    for group in groups:
        names = PAPER["names"].get(group.setting.method, {})
        if group.setting.end == end and any(name in PAPER[table][end] for name in names.values()):
            found.setdefault(group.setting, {})[group.scene] = group
    return dict(sorted(found.items(), key=lambda item: item[0].order()))


def _common(setting: Setting, settings: Dict[Setting, ByScene], scenes: Sequence[str]) -> List[str]:
    """The scenes of which all blends of a method have rows; one that has none of these scenes does not count."""
    blends = [by_scene for other, by_scene in settings.items()
              if other.pair == setting.pair and {*by_scene} & {*scenes}]
    return [scene for scene in scenes if all(scene in by_scene for by_scene in blends)]


def _averages(setting: Setting, settings: Dict[Setting, ByScene], scenes: Sequence[str],
              names: Sequence[str], names_scenes: bool) -> List[Cell]:
    """The means over the scenes that are common to a method's blends, or why there is none.

    A scene that failed is not left out: then there is no mean. names_scenes: the cells say which scenes these are.
    """
    by_scene, common_scenes = settings[setting], _common(setting, settings, scenes)
    failed = [scene for scene in common_scenes if scene in by_scene and not by_scene[scene].rows]
    is_absent = not {*by_scene} & {*scenes}
    common, left_out = _seeds(_beside(setting, settings, common_scenes))
    if failed or is_absent or not common:
        text = ("failed" if failed else "not run" if is_absent else "no common scene" if not common_scenes
                else "no common seed")
        if len(scenes) > 1 and failed:
            text += ": " + ", ".join(failed)
        return [Cell(text=text if name == "psnr" else "") for name in names]
    said = {SCENES: Cell(text=", ".join(common_scenes) if names_scenes else ""),
            SEEDS: Cell(text=f"{len(common)} of {len(common) + len(left_out)}") if left_out else Cell(len(common))}
    groups = [by_scene[scene] for scene in common_scenes]
    return [said[name] if name in said else over(groups, name, statistics.fmean, common) for name in names]


def _beside(setting: Setting, settings: Dict[Setting, ByScene], scenes: Sequence[str]) -> List[Group]:
    """What takes its averages of the same seeds: every scene, in alpha and smoe too if these have all scenes."""
    blends = [by_scene for other, by_scene in settings.items() if other == setting
             or (other.pair == setting.pair and other.mode in COMPARED)]
    return [by_scene[scene] for by_scene in blends for scene in scenes
            if all(scene in by_scene and by_scene[scene].rows for scene in scenes)]


def _seeds(groups: Sequence[Group]) -> Tuple[Set[int], Set[int]]:
    """The seeds that all groups have, and those that some lack."""
    common = set.intersection(*({*group.by_seed} for group in groups)) if groups else set()
    return common, {row["seed"] for group in groups for row in group.rows + group.failed} - common


def _seed_notes(setting: Setting, groups: Sequence[Group]) -> Iterator[str]:
    for seed in sorted(_seeds(groups)[1]):
        lacking = [f"{group.setting.blend} "
                   f"{'failed' if any(row['seed'] == seed for row in group.failed) else 'was not run'} on {group.scene}"
                   for group in groups if seed not in group.by_seed]
        yield (f"{setting.end}, {setting.label(blend=False)}: averages leave seed {seed} out, since "
               f"{', '.join(lacking)}.")


def _unequal(one: Row, other: Row) -> str:
    first, second = one.get("commit") or {}, other.get("commit") or {}
    return ", ".join(f"{name} {first.get(name) or 'unknown'} and {second.get(name) or 'unknown'}"
                     for name in sorted({*first, *second}) if first.get(name) != second.get(name))


def _printed(table: str, values: Optional[Sequence[str]], names: Sequence[str]) -> List[Cell]:
    found = {name: "0" + text if text.startswith(".") else text
             for name, text in zip(PAPER[table]["columns"], values or ())}
    return [Cell(float(found[name]), printed=found[name]) if name in found else Cell() for name in names]


def _by_dataset(groups: Sequence[Group]) -> Dict[str, List[str]]:
    found = {dataset: sorted({group.scene for group in groups if group.dataset(PAPER["datasets"]) == dataset})
             for dataset in PAPER["datasets"]}
    return {dataset: scenes for dataset, scenes in found.items() if scenes}


def _scene_notes(ours: Dict[str, List[str]]) -> List[str]:
    notes = [f"{dataset}: ours is only of {', '.join(ours[dataset])}; the paper averages {len(scenes)} scenes."
             for dataset, scenes in PAPER["datasets"].items() if dataset in ours and ours[dataset] != sorted(scenes)]
    absent = [dataset for dataset in PAPER["datasets"] if dataset not in ours]
    if absent:
        notes.append(f"The paper's {' and '.join(absent)} are left out: no scene of theirs was run.")
    return notes


def _notes(groups: Sequence[Group]) -> List[str]:
    notes = [SPREAD_NOTE]
    if any({"size_own_mb", "size_common_mb"} & {*figures} for group in groups for figures in group.figures.values()):
        notes.append("1 MB is 1,000,000 bytes. Own size: the method's own container; common size: one for all methods.")
    reasons = grouping.lpips_reasons(row for group in groups for row in group.rows)
    notes += [f"Not measured, {reason.rstrip('.')}." for reason in reasons]
    if lpips_figures(groups):
        notes.append("LPIPS of different nets or normalisations cannot be compared.")
    machines: Dict[str, List[str]] = {}
    for group in groups:
        for device in filter(None, map(device_of, group.rows)):
            machines.setdefault(device, []).append(group.setting.label())
    of = [device + (f" ({'; '.join(dict.fromkeys(labels))})" if len(machines) > 1 else "")
          for device, labels in sorted(machines.items())]
    if of:
        notes.append(f"Measured on {', '.join(of)}; times and FPS compare on one machine only.")
    return notes + _shared_notes(groups)


def _shared_notes(groups: Sequence[Group]) -> List[str]:
    return [] if all(is_alone(row) for group in groups for row in group.rows) else [SHARED_NOTE]


def commits(rows: Sequence[Row]) -> List[str]:
    return sorted({f"{name} {value}" for row in rows for name, value in (row.get("commit") or {}).items() if value})
