"""Figures of watched runs (mechanism.py), some runs over each other: opacities and resets, pruning, densification.

The look and the files are those of the report's figures.
"""
from __future__ import annotations

from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from .mechanism_probe import QUANTILES
from .report import curves
from .report.curves import COLORS, MARKS, OTHER_MARK, PANEL, plt

Record = Dict[str, Any]
Value = Callable[[Dict[str, Any]], Optional[float]]  # of a row of a series
SHOWN_AFTER_RESET = 300  # steps
LEAST_SHARE = 1e-6  # of the picture's colour; smaller shares are drawn here, since a logarithm shows no 0


class Run(NamedTuple):
    """A record and how it is drawn."""

    record: Record
    label: str
    color: str
    dash: str


def draw_all(records: Sequence[Record], folder: str) -> List[str]:
    """Draws the three figures of some runs into a folder; returns the paths of the SVG files."""
    paths = []
    for name, draw in (("opacity", opacity), ("pruning", pruning), ("densification", densification)):
        for theme in curves.THEMES:
            with plt.rc_context(curves.style(theme)):
                runs = _runs(records)
                drawn = draw(runs)
                curves.legend(drawn, [plt.Line2D([], [], color=run.color, linestyle=run.dash, label=run.label)
                                      for run in runs])
                paths.append(curves.save(drawn, folder, f"mechanism-{name}", theme))
    return paths


def opacity(runs: Sequence[Run]):
    """Opacities, the pull on them, PSNR and fullness: over the training, and in the steps after a reset."""
    quantities: Tuple[Tuple[str, Value], ...] = (
        ("opacity: median, and 10 to 90 %", lambda state: _quantile(state, "opacities", 0.5)),
        ("net pull on opacities", lambda state: state["opacity_gradient"]["net_pull"]),
        ("test PSNR [dB]", lambda state: state["psnr"]), ("fullness of pixels", lambda state: state["fullness"]))
    drawn, axes = _panels(len(quantities), 2)
    for run in runs:
        states = run.record["states"]
        regular = [state for state in states if state["iteration"] % 100 == 0]
        for (whole, after), (label, value) in zip(axes, quantities):
            _line(whole, run, regular, value)
            for age, reset in enumerate(reversed(run.record["resets"])):
                near = [dict(state, iteration=state["iteration"] - reset["iteration"]) for state in states
                        if 0 < state["iteration"] - reset["iteration"] <= SHOWN_AFTER_RESET]
                _line(after, run, near, value, alpha=0.5 ** age)  # later resets stand out
            whole.set_ylabel(label)
        low, high = (_series(regular, lambda state, q=q: _quantile(state, "opacities", q)) for q in (0.1, 0.9))
        axes[0][0].fill_between(low[0], low[1], high[1], color=run.color, alpha=0.15, linewidth=0)
        _mark_resets(axes[:, 0], run)
    for axis in axes[0]:
        axis.set_yscale("log")
    for axis in axes[1]:
        axis.axhline(0, color=plt.rcParams["text.color"], linewidth=0.8)
    axes[0][0].set_title("the whole training", fontsize=10)
    axes[0][1].set_title("after each reset, the last in full colour", fontsize=10)
    axes[-1][0].set_xlabel("step")
    axes[-1][1].set_xlabel("steps after a reset")
    return drawn


def pruning(runs: Sequence[Run]):
    """How many Gaussians there are and are pruned, what share of the picture's colour they made, and what it cost."""
    drawn, axes = _panels(3, 2)
    for run in runs:
        steps = run.record["densifications"]
        _line(axes[0, 0], run, steps, lambda step: step["after"])
        _line(axes[0, 1], run, steps, lambda step: step["after_prune"]["psnr"] - step["before_prune"]["psnr"])
        for column, name in enumerate(("faint", "large")):
            _line(axes[1, column], run, steps, lambda step: step[name] or None, points=True)
            _line(axes[2, column], run, [step for step in steps if step[name]],
                  lambda step: max(step["pruned_colors"][name] or 0, LEAST_SHARE), points=True)
        _mark_resets(axes.flat, run)
    for axis in axes[1:].flat:
        axis.set_yscale("log")
    labels = (("Gaussians", "PSNR gained by the prune [dB]"), ("pruned as faint", "pruned as large"),
              ("share of colour: faint", "share of colour: large"))
    return _finish(drawn, axes, labels)


def densification(runs: Sequence[Run]):
    """How many Gaussians are cloned and split, the gradients that decide it, and where and how large the chosen are."""
    drawn, axes = _panels(2, 2)
    for run in runs:
        steps = run.record["densifications"]
        _line(axes[0, 0], run, steps, lambda step: step["cloned"] + step["split"] or None)
        for level, alpha in ((0.5, 0.4), (0.9, 0.7), (0.99, 1.0)):
            _line(axes[0, 1], run, steps, lambda step: _quantile(step, "gradients", level), alpha=alpha)
        axes[0, 1].axhline(run.record["config"]["densify_grad_threshold"], color=plt.rcParams["text.color"],
                           linewidth=0.8)
        for axis, name in ((axes[1, 0], "edges"), (axes[1, 1], "size")):
            _line(axis, run, steps, lambda step: step[name]["chosen"])
            _line(axis, run, steps, lambda step: step[name]["all"], alpha=0.4)
        _line(axes[1, 0], run, steps, lambda step: step["edges"]["area"], alpha=0.2)
        _mark_resets(axes.flat, run)
    for axis in (axes[0, 0], axes[0, 1], axes[1, 1]):
        axis.set_yscale("log")
    labels = (("cloned and split", "gradient: median, 90, 99 %; threshold"),
              ("near edges: chosen, all, area", "median size: chosen, all"))
    return _finish(drawn, axes, labels)


def _runs(records: Sequence[Record]) -> List[Run]:
    """Runs by name: the options in which they differ, the blend mode always."""
    options = [name for name in ("scene", "schedule", "densify_grad_threshold", "iterations", "seed")
               if len({record["config"][name] for record in records}) > 1]
    return [Run(record, " ".join(str(record["config"][name]) for name in ["blend_mode", *options]),
                COLORS[index % len(COLORS)], MARKS.get(record["config"]["blend_mode"], OTHER_MARK)[1])
            for index, record in enumerate(records)]


def _panels(rows: int, columns: int):
    return plt.subplots(rows, columns, squeeze=False, sharex="col",
                        figsize=(1.2 * PANEL[0] * columns, 0.85 * PANEL[1] * rows))


def _finish(drawn, axes, labels: Sequence[Sequence[str]]):
    for axis, label in zip(axes.flat, [label for line in labels for label in line]):
        axis.set_ylabel(label)
    for axis in axes[-1]:
        axis.set_xlabel("step")
    return drawn


def _series(rows: Sequence[Dict[str, Any]], value: Value) -> Tuple[np.ndarray, np.ndarray]:
    """Steps and values of a series; not a number where there is none."""
    return (np.array([row["iteration"] for row in rows], float),
            np.array([value(row) for row in rows], float))


def _line(axis, run: Run, rows: Sequence[Dict[str, Any]], value: Value, alpha: float = 1.0,
          points: bool = False) -> None:
    """points: marks instead of a line, for what happens now and then."""
    looks = {"linestyle": "", "marker": ".", "markersize": 4} if points else {"linestyle": run.dash, "linewidth": 1.4}
    axis.plot(*_series(rows, value), color=run.color, alpha=alpha, **looks)


def _quantile(row: Dict[str, Any], name: str, level: float) -> Optional[float]:
    return row[name][QUANTILES.index(level)] if row[name] else None


def _mark_resets(axes, run: Run) -> None:
    for axis in axes:
        for reset in run.record["resets"]:
            axis.axvline(reset["iteration"], color=plt.rcParams["grid.color"], linewidth=1.2, zorder=0)
