"""Prints the tables of README.md and RESULTS.md that come from rows in results/, and draws docs/budget-bonsai.png.

    python benchmarks/tables.py                                # the tables, for the pages
    python benchmarks/tables.py --figure docs/budget-bonsai.png
"""
from __future__ import annotations

import argparse
import json
import math
import statistics
from pathlib import Path
from typing import Any, Dict, Iterable, List, Sequence, Tuple

Row = Dict[str, Any]
RESULTS = Path(__file__).resolve().parent / "results"
BLENDS = ("alpha", "smoe")
SCENES = ("bonsai", "fox", "office_table", "room35", "lego")


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


def merged(shared: Row, row: Row) -> Row:
    return {**shared, **{name: merged(shared[name], value) if isinstance(value, dict) and isinstance(
        shared.get(name), dict) else value for name, value in row.items()}}


def trainings() -> List[Row]:
    """alpha, and smoe with a learned gate by the rule of covered pixels: by the recipe, and with a budget.

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


def mean(rows: Sequence[Row], name: str) -> float:
    return statistics.fmean(row[name] for row in rows)


def shown(rows: Sequence[Row], name: str, digits: int) -> str:
    spread = f" ± {statistics.stdev(row[name] for row in rows):.{digits}f}" if len(rows) > 1 else ""
    return f"{mean(rows, name):.{digits}f}{spread}"


def thousands(rows: Sequence[Row]) -> str:
    number = mean(rows, "num_gaussians") / 1000
    return f"{number:,.{0 if number > 99.95 else 1}f}k"


def figures(rows: Sequence[Row]) -> List[str]:
    """PSNR, SSIM and LPIPS by AlexNet, if it was measured."""
    lpips = [(row.get("lpips") or {}).get("value") for row in rows]
    return [shown(rows, "psnr", 2), f"{mean(rows, 'ssim'):.3f}",
            "–" if None in lpips else f"{statistics.fmean(lpips):.3f}"]


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *lines)).replace(
        " --- ", "---")


def budget_table(rows: Sequence[Row]) -> str:
    """A line for each scene and number of Gaussians; differences are of runs with the same seed."""
    lines = []
    for (scene, budget), cells in grouped((row for row in rows if row["budget"]), "scene", "budget").items():
        alpha, smoe = (grouped(cells, "blend_mode")[blend,] for blend in BLENDS)
        of_seed = {row["seed"]: row["psnr"] for row in alpha}
        smoe.sort(key=lambda row: row["seed"])
        differences = [f"{row['psnr'] - of_seed[row['seed']]:+.2f}" for row in smoe]
        lines.append((SCENES.index(scene), budget, [f"{scene}, {budget:,}", *figures(alpha), *figures(smoe),
                                                    ", ".join(differences)]))
    return table(["scene, Gaussians", "alpha: PSNR", "SSIM", "LPIPS", "smoe: PSNR", "SSIM", "LPIPS",
                  "difference of PSNR by seed"], (line for *_, line in sorted(lines)))


def readme_table(rows: Sequence[Row]) -> str:
    """A line for each scene and number of Gaussians, and for each scene by the recipe at 3DGS's threshold.

    A PSNR is bold if it is higher by more than the sum of both deviations.
    """
    lines = []
    chosen = (row for row in rows if row["budget"] or row["densify_grad_threshold"] == 0.0002)
    for (scene, budget), cells in grouped(chosen, "scene", "budget").items():
        blends = [grouped(cells, "blend_mode")[blend,] for blend in BLENDS]
        spread = sum(statistics.stdev(row["psnr"] for row in found) if len(found) > 1 else math.inf for found in blends)
        line = [f"{scene}, {f'N = {budget:,}' if budget else 'recipe'}"]
        for found, other in zip(blends, blends[::-1]):
            psnr, *others = figures(found)
            ahead = mean(found, "psnr") - mean(other, "psnr") > spread
            line += [psnr.replace(psnr[:5], f"**{psnr[:5]}**") if ahead else psnr, *others, thousands(found)]
        lines.append((not budget, SCENES.index(scene), budget or 0, line))
    return table(["", *(f"{blend}: PSNR" if name == "PSNR" else name for blend in BLENDS
                        for name in ("PSNR", "SSIM", "LPIPS", "Gaussians"))], (line for *_, line in sorted(lines)))


def recipe_table(rows: Sequence[Row]) -> str:
    """A line for each scene and threshold."""
    lines = []
    recipe = (row for row in rows if row["strategy"] == "3dgs")
    for (scene, threshold), cells in grouped(recipe, "scene", "densify_grad_threshold").items():
        line = [f"{scene} {threshold:g}"]
        for blend in BLENDS:
            found = grouped(cells, "blend_mode")[blend,]
            line += [*figures(found)[:2], thousands(found), f"{mean(found, 'peak_gpu_mib'):,.0f}"]
        lines.append((SCENES.index(scene), -threshold, line))
    return table(["", *(f"{blend}: PSNR" if name == "PSNR" else name for blend in BLENDS
                        for name in ("PSNR", "SSIM", "Gaussians", "MiB"))], (line for *_, line in sorted(lines)))


def race_table() -> str:
    """When trainers reach a PSNR: a line for each, means over its seeds. A time is that of the first evaluation there.

    A PSNR that a seed does not reach has no time.
    """
    bounds, lines = (30.0, 31.0, 31.5), []
    for (trainer,), evaluations in grouped(rows_of("race_h100.jsonl"), "trainer").items():
        runs = list(grouped(evaluations, "seed").values())
        times = [[next((row["train_seconds"] for row in run if row["psnr"] >= bound), math.nan) for run in runs]
                 for bound in bounds]
        ends = [run[-1] for run in runs]
        reached = ["–" if math.isnan(sum(seconds)) else f"{statistics.fmean(seconds):.1f}" for seconds in times]
        lines.append([trainer, str(len(runs)), *reached, f"{mean(ends, 'train_seconds'):.1f}",
                      f"{ends[0]['iteration']:,}", thousands(ends), f"{mean(ends, 'psnr'):.2f}"])
    return table(["trainer", "seeds", *(f"s to {bound} dB" for bound in bounds), "s in all", "iterations", "Gaussians",
                  "PSNR"], lines)


def numbers_table(rows: Sequence[Row]) -> str:
    """bonsai with a budget, beside the row of the recipe whose PSNR is next to it."""
    cells = grouped((row for row in rows if row["scene"] == "bonsai"), "blend_mode", "budget", "densify_grad_threshold")
    lines = []
    for blend, nearest in (("smoe", (0.005, 0.001, 0.0002)), ("alpha", (0.002, 0.001, 0.0002))):
        for budget, threshold in zip((10_000, 30_000, 100_000), nearest):
            pair = cells[blend, budget, 0.0002], cells[blend, None, threshold]
            few, many = (mean(cell, "num_gaussians") for cell in pair)
            shown_few, shown_many = ([f"{mean(cell, 'num_gaussians') / 1000:,.0f}k", f"{mean(cell, 'psnr'):.2f}"]
                                     for cell in pair)
            lines.append([blend, *shown_few, *shown_many, f"{many / few:.1f}"])
    return table(["bonsai", "by budget: Gaussians", "PSNR", "by the recipe: Gaussians", "PSNR", "times as many"], lines)


def rules_table() -> str:
    """The recipe by Eq. 7 and by smoe without a gate."""
    rows = [row for row in rows_of("tails_h100.jsonl") if row["strategy"] == "3dgs"]
    columns = {"Eq. 7": ("smoe_eq7", 0), "Eq. 7, gate 0.03": ("smoe_eq7", 0.03), "smoe, λ = 0, all pairs": ("smoe", 0)}
    lines = []
    for (scene, threshold), cells in grouped(rows, "scene", "densify_grad_threshold").items():
        by_rule = grouped(cells, "blend_mode", "background_gate")
        line = [f"{shown(by_rule[rule], 'psnr', 2)}, {thousands(by_rule[rule])}" if rule in by_rule else "–"
                for rule in columns.values()]
        lines.append((SCENES.index(scene), -threshold, [f"{scene} {threshold:g}", *line]))
    return table(["", *columns], (line for *_, line in sorted(lines)))


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--figure", metavar="PNG", help="draw it here")
    options = parser.parse_args()
    rows = trainings()
    for text in (readme_table(rows), budget_table(rows), numbers_table(rows), recipe_table(rows), rules_table(),
                 race_table()):
        print(text, end="\n\n")
    if options.figure:
        draw(options.figure)


if __name__ == "__main__":
    main()
