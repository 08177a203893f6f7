"""Figures of watched runs (record.py), some runs over each other: opacities and resets, pruning, densification.

The look and the files are those of the report's figures.
"""
from __future__ import annotations

from operator import itemgetter
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from ..suite.names import blend_of
from ..suite.report import curves
from ..suite.report.curves import COLORS, MARKS, PANEL, plt
from .probe import QUANTILES

Record = Dict[str, Any]
Value = Callable[[Dict[str, Any]], Optional[float]]  # of a row of a series
SHOWN_AFTER_RESET = 300  # steps
LEAST_SHARE = 1e-6  # of the picture's colour; smaller shares are drawn here, since a logarithm shows no 0


class Run(NamedTuple):
    """A record and how it is drawn."""

    record: Record
    label: str
    color: str
    mark: str
    dash: str


def draw_all(records: Sequence[Record], folder: str) -> List[str]:
    """Draws the three figures of some runs into a folder; returns the paths of the SVG files."""
    paths = []
    for name, draw in (("opacity", opacity), ("pruning", pruning), ("densification", densification)):
        for theme in curves.THEMES:
            with plt.rc_context(curves.style(theme)):
                runs = named(records)
                drawn = draw(runs)
                curves.legend(drawn, [plt.Line2D([], [], color=run.color, linestyle=run.dash, label=run.label)
                                      for run in runs])
                paths.append(curves.save(drawn, folder, f"mechanism-{name}", theme))
    return paths


def opacity(runs: Sequence[Run]):
    """Opacities, the pull on them, PSNR and fullness: over the training, and in the steps after each reset."""
    quantities: Tuple[Tuple[str, Value], ...] = (
        ("opacity: median", lambda state: _quantile(state, "opacities", 0.5)),
        ("net pull on opacities", lambda state: state["net_pull"]),
        ("test PSNR [dB]", lambda state: state["psnr"]),
        ("fullness: sum of a pixel's weights", lambda state: state["fullness"]))
    titles = [[label, label] for label, _ in quantities]
    titles[0][0] += "; 10 and 90 % (thin)"
    drawn, axes = _panels(titles, ("step", "steps after a reset, early ones pale"))
    for run in runs:
        states = run.record["states"]
        for (whole, after), (_, value) in zip(axes, quantities):
            _line(whole, run, states, value)
            for age, near in enumerate(reversed(_after_resets(run.record))):
                _line(after, run, near, value, alpha=0.55 ** age)
        for level in (0.1, 0.9):
            _line(axes[0, 0], run, states, lambda state, level=level: _quantile(state, "opacities", level),
                  alpha=0.5, width=0.7)
        _mark_resets(axes[:, 0], run)
    _logarithmic(axes[0])
    for axis in axes[1]:
        axis.axhline(0, color=plt.rcParams["text.color"], linewidth=0.8)
    return drawn


def pruning(runs: Sequence[Run]):
    """How many Gaussians there are and are pruned, what share of the picture's colour they made, and what it cost."""
    drawn, axes = _panels((("Gaussians", "PSNR gained by a prune [dB]"), ("pruned as faint", "pruned as large"),
                           ("their share of the picture: faint", "their share of the picture: large")))
    for run in runs:
        steps = run.record["densifications"]
        _line(axes[0, 0], run, steps, lambda step: step["after"])
        _line(axes[0, 1], run, steps, lambda step: step["after_prune"]["psnr"] - step["before_prune"]["psnr"])
        for column, name in enumerate(("faint", "large")):
            pruned = [step for step in steps if step[name]]
            _points(axes[1, column], run, pruned, itemgetter(name))
            _points(axes[2, column], run, pruned,
                    lambda step, name=name: max(step["pruned_colors"][name] or 0, LEAST_SHARE))
        _mark_resets(axes.flat, run)
    _logarithmic(axes[1:].flat)
    return drawn


def densification(runs: Sequence[Run]):
    """How many Gaussians are cloned and split, the gradients that decide it, and where and how large the chosen are."""
    drawn, axes = _panels((("cloned and split", "mean gradient: median, 90, 99 %; threshold"),
                           ("near edges: chosen (points), all; area (pale)", "median size: chosen (points), all")))
    for run in runs:
        steps = run.record["densifications"]
        _points(axes[0, 0], run, steps, lambda step: step["cloned"] + step["split"] or None)
        for level, alpha in ((0.5, 0.4), (0.9, 0.7), (0.99, 1.0)):
            _line(axes[0, 1], run, steps, lambda step, level=level: _quantile(step, "gradients", level), alpha=alpha)
        axes[0, 1].axhline(run.record["config"]["densify_grad_threshold"], color=plt.rcParams["text.color"],
                           linewidth=0.8)
        for axis, name in ((axes[1, 0], "edges"), (axes[1, 1], "size")):
            _points(axis, run, steps, lambda step, name=name: step[name]["chosen"])
            _line(axis, run, steps, lambda step, name=name: step[name]["all"])
        _line(axes[1, 0], run, steps, lambda step: step["edges"]["area"], alpha=0.35)
        _mark_resets(axes.flat, run)
    _logarithmic((axes[0, 0], axes[0, 1], axes[1, 1]))
    return drawn


def named(records: Sequence[Record]) -> List[Run]:
    """Runs by name: the options in which they differ, the blend always."""
    options = [name for name in ("scene", "schedule", "densify_grad_threshold", "iterations", "seed")
               if len({record["config"][name] for record in records}) > 1]
    return [Run(record, " ".join([blend_of(record["config"]), *(str(record["config"][name]) for name in options)]),
                COLORS[index % len(COLORS)], *MARKS[record["config"]["blend_mode"]][:2])
            for index, record in enumerate(records)]


def _panels(titles: Sequence[Sequence[str]], below: Sequence[str] = ("step", "step")):
    """Panels under titles; `below` says what the x axis of each column is."""
    drawn, axes = plt.subplots(len(titles), len(below), squeeze=False, sharex="col",
                               figsize=(PANEL[0] * len(below), 0.85 * PANEL[1] * len(titles)))
    for axis, title in zip(axes.flat, [title for line in titles for title in line]):
        axis.set_title(title, loc="left", fontsize=10)
    for axis, label in zip(axes[-1], below):
        axis.set_xlabel(label)
        axis.xaxis.set_major_locator(plt.MaxNLocator(6))
    return drawn, axes


def _after_resets(record: Record) -> List[List[Dict[str, Any]]]:
    """For each reset the states from its own step on, before it, to the next reset; iterations count from it."""
    begins = [reset["iteration"] for reset in record["resets"]]
    return [[dict(state, iteration=state["iteration"] - begin) for state in record["states"]
             if begin <= state["iteration"] <= min(begin + SHOWN_AFTER_RESET, end)]
            for begin, end in zip(begins, [*begins[1:], np.inf])]


def _series(rows: Sequence[Dict[str, Any]], value: Value) -> Tuple[np.ndarray, np.ndarray]:
    """Steps and values of a series; not a number where there is none."""
    return (np.array([row["iteration"] for row in rows], float),
            np.array([value(row) for row in rows], float))


def _line(axis, run: Run, rows: Sequence[Dict[str, Any]], value: Value, alpha: float = 1.0,
          width: float = 1.4) -> None:
    axis.plot(*_series(rows, value), color=run.color, alpha=alpha, linestyle=run.dash, linewidth=width)


def _points(axis, run: Run, rows: Sequence[Dict[str, Any]], value: Value) -> None:
    """For what happens now and then."""
    axis.plot(*_series(rows, value), color=run.color, marker=run.mark, linestyle="", markersize=3)


def _quantile(row: Dict[str, Any], name: str, level: float) -> Optional[float]:
    return row[name][QUANTILES.index(level)] if row[name] else None


def _logarithmic(axes) -> None:
    """Where something is drawn: no logarithm shows an empty panel."""
    for axis in axes:
        if np.isfinite(axis.dataLim.y0) and axis.dataLim.y1 > 0:
            axis.set_yscale("log")


def _mark_resets(axes, run: Run) -> None:
    for axis in axes:
        for reset in run.record["resets"]:
            axis.axvline(reset["iteration"], color=plt.rcParams["grid.color"], linewidth=1.2, zorder=0)
