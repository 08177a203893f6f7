"""Prints what README.md, RESULTS.md, NOTES.md and docs/ take from rows in results/, and draws docs/budget-bonsai.png.

    python benchmarks/tables.py                                # tables and sentences, for the pages
    python benchmarks/tables.py --figure docs/budget-bonsai.png
"""
from __future__ import annotations

import argparse
import json
import math
import os
import statistics
from pathlib import Path
from typing import Any, Callable, Dict, Iterable, List, Optional, Sequence, Tuple

Row = Dict[str, Any]
RESULTS = Path(__file__).resolve().parent / "results"
BLENDS = ("alpha", "smoe")
SCENES = ("bonsai", "fox", "office_table", "room35", "lego")
LEVELS = {"bonsai": (28.0, 29.0, 30.0, 31.0, 31.5), "fox": (28.0, 29.0, 29.5)}  # dB that both blends pass
SPARSE, DENSE = ([(scene, end) for scene in ("bonsai", "fox", "room35")] for end in (0.005, 0.0002))
LEGO = [("lego", end) for end in (0.005, 0.001, 0.0002)]


def rows_of(name: str) -> List[Row]:
    """The rows of a .jsonl. An object "shared" on a line has what the rows below it do not say."""
    rows: List[Row] = []
    shared: Row = {}
    for line in (RESULTS / name).read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        if isinstance(entry.get("shared"), dict):
            shared = entry["shared"]
        else:
            rows.append(merged(shared, entry))
    return rows


def read(name: str) -> Any:
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


def merged(shared: Row, row: Row) -> Row:
    return {**shared, **{name: merged(shared[name], value) if isinstance(value, dict) and isinstance(
        shared.get(name), dict) else value for name, value in row.items()}}


def trainings() -> List[Row]:
    """alpha, and smoe with a learned gate by the rule of covered pixels: by 3DGS densification, and with a budget.

    A scene and budget whose blends do not have three seeds each with today's defaults of `importance` has earlier ones.
    """
    earlier = [row for row in rows_of("tails_h100.jsonl") + rows_of("near_h200.jsonl") if row["blend_mode"] == "alpha"]
    earlier += [row for row in rows_of("near_h100.jsonl") + rows_of("near_h200.jsonl")
                if row["blend_mode"] == "smoe" and row["background_gate"] == "learned"]
    today = grouped((row for row in rows_of("budgets_h100.jsonl") if "needs=3" in row["protocol"]["strategy_options"]),
                    "scene", "budget")
    complete = {cell: rows for cell, rows in today.items()
                if all(len(grouped(rows, "blend_mode").get((blend,), [])) >= 3 for blend in BLENDS)}
    return [row for row in earlier if row["strategy"] == "3dgs" or (row["scene"], row["budget"]) not in complete] + [
        row for rows in complete.values() for row in rows]


def grouped(rows: Iterable[Row], *names: str) -> Dict[Tuple, List[Row]]:
    found: Dict[Tuple, List[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in names), []).append(row)
    return found


def in_order(cells: Dict[Tuple, Any], sign: int = -1) -> Dict[Tuple, Any]:
    """Cells by (scene, amount): scenes as in SCENES, the largest amounts first; sign 1: last."""
    return dict(sorted(cells.items(), key=lambda item: (SCENES.index(item[0][0]), sign * item[0][1])))


def mean(rows: Sequence[Row], name: str) -> float:
    return statistics.fmean(row[name] for row in rows)


def shown(rows: Sequence[Row], name: str, digits: int) -> str:
    spread = f"±{statistics.stdev(row[name] for row in rows):.{digits}f}" if len(rows) > 1 else ""
    return f"{mean(rows, name):.{digits}f}{spread}"


def thousands(rows: Sequence[Row]) -> str:
    number = mean(rows, "num_gaussians") / 1000
    return f"{number:,.{0 if number > 99.95 else 1}f}k"


def quality(rows: Sequence[Row]) -> str:
    """PSNR and number of Gaussians."""
    return f"{shown(rows, 'psnr', 2)}, {thousands(rows)}"


def figures(rows: Sequence[Row]) -> List[str]:
    """PSNR, SSIM and LPIPS by AlexNet, if it was measured."""
    lpips = [(row.get("lpips") or {}).get("value") for row in rows]
    return [shown(rows, "psnr", 2), f"{mean(rows, 'ssim'):.3f}",
            "–" if None in lpips else f"{statistics.fmean(lpips):.3f}"]


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *lines)).replace(
        " --- ", "---")


def less(rows: Sequence[Row], others: Sequence[Row], name: str) -> float:
    return mean(rows, name) - mean(others, name)


def better(rows: Sequence[Row], others: Sequence[Row]) -> float:
    """By how many dB."""
    return less(rows, others, "psnr")


def fewer(rows: Sequence[Row], others: Sequence[Row]) -> float:
    """By how many per cent."""
    return 100 * (1 - mean(rows, "num_gaussians") / mean(others, "num_gaussians"))


def signed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:+.{digits}f}"  # 0.0: no -0


def budget_table(rows: Sequence[Row]) -> str:
    """A line for each scene and number of Gaussians; differences are of runs with the same seed."""
    lines = []
    of_budgets = grouped((row for row in rows if row["budget"]), "scene", "budget")
    for (scene, budget), cells in in_order(of_budgets, 1).items():
        alpha, smoe = (grouped(cells, "blend_mode")[blend,] for blend in BLENDS)
        of_seed = {row["seed"]: row["psnr"] for row in alpha}
        smoe.sort(key=lambda row: row["seed"])
        differences = [f"{row['psnr'] - of_seed[row['seed']]:+.2f}" for row in smoe]
        both = [", ".join(figures(rows)[::2]) for rows in (alpha, smoe)]  # without SSIM
        lines.append([f"{scene}, {budget:,}", *both, ", ".join(differences), signed(less(smoe, alpha, "psnr_edge"), 2)])
    return table(["scene, Gaussians: PSNR, LPIPS", "alpha", "smoe", "difference by seed", "near edges"], lines)


def recipe_cells() -> Dict[Tuple[str, float], Dict[str, List[Row]]]:
    """Rows of 3DGS densification by scene and threshold, then by rule: "alpha", "smoe", "gate 0", "Eq. 7"."""
    rows = [row for row in trainings() if row["strategy"] == "3dgs"]
    found = {key: {blend: grouped(cells, "blend_mode")[blend,] for blend in BLENDS}
             for key, cells in grouped(rows, "scene", "densify_grad_threshold").items()}
    fixed = [row for row in rows_of("tails_h100.jsonl") if row["strategy"] == "3dgs" and row["background_gate"] == 0]
    for (scene, threshold, blend), cells in grouped(fixed, "scene", "densify_grad_threshold", "blend_mode").items():
        if blend in ("smoe", "smoe_eq7"):
            found[scene, threshold]["gate 0" if blend == "smoe" else "Eq. 7"] = cells
    return in_order(found)


def changes(of: Callable[..., float], rule: str, places: Iterable[Tuple[str, float]], against: str = "alpha"
            ) -> List[float]:
    """What a rule changes by 3DGS densification, in the cells (scene, threshold); of: `fewer`, `better`."""
    cells = recipe_cells()
    return [of(cells[place][rule], cells[place][against]) for place in places]


def recipe_table() -> str:
    """A line for each scene and threshold: PSNR and number; what smoe gains near edges."""
    return table(["", "alpha", "smoe", "near edges"], (
        [f"{scene} {threshold:g}", *(quality(rules[blend]) for blend in BLENDS),
         signed(less(rules["smoe"], rules["alpha"], "psnr_edge"), 1)]
        for (scene, threshold), rules in recipe_cells().items()))


def number_at(points: Sequence[Tuple[float, float]], psnr: float) -> Optional[float]:
    """How many Gaussians have that PSNR; points: (number, PSNR) by number, their logarithms are interpolated."""
    for (few, low), (many, high) in zip(points, points[1:]):
        if low <= psnr <= high:
            return few * (many / few)**((psnr - low) / (high - low))
    return None


def levels() -> List[Tuple[str, float, float, float]]:
    """(scene, PSNR, Gaussians by alpha, by smoe) by 3DGS densification."""
    cells = recipe_cells()
    found = []
    for scene, levels_of_scene in LEVELS.items():
        curves = [sorted((mean(rules[blend], "num_gaussians"), mean(rules[blend], "psnr"))
                         for (name, _), rules in cells.items() if name == scene) for blend in BLENDS]
        for psnr in levels_of_scene:
            alpha, smoe = (number_at(curve, psnr) for curve in curves)
            assert alpha and smoe, f"{scene}: no two thresholds lie around {psnr} dB"
            found.append((scene, psnr, alpha, smoe))
    return found


def table_1() -> str:
    """The paper's Table 1 on bonsai: a line for each method, sparse and dense."""
    cells, rows = recipe_cells(), trainings()
    others = {row["label"] + f"{row['densify_grad_threshold']:g}": [row]
              for row in rows_of("captures_baselines_h200.jsonl")}
    budgets = grouped((row for row in rows if row["scene"] == "bonsai"), "blend_mode", "budget")
    methods = {"3DGS (alpha)": [cells["bonsai", end]["alpha"] for end in (0.005, 0.0002)],
               "2DGS": [others["2dgs-unpatched0.005"], others["2dgs-unpatched0.0002"]],
               "Deformable Beta Splatting": [others["dbs-sparse0.0002"], others["dbs-dense0.0002"]],
               "smoe, the authors' program": [cells["bonsai", end]["gate 0"] for end in (0.005, 0.0002)],
               "smoe, learned gate": [cells["bonsai", end]["smoe"] for end in (0.005, 0.0002)],
               "smoe, `--budget`": [budgets["smoe", 30_000], budgets["smoe", 100_000]]}
    return table(["PSNR, SSIM, LPIPS, number, MB", "sparse", "dense"], ([name, *(", ".join([
        *figures(rows), thousands(rows), f"{statistics.fmean(map(megabytes, rows)):.1f}"]) for rows in ends)]
        for name, ends in methods.items()))


def plugged(trainers: Sequence[str], density: str) -> Tuple[List[float], List[float]]:
    """Public trainers on bonsai and fox, patched, less their own rasterizer: dB, and per cent of Gaussians saved."""
    cells = grouped(rows_of("trainers_tails_h100.jsonl") + rows_of("trainers_tails_h200.jsonl"),
                    "trainer", "density", "scene", "blend_mode")
    pairs = [[cells[trainer, density, scene, blend] for blend in BLENDS]
             for trainer in trainers for scene in ("bonsai", "fox")]
    return [better(smoe, alpha) for alpha, smoe in pairs], [fewer(smoe, alpha) for alpha, smoe in pairs]


def plugged_2024() -> Tuple[List[Row], List[Row]]:
    """alpha and smoe without a gate in the 3DGS of 2024 at 0.0002 on bonsai: all runs."""
    rows = [row for row in rows_of("trainers_h200.jsonl") if row["blend_mode"] == "alpha"]
    rows += [row for row in rows_of("trainers_tails_h100.jsonl") if row["density"] == "dense"]
    rows += [{**row, "trainer": row["label"]} for row in rows_of("trainers_gate_h100.jsonl")
             if row["densify_grad_threshold"] == 0.0002 and row["background_gate"] == 0]
    cells = grouped(rows, "trainer", "scene", "blend_mode")
    return cells["3dgs-2024", "bonsai", "alpha"], cells["3dgs-2024", "bonsai", "smoe"]


ABLATED = {"smoe_tn": "without T in the denominator (Eq. 8)", "smoe_std": "without T (Eq. 6)"}


def ablations() -> Dict[Tuple[float, str], List[Row]]:
    """bonsai by the ablations and by Eq. 7, whose cut is the same: rows by threshold and blend."""
    rows = [row for row in rows_of("tails_h100.jsonl") + rows_of("near_h200.jsonl")
            if row["scene"] == "bonsai" and row["strategy"] == "3dgs" and row["background_gate"] == 0
            and row["densify_grad_threshold"] in (0.005, 0.0002)]
    return {key: cells for key, cells in grouped(rows, "densify_grad_threshold", "blend_mode").items()  # type: ignore
            if key[1] in ("smoe_eq7", *ABLATED)}


def transmittance_table() -> str:
    cells = ablations()
    return table(["bonsai", "Eq. 7", *ABLATED.values()], (
        [f"{end:g}", *(quality(cells[end, blend]) for blend in ("smoe_eq7", *ABLATED))] for end in (0.005, 0.0002)))


TRAINERS = {"3dgs-2023": "3DGS of 2023", "c3dgs": "c3dgs", "compact-3dgs": "Compact-3DGS", "taming": "Taming",
            "hac": "HAC", "hac-plus": "HAC++"}


def plugged_rows() -> Dict[Tuple[str, str], Dict[str, Row]]:
    """The suite `table2` on bonsai, by trainer and end ("sparse", "dense"), then by rule."""
    rows = [row for row in rows_of("table2_h200.jsonl") if row["suite"] == "table2" and row["scene"] == "bonsai"
            and row["variant"] == "patched" and row["seed"] == 0]
    found: Dict[Tuple[str, str], Dict[str, Row]] = {}
    for method, end in ((method, end) for method in TRAINERS for end in ("sparse", "dense")):
        chosen = {rule_of(row): row for row in rows if row["method"] == method and end_of(row) == end}
        if len(chosen) > 1:  # a row alone is compared with nothing
            found[method, end] = chosen
    return found


def plugged_changes() -> Dict[Tuple[str, str], Dict[str, List[float]]]:
    """Of each cell of `plugged_rows` what smoe, learned and as the authors' program, changes: dB that are gained, and
    by how many per cent primitives are fewer and files smaller."""
    found = {}
    for key, rules in plugged_rows().items():
        alpha, *others = (rules[rule] for rule in RULES if rule in rules)
        found[key] = {"gained": [row["psnr"] - alpha["psnr"] for row in others],
                      "fewer": [fewer([row], [alpha]) for row in others],
                      "smaller": [100 * (1 - megabytes(row) / megabytes(alpha)) for row in others]}
    return found


def end_of(row: Row) -> str:
    return row["end"] or ("sparse" if row["densify_grad_threshold"] > 0.001 else "dense")


def rule_of(row: Row) -> str:
    """Of RULES."""
    return ("alpha" if row["blend_mode"] == "alpha" else "learned" if row["background_gate"] == "learned" else
            "program")


def megabytes(row: Row) -> float:
    return row["size_bytes"]["own"] / 1e6


def table_2() -> str:
    """PSNR, LPIPS, primitives and megabytes of the file."""
    lines = []
    for (method, end), rules in plugged_rows().items():
        lines.append([f"{TRAINERS[method]}, {end}", *("–" if rule not in rules else ", ".join(
            [*figures([rules[rule]])[::2], thousands([rules[rule]]), f"{megabytes(rules[rule]):.2f}"])
            for rule in RULES)])
    return table(["PSNR, LPIPS, number, MB", *RULES.values()], lines)


def changed_2024() -> List[float]:
    """PSNR of smoe less alpha's in the 3DGS of 2024: as it is, without its clamp, with 2023's opacity rate, both."""
    psnr = {row["cell"]: row["psnr"] for row in rows_of("table2_h200.jsonl") if row["suite"] == "trainer-2024"}
    return [psnr[f"3dgs-2024{change}_bonsai-half_smoe-learned_s0"] - psnr[f"3dgs-2024{change}_bonsai-half_alpha_s0"]
            for change in ("", "-noclamp", "-opacity", "-noclamp-opacity")]


def between(points: Sequence[Tuple[float, float]], at: float) -> float:
    """y at an x within two points (x, y), interpolated over the logarithm of the first."""
    (left, low), (right, high) = points
    return low + (high - low) * math.log(at / left) / math.log(right / left)


def equal_size(method: str, rule: str) -> Tuple[List[float], List[float]]:
    """A rule against alpha where the sizes and the PSNR of both ends overlap: dB at equal megabytes, and per cent of
    megabytes at equal PSNR, at both ends of the overlap."""
    cells = plugged_rows()
    curves = [[(megabytes(cells[method, end][name]), cells[method, end][name]["psnr"]) for end in ("sparse", "dense")]
              for name in ("alpha", rule)]
    sizes, levels_ = ([(max(one[0][axis] for one in curves)), min(one[1][axis] for one in curves)] for axis in (0, 1))
    gains = [between(curves[1], size) - between(curves[0], size) for size in sizes]
    at = [[number_at(curve, level) or math.nan for curve in curves] for level in levels_]
    return gains, [100 * (smoe / alpha - 1) for alpha, smoe in at]


RULES = {"alpha": "alpha", "learned": "smoe", "program": "the authors' program"}


def timed(threshold: float = 0.0002) -> Dict[Tuple[str, str], Row]:
    """Trainings by 3DGS densification that were alone on a card, by scene and rule."""
    rows = [row for row in rows_of("paper_suites_h200.jsonl") if row["suite"] == "fig5"]
    return {(row["scene"], rule_of(row)): row for row in rows if row["densify_grad_threshold"] == threshold}


def more(name: str, rules: Iterable[str], scenes: Iterable[str] = ("bonsai", "fox"), threshold: float = 0.0002
         ) -> List[float]:
    """By how many per cent more of something these trainings have than alpha's."""
    runs = timed(threshold)
    return [100 * (runs[scene, rule][name] / runs[scene, "alpha"][name] - 1) for rule in rules for scene in scenes]


def time_table() -> str:
    """Seconds of training, FPS, Gaussians and PSNR of single runs."""
    lines = []
    for scene, threshold in (("bonsai", 0.005), ("bonsai", 0.0002), ("fox", 0.0002)):
        rows = [timed(threshold)[scene, rule] for rule in RULES]
        lines.append([f"{scene} {threshold}", *(f"{row['train_seconds']:.1f}, {row['fps']:.0f}, {thousands([row])}, "
                                                f"{row['psnr']:.2f}" for row in rows)])
    return table(["s, FPS, Gaussians, PSNR", *RULES.values()], lines)


def first_table() -> str:
    """The README's: from alpha to smoe."""
    cells, rows = recipe_cells(), trainings()
    budgets = grouped((row for row in rows if row["budget"]), "scene", "budget", "blend_mode")
    chosen = {"bonsai, densification of 3DGS": [cells["bonsai", 0.0002][blend] for blend in BLENDS],
              "fox, 50 photographs by a phone, the same": [cells["fox", 0.0002][blend] for blend in BLENDS],
              "bonsai, as many Gaussians": [budgets["bonsai", 30_000, blend] for blend in BLENDS],
              "lego, an object in empty space": [cells["lego", 0.0002][blend] for blend in BLENDS]}
    runs, lines = timed(), []
    for name, (alpha, smoe) in chosen.items():
        numbers = dict.fromkeys((thousands(alpha), thousands(smoe)))
        seconds = [f"{runs[alpha[0]['scene'], rule]['train_seconds']:.1f}" for rule in ("alpha", "learned")
                   if (alpha[0]["scene"], rule) in runs and not alpha[0]["budget"]]
        lines.append([name, f"{shown(alpha, 'psnr', 2)} to {shown(smoe, 'psnr', 2)} dB", " to ".join(numbers),
                      f"{' to '.join(seconds)} s" if seconds else "–"])
    return table(["alpha to smoe", "PSNR", "Gaussians", "training"], lines)


BOUNDS = (31.0, 31.5)  # dB, of the race


def race_lines() -> List[List[str]]:
    """When trainers reach a PSNR: a line for each, means over its seeds. A time is that of the first evaluation there.

    A PSNR that a seed does not reach has no time.
    """
    lines = []
    for (trainer,), evaluations in grouped(rows_of("race_h100.jsonl"), "trainer").items():
        if "--fast" in trainer:  # it was another preset then
            continue
        runs = list(grouped(evaluations, "seed").values())
        times = [[next((row["train_seconds"] for row in run if row["psnr"] >= bound), math.nan) for run in runs]
                 for bound in BOUNDS]
        ends = [run[-1] for run in runs]
        reached = ["–" if math.isnan(sum(seconds)) else f"{statistics.fmean(seconds):.1f}" for seconds in times]
        lines.append([trainer, *reached, f"{mean(ends, 'train_seconds'):.1f}",
                      f"{ends[0]['iteration']:,}", thousands(ends), f"{mean(ends, 'psnr'):.2f}"])
    return lines


def race_table() -> str:
    return table(["trainer", f"s to {' dB, '.join(map(str, BOUNDS))} dB, in all", "iterations, Gaussians, PSNR"], (
        [name, ", ".join(line[:3]), ", ".join(line[3:])] for name, *line in race_lines()))


def times_as_many(rows: Sequence[Row]) -> Dict[int, List[float]]:
    """By budget of bonsai: how many times as many Gaussians 3DGS has in its row whose PSNR is next, smoe and alpha."""
    cells = grouped((row for row in rows if row["scene"] == "bonsai"), "blend_mode", "budget", "densify_grad_threshold")
    found: Dict[int, List[float]] = {}
    for blend, nearest in (("smoe", (0.005, 0.001, 0.0002)), ("alpha", (0.002, 0.001, 0.0002))):
        for budget, threshold in zip((10_000, 30_000, 100_000), nearest):
            few, many = cells[blend, budget, 0.0002], cells[blend, None, threshold]
            assert (mean(few, "psnr") > mean(many, "psnr")) == (budget > 10_000)
            found.setdefault(budget, []).append(mean(many, "num_gaussians") / mean(few, "num_gaussians"))
    return found


def rules_table() -> str:
    """3DGS densification by Eq. 7 and by smoe without a gate."""
    rows = [row for row in rows_of("tails_h100.jsonl") if row["strategy"] == "3dgs"]
    columns = {"Eq. 7": ("smoe_eq7", 0), "Eq. 7, gate 0.03": ("smoe_eq7", 0.03),
               "smoe, λ = 0, `faint_below` 2": ("smoe", 0)}
    cells = {key: grouped(found, "blend_mode", "background_gate")
             for key, found in in_order(grouped(rows, "scene", "densify_grad_threshold")).items()}
    return table(["", *columns], (
        [f"{scene} {threshold:g}", *(quality(rules[rule]) if rule in rules else "–" for rule in columns.values())]
        for (scene, threshold), rules in cells.items()))


def simplified() -> Dict[Tuple[str, int], Dict[Tuple[str, str], List[Row]]]:
    """Runs of `dsmoe simplify` by scene and budget, then by teacher and blend."""
    rows = [row for row in rows_of("simplify_h200.jsonl") if row.get("run") == 2]
    return {key: grouped(found, "teacher", "blend_mode")
            for key, found in in_order(grouped(rows, "scene", "budget")).items()}


def simplify_table() -> str:
    """A line for each model and number of Gaussians."""
    lines, named = [], set()
    for (scene, budget), kinds in simplified().items():
        alpha, first = kinds["photographs", "alpha"], kinds["photographs", "alpha"][0]
        name = "" if scene in named else ", ".join([
            scene, f"{first['start_gaussians'] / 1000:,.0f}k", f"{first['start_psnr']:.2f} dB",
            f"{first['start_bytes'] / 1e6:.0f} MB"])
        named.add(scene)
        spz = next(row["spz_bytes"] for row in alpha if "spz_bytes" in row)
        lines.append([name, f"{budget:,}", f"{shown(alpha, 'psnr', 2)}, {mean(alpha, 'ssim'):.3f}",
                      f"{mean(own, 'psnr'):.2f}" if (own := kinds.get(("own renderings", "alpha"))) else "–",
                      f"{mean(kinds['photographs', 'smoe'], 'psnr'):.2f}", f"{mean(alpha, 'train_seconds'):.1f}",
                      f"{mean(alpha, 'bytes') / 1e6:.1f}, {spz / 1e6:.1f}"])
    return table(["model by 3DGS densification", "to", "PSNR, SSIM", "own renderings", "`smoe`", "s",
                  "MB as `.ply`, `.spz`"], lines)


def preset_cells() -> Dict[Tuple[str, str], Dict[str, List[Row]]]:
    """Trainings with and without presets that shared a card, by scene and blend, then by options."""
    last = {tuple(row[name] for name in ("options", "scene", "blend_mode", "seed")): row
            for row in rows_of("presets_h200.jsonl") if not row["alone"]}  # a seed that was run twice counts once
    cells = grouped(last.values(), "scene", "blend_mode")
    return {key: {options: rows for (options,), rows in grouped(found, "options").items()}
            for key, found in cells.items()}


def presets_table() -> str:
    """3DGS densification, two lengths of the strategy importance, and --best."""
    columns = {"3DGS densification": "--strategy 3dgs", "30,000 iterations": "none",
               "15,000 iterations": "--iterations 15000", "`--best`": "--best"}
    lines, cells = [], preset_cells()
    for scene, blend in sorted(cells, key=lambda key: (SCENES.index(key[0]), key[1])):
        texts = {options: f"{shown(rows, 'psnr', 2)}, {mean(rows, 'ssim'):.3f}, "
                 f"{statistics.fmean(lpips):.3f}; {thousands(rows)}"
                 for options, rows in cells[scene, blend].items()
                 if (lpips := [row["lpips_alex"] for row in rows if row["lpips_alex"] is not None])}
        lines.append([f"{scene}, {blend}", *(texts.get(options, "–") for options in columns.values())])
    return table(["PSNR, SSIM, LPIPS; Gaussians", *columns], lines)


def fast_runs(blend: str) -> List[Row]:
    """Trainings by --fast, alone on a card, with the seconds to 30.0 and 31.5 dB: of the first evaluation there."""
    return [{**row, **{f"to {bound}": next((seconds for _, seconds, psnr in row["history"] if psnr >= bound), math.nan)
                       for bound in (30.0, 31.5)}} for row in rows_of("presets_h200.jsonl")
            if row["alone"] and row["run"] == 2 and row["options"] == "--fast" and row["blend_mode"] == blend]


def span(values: Iterable[float], digits: int = 0, sign: str = "") -> str:
    """The least and the largest as "1 to 3", or one number if they are printed alike."""
    ordered = sorted(values)
    ends = (f"{round(end, digits) + 0.0:{sign}.{digits}f}" for end in (ordered[0], ordered[-1]))  # 0.0: no -0
    return " to ".join(dict.fromkeys(ends))


def lens_cells() -> Dict[Tuple, List[Row]]:
    """Trainings on bonsai warped to lenses by (blend, lens, how): by a pinhole every how many views, else a word."""
    return grouped(({**row, "how": row.get("pinhole_every", row["how"])} for row in rows_of("lenses_h200.jsonl")
                    if row["kind"] == "training" and (row["how"] == "native" or row["commit"] == "4d96bafd")),
                   "blend_mode", "lens", "how")


def lens_table() -> str:
    """PSNR by pinhole cameras, means over seeds."""
    cells, lenses = lens_cells(), {"fisheye": "fisheye", "phone": "phone", "action": "action camera"}
    columns = {"pinhole": "trained on the photographs", "undistort": "undistorted", "native": "through the lens alone",
               16: "every 16th view by a pinhole", 8: "8th", 4: "4th"}
    return table(["", *columns.values()], ([f"{blend}: {', '.join(lenses.values())}", *(", ".join(
        f"{mean(cells[blend, lens, how], 'psnr_pinhole'):.2f}" if (blend, lens, how) in cells else "–"
        for lens in lenses) for how in columns)] for blend in BLENDS))


def lens_times() -> str:
    """Forward, and forward and backward, as multiples of the pinhole's."""
    cells = grouped(({"model": "a million scattered", **row} for row in rows_of("lenses_h200.jsonl")
                     if row["kind"] == "speed"), "model", "blend", "lens")
    columns = {"opencv": "OPENCV's lens", "fisheye": "fisheye", "rolling pinhole": "rolling shutter, pinhole",
               "rolling fisheye": "and fisheye"}
    return table(["", *columns.values()], ([f"{model.partition(',')[0]}, {blend}", *(", ".join(
        f"{mean(cells[model, blend, lens], name) / mean(cells[model, blend, 'pinhole'], name):.2f}"
        for name in ("forward_ms", "both_ms")) for lens in columns)]
        for model, blend, lens in cells if lens == "pinhole"))


def tables() -> Dict[str, List[str]]:
    """The tables of each page."""
    return {"README.md": [first_table()],
            "benchmarks/RESULTS.md": [budget_table(trainings()), recipe_table(), table_1(), table_2(), time_table(),
                                      transmittance_table(), race_table()],
            "benchmarks/NOTES.md": [rules_table(), lens_table(), lens_times()],
            "docs/trainer.md": [presets_table()], "docs/simplify.md": [simplify_table()]}


def sentences() -> Dict[str, List[str]]:
    """What the pages say in sentences: a page has each of its texts, whatever the breaks of lines."""
    by_budget = {key: grouped(found, "blend_mode") for key, found in
                 grouped((row for row in trainings() if row["budget"]), "scene", "budget").items()}
    gains = [better(found["smoe",], found["alpha",]) for found in by_budget.values()]
    saved = {scene: span(100 * (1 - smoe / alpha) for name, _, alpha, smoe in levels() if name == scene)
             for scene in LEVELS}
    faster = {name: [] for name in ("fastergs", "gsplat unpacked")}  # type: Dict[str, List[float]]
    for model in ("bonsai", "g7", "g40"):
        measured = {row["renderer"]: row for row in read(f"rasterizer_h200_{model}.json")["rows"]}
        for name, ratios in faster.items():
            ratios.append(measured[name]["total_ms"] / measured["ours alpha"]["total_ms"])
    ours = [line[2] for line in race_lines() if "--budget" in line[0]]
    lite = next(line[2] for line in race_lines() if "LiteGS" in line[0])
    many = times_as_many(trainings())
    lego, authors = changes(better, "smoe", LEGO), changes(better, "alpha", LEGO, "gate 0")
    slower = span([row["ratio"] for row in read("rasterizer_h200_smoe_models.json")
                   if (row["rule"], row["version"]) == ("smoe", "main")], 2)
    by_end = ablations()
    ablated = [better(by_end[end, "smoe_eq7"], by_end[end, blend]) for end in (0.005, 0.0002) for blend in ABLATED]
    slower_fps = {rule: span(-part for part in more("fps", [rule])) for rule in ("learned", "program")}
    quicker, longer_few = (f"{span(more(name, ('learned', 'program'), ['bonsai'], 0.005))} % {word}"
                           for name, word in (("fps", "faster"), ("train_seconds", "longer")))
    by_program = changes(fewer, "gate 0", SPARSE)
    text = [key for key, rules in recipe_cells().items() if "Eq. 7" in rules]
    bonsai, fox = ([key for key in text if key[0] == scene and key[1] < most] for scene, most in (
        ("bonsai", 0.005), ("fox", 1)))
    edges = {scene: [less(found["smoe",], found["alpha",], name) for name in ("psnr_edge", "psnr")]
             for (scene, budget), found in by_budget.items() if (scene, budget) in (("fox", 4000), ("room35", 5700))}
    sparse_gains, sparse_saved = plugged(("3dgs-2023", "3dgs-2024", "c3dgs"), "sparse")
    dense_gains, dense_saved_by = plugged(("3dgs-2023", "c3dgs"), "dense")
    bounded = [span(plugged(("taming", "hac", "hac-plus"), end)[0], 1, "+") for end in ("sparse", "dense")]
    gained, primitives, files = ({key: change[name] for key, change in plugged_changes().items()}
                                 for name in ("gained", "fewer", "smaller"))
    saved_by, smaller = ({key: span(values) for key, values in saved.items()} for saved in (primitives, files))
    compact = "compact-3dgs", "sparse"
    compact_gains, compact_more = span(gained[compact], 1), span(-part for part in primitives[compact])
    gained_dense = span(gained["3dgs-2023", "dense"], 2, "+")
    hac = gained["hac", "sparse"] + gained["hac", "dense"]
    hac_gains = span(hac, 2, "+")
    taming, taming_dense = (span(gained["taming", end], 2, "+") for end in ("sparse", "dense"))
    most_plugged = max(gained["taming", "dense"] + hac)
    equal_gains, equal_sizes = ([value for rule in RULES if rule != "alpha" for value in equal_size("hac", rule)[kind]]
                                for kind in (0, 1))
    alpha_2024, smoe_2024 = plugged_2024()
    newest_loss = better(alpha_2024, smoe_2024)
    fast = {blend: fast_runs(blend) for blend in BLENDS}

    def both(name: str, digits: int, what: str = "") -> str:  # by alpha and by smoe
        return " and ".join(f"{mean(fast[blend], name):.{digits}f}" for blend in BLENDS) + what

    large = next(row for row in rows_of("simplify_h200.jsonl") if "peak_reserved_bytes" in row)
    searched = next(row for row in rows_of("simplify_h200.jsonl") if "loses" in row)
    on_fox = preset_cells()["fox", "alpha"]
    seeds = grouped((row for row in rows_of("trainers_gate_h100.jsonl") + rows_of("table2_h200.jsonl")
                     if (row["method"], row["scene"]) == ("3dgs-2023", "fox")), "background_gate")
    in_gsplat = grouped(rows_of("gsplat_h200.jsonl"), "background_gate", "near_plane", "iterations")
    gsplat = [in_gsplat[gate, 0.01, iterations] for iterations in (30_000, 7_000) for gate in (None, "learned")]
    halfway = [in_gsplat[gate, near, 15_000] for gate, near in (
        ("learned", 0.05), ("learned", 0.01), (None, 0.05), (None, 0.01), (0, 0.01))]
    through = [row["psnr_own"] for cell, rows in lens_cells().items() for row in rows
               if "psnr_own" in row and cell[2] != "undistort"]
    lens = {(how, name): mean(rows, f"psnr_{name}") for (blend, kind, how), rows in lens_cells().items()
            if (blend, kind) == ("alpha", "fisheye") and how in ("native", 8) for name in ("own", "pinhole")}
    loss = f"2024 and gsplat's trainer lose {span([newest_loss, better(*gsplat[:2])], 1)} dB on bonsai"
    of_both = [f"Compact-3DGS gains {compact_gains} dB", f"c3dgs {span(gained['c3dgs', 'sparse'], 1)} dB",
               quicker, longer_few, loss, f"{saved['bonsai']} % fewer Gaussians on bonsai and {saved['fox']} % on fox",
               f"{span(gains, 2)} dB", f"{slower_fps['learned']} % slower", f"bonsai loses {span(ablated, 1)} dB",
               f"loses {span(authors, 1)} dB"]
    return {
        "README.md": of_both + [
            f"Sparse Taming changes by {taming} dB, dense Taming by {taming_dense}, HAC by {hac_gains} dB",
            f"the 3DGS of 2023 keeps its quality with {saved_by['3dgs-2023', 'dense']} % fewer Gaussians",
            f"{slower_fps['program']} % slower", f"Lego loses {-lego[-1]:.2f} dB",
            f"in {ours[0]} s by alpha and {ours[1]} s by smoe, where LiteGS takes {lite}",
            f"`--fast` has 31.5 dB after {both('to 31.5', 1)} s",
            f"{span(faster['fastergs'], 1)} times as fast as Faster-GS",
            f"{span(faster['gsplat unpacked'], 1)} times as fast as gsplat"],
        "benchmarks/RESULTS.md": of_both + [
            f"HAC and Taming gain at most {most_plugged:.2f} dB",
            f"{compact_more} % more Gaussians and {smaller[compact]} % smaller files",
            f"changes by {hac_gains} dB", f"{span(equal_gains, 2, '+')} dB at equal size",
            f"changes by {taming} dB where sparse, by {taming_dense} dB where dense",
            f"changes by {gained_dense} dB with", f"{saved_by['c3dgs', 'sparse']} % fewer Gaussians and "
            f"{smaller['c3dgs', 'sparse']} % smaller files",
            f"gsplat's own trainer [loses {better(*gsplat[:2]):.1f} dB](NOTES.md#other-trainers), with "
            f"{fewer(*gsplat[1::-1]):.0f} % fewer Gaussians", f"{saved_by['3dgs-2023', 'dense']} % fewer Gaussians",
            f"{-min(equal_sizes):.0f} % smaller to {max(equal_sizes):.0f} % larger at equal PSNR",
            "at {:g} to {:g} dB on bonsai and {:g} to {:g} dB on fox".format(
                *(end for scene in ("bonsai", "fox") for end in (LEVELS[scene][0], LEVELS[scene][-1]))),
            f"save {span(dense_saved_by)} % of the Gaussians where dense, at {span(dense_gains, 1, '+')} dB",
            f"3DGS of 2024 loses {newest_loss:.1f} dB on dense bonsai, with {fewer(smoe_2024, alpha_2024):.0f} % fewer",
            f"gain {span(sparse_gains, 1)} dB", f"{bounded[0]} dB where sparse, {bounded[1]} dB where dense",
            f"{span(changes(better, 'gate 0', SPARSE), 1, '+')} dB; bonsai {by_program[0]:.0f} % fewer, "
            f"fox {-by_program[1]:.0f} % more, room35 {1 - by_program[2] / 100:.1f} times as many",
            f"**yes:** {span(changes(fewer, 'gate 0', DENSE))} % fewer",
            f"gains {span(changes(better, 'Eq. 7', [('bonsai', 0.005)]), 1)} dB at 0.005",
            f"{span(changes(fewer, 'Eq. 7', bonsai))} % fewer Gaussians than alpha and "
            f"{span(changes(better, 'alpha', bonsai, 'Eq. 7'), 1)} dB less",
            f"On fox it loses {span(changes(better, 'alpha', fox, 'Eq. 7'), 1)} dB",
            "edges gain {:.2f} where pictures gain {:.2f} dB on fox".format(*edges["fox"]),
            "{:.2f} for {:.2f} on room35".format(*edges["room35"]),
            f"On bonsai, fox and room35 smoe has {statistics.fmean(changes(fewer, 'smoe', DENSE)):.0f} % fewer "
            f"Gaussians at 0.0002 and gains {span(changes(better, 'smoe', SPARSE), 1)} dB at 0.005",
            f"Lego changes by {span(lego, 1, '+')} dB", f"lego loses {span(authors, 1)} dB",
            f"{slower} times as long as alpha", f"{span(many[30_000] + many[100_000], 1)} times as many",
            f"{span(many[10_000], 1)} times as many", f"{slower_fps['program']} % slower",
            f"trains {span(more('train_seconds', ['program']))} % longer",
            f"30.0 dB after {both('to 30.0', 1)} s (alpha and smoe), 31.5 dB after {both('to 31.5', 1)} s. It ends "
            f"after {both('train_seconds', 1)} s with {both('psnr', 2)} dB"],
        "benchmarks/NOTES.md": [
            "The loss ({:.1f} dB here) stays without its clamp ({:.1f}), with the opacity rate of 2023 ({:.1f}) and "
            "with both ({:.1f})".format(*changed_2024()),
            f"loses {newest_loss:.1f} dB on dense bonsai",
            f"{span(sparse_gains, 1, '+')} dB with {span(sparse_saved)} % fewer",
            "30,000 iterations was bistable: {}, {} and {} dB (seeds 0 to 2), with 15,000 {}, {} and {}".format(
                *(f"{row['psnr']:.2f}" for options in ("none", "--iterations 15000") for row in on_fox[options])),
            "By smoe 30,000 have {} and {}".format(*(f"{row['psnr']:.2f}" for row in
                                                     preset_cells()["fox", "smoe"]["none"])),
            f"Through its own lens each has {span(through, 1)} dB",
            "Fox has {} dB in six runs, {} with gate 0 in four".format(*(
                shown(seeds[gate,], "psnr", 2) for gate in ("learned", 0))),
            "alpha {} dB with {} Gaussians, smoe (learned) {} with {}; after 7,000 iterations {} and {}".format(*(
                text for rows in gsplat[:2] for text in (shown(rows, "psnr", 2), thousands(rows))), *(
                    shown(rows, "psnr", 2) for rows in gsplat[2:])),
            "smoe has {} dB where it has {} by gsplat's, alpha {} and {}, the authors' program {} by gsplat's".format(*(
                shown(rows, "psnr", 2) for rows in halfway))],
        "docs/method.md": [
            f"had {lens['native', 'own']:.2f} dB through it and [{lens['native', 'pinhole']:.2f} by a pinhole]",
            f"then these are {lens[8, 'own']:.2f} and {lens[8, 'pinhole']:.2f} dB"],
        "docs/simplify.md": [
            f"`--loses {searched['loses']}` ended with {searched['num_gaussians']:,} Gaussians on {searched['scene']}",
            f"{large['start_gaussians'] / 1e6:.2f} million Gaussians to {large['budget']:,} took "
            f"{large['peak_reserved_bytes'] / 1e9:.1f} GB of GPU memory"],
        "docs/paper.md": [
            loss, "edges gain {:.2f} where pictures gain {:.2f} dB on fox, ".format(*edges["fox"])
            + "{:.2f} for {:.2f} on room35".format(*edges["room35"]),
            f"{saved['bonsai']} % on bonsai and {saved['fox']} % on fox",
            f"{-ablated[2]:.1f} and {-ablated[3]:.1f} dB against Eq. 7",
            f"{slower_fps['program']} % slower", quicker, longer_few, f"lose up to {max(authors):.0f} dB"],
    }


def draw(path: str) -> None:
    """bonsai: PSNR against the number of Gaussians, by strategy and blend; a point is a mean over runs."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dsmoe.bench.report.curves import COLORS, STYLE

    marks = {"importance": ("o", COLORS[1]), "steady": ("D", COLORS[2]), "3dgs": ("D", COLORS[0]),
             "steady to N": ("s", COLORS[2]), "mcmc to N": ("^", COLORS[3]), "3dgs to N": ("s", COLORS[0])}
    with plt.rc_context(STYLE):
        drawn, axis = plt.subplots(figsize=(8.2, 4.8))
        series = points_of_bonsai()
        for label, blend in sorted(series, key=lambda one: list(marks).index(one[0])):
            (mark, color), filled = marks[label], blend == "smoe"
            axis.plot(*zip(*series[label, blend]), marker=mark, color=color, linestyle="-" if filled else "--",
                      markerfacecolor=color if filled else "white", label=f"{label}, {blend}")
        axis.set(xscale="log", xlabel="Gaussians", ylabel="test PSNR, dB")
        axis.legend(loc="lower right")
        drawn.tight_layout()
        drawn.savefig(path, dpi=100)
        plt.close(drawn)


def points_of_bonsai() -> Dict[Tuple[str, str], List[Tuple[float, float]]]:
    """(number of Gaussians, PSNR) of each strategy and blend, by number. "to N" is with a budget of N."""
    rows = trainings() + [row for row in rows_of("budget_trials_h200.jsonl") if row["trial"] == "plot"]
    rows += [row for row in rows_of("captures_h200.jsonl") if (row["method"], row["strategy"]) == ("native", "steady")]
    cells: Dict[Tuple, List[Row]] = {}
    for row in rows:
        if row["scene"] == "bonsai" and row["blend_mode"] in BLENDS:
            to_n = " to N" if row["budget"] and row["strategy"] != "importance" else ""
            amount = row["budget"] or row["densify_grad_threshold"]
            cells.setdefault((row["strategy"] + to_n, row["blend_mode"], amount), []).append(row)
    found: Dict[Tuple[str, str], List[Tuple[float, float]]] = {}
    for (label, blend, _), rows in cells.items():
        found.setdefault((label, blend), []).append((mean(rows, "num_gaussians"), mean(rows, "psnr")))
    return {series: sorted(points) for series, points in found.items()}


def main(argv: Optional[Sequence[str]] = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--figure", metavar="PNG", help="draw it here")
    options = parser.parse_args(argv)
    if options.figure and not os.access(Path(options.figure).resolve().parent, os.W_OK):
        parser.error(f"--figure {options.figure}: its folder is not there, or must not be written in")
    if options.figure and Path(options.figure).suffix.lower() != ".png":
        parser.error(f"--figure {options.figure}: name a .png")
    for text in (*(text for texts in tables().values() for text in texts),
                 *(f"{page}: {text}" for page, texts in sentences().items() for text in texts)):
        print(text, end="\n\n")
    if options.figure:
        draw(options.figure)


if __name__ == "__main__":
    main()
