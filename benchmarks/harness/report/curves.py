"""Figures: quality, and times, against the number of Gaussians and more, as SVG and PNG."""
from __future__ import annotations

import itertools
import math
import os
from typing import Dict, List, NamedTuple, Sequence

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402

from .groups import LPIPS, Group, Setting, lpips_figures, safe_name  # noqa: E402
from .tables import column  # noqa: E402

# Okabe and Ito's colours, told apart with every kind of colour vision; black and yellow are left out for the pages.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
# Blends differ by more than colour: mark and line.
MARKS = {"alpha": ("o", "--"), "smoe": ("s", "-"), "smoe_eq7": ("P", "-"), "smoe_tn": ("^", "-."),
         "smoe_std": ("v", ":")}
OTHER_MARKS = (("D", "-"), ("p", "-"), ("X", "-"))  # gates of smoe, as they come
INK, GRID = "#1c1c1e", "#d8d8dc"
STYLE = {"text.color": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK, "axes.edgecolor": GRID,
         "grid.color": GRID, "axes.grid": True, "axes.axisbelow": True, "axes.spines.top": False,
         "axes.spines.right": False, "legend.frameon": False, "font.size": 10, "svg.hashsalt": "dsmoe"}
AMOUNTS = ("num_gaussians", "size_own_mb", "size_common_mb")
SPEEDS = ("train_seconds", "fps")
NARROW = 1.5  # the ratio of the largest x value to the smallest, up to which the axis is plain
MARK, LARGEST_MARK = 6, 12  # points
PANEL = (4.2, 2.9)  # inches, as the next two
LEGEND_MARK, LEGEND_LETTER = 0.85, 0.082  # what a mark, and a letter of its label, take at most


class Picture(NamedTuple):
    name: str  # of its files
    title: str
    alt: str  # what it shows, in words
    path: str  # of the SVG, which has a PNG beside it


def draw_all(suite: str, groups: Sequence[Group], folder: str) -> List[Picture]:
    pictures = []
    for scene in sorted({group.scene for group in groups}):
        shown = [group for group in groups if group.scene == scene and group.rows]
        modes = "; ".join(dict.fromkeys(group.setting.label() for group in shown))
        for ending, draw, about in (("rd", rate_distortion, "quality against number of Gaussians and size"),
                                    ("speed", speed, "training time and FPS against number of Gaussians and PSNR")):
            name, title = safe_name(f"{suite}-{scene}-{ending}"), f"{scene}: {about}"
            path = os.path.join(folder, f"{name}.svg")
            with plt.rc_context(STYLE):
                drawn = draw(shown)
                if drawn is not None:
                    os.makedirs(folder, exist_ok=True)
                    drawn.savefig(path, metadata={"Date": None})
                    drawn.savefig(os.path.join(folder, f"{name}.png"), dpi=130)
                    plt.close(drawn)
                    pictures.append(Picture(name, title, f"{title} of {modes}; the figures are in the tables", path))
    return pictures


def rate_distortion(groups: Sequence[Group]):
    """Quality figures over amounts; a point is a mean over seeds. None if there is nothing to draw."""
    return _panels(groups, ("psnr", "ssim", *lpips_figures(groups)), AMOUNTS)


def speed(groups: Sequence[Group]):
    """Training time and FPS, of cells that shared no machine, over the number of Gaussians and over PSNR.

    Only of methods that were run with several numbers of Gaussians.
    """
    curves = [group for group in groups if len({other.setting.amount() for other in groups
                                                if other.setting.series == group.setting.series}) > 2]
    return _panels(curves, SPEEDS, ("num_gaussians", "psnr"))


def _panels(groups: Sequence[Group], ordinates: Sequence[str], abscissae: Sequence[str]):
    """One panel for each figure (rows) over each other one (columns), of those that were measured."""
    qualities = [name for name in ordinates if any(_drawn(group, name) for group in groups)]
    amounts = [name for name in abscissae if any(_drawn(group, name) for group in groups)]
    if not qualities or not amounts:
        return None
    drawn, axes = plt.subplots(len(qualities), len(amounts), squeeze=False, sharey="row", sharex="col",
                               figsize=(PANEL[0] * len(amounts), PANEL[1] * len(qualities) + 0.8))
    looks = _looks(groups)
    for line, quality in zip(axes, qualities):
        for axis, amount in zip(line, amounts):
            for series, look in looks.items():
                points = sorted(((group.measured(amount).value, *group.measured(quality)[:2]) for group in groups
                                 if group.setting.series == series and _drawn(group, quality)
                                 and _drawn(group, amount)), key=lambda point: point[0])
                if points:
                    xs, ys, spreads = zip(*points)
                    axis.errorbar(xs, ys, yerr=[math.nan if spread is None else spread for spread in spreads],
                                  linewidth=1.6, capsize=3, **look)
        line[0].set_ylabel(column(quality).name + (" (lower is better)" if quality.startswith(LPIPS) else ""))
    for axis, amount in zip(axes[-1], amounts):
        axis.set_xlabel(column(amount).name)
        if amount in AMOUNTS:
            _amounts(axis, [group.measured(amount).value for group in groups if _drawn(group, amount)])
    legend(drawn, [Line2D([], [], label=series.label(), **look) for series, look in looks.items()])
    return drawn


def _amounts(axis, values: Sequence[float]) -> None:
    """The x axis: logarithmic, but for values so close that a logarithm has no ticks between them."""
    if max(values) > NARROW * min(values):
        axis.set_xscale("log")
        return
    axis.set_xlim(min(values) / NARROW, max(values) * NARROW)
    axis.xaxis.set_major_locator(plt.MaxNLocator(4))
    axis.ticklabel_format(axis="x", style="plain", useOffset=False)


def _looks(groups: Sequence[Group]) -> Dict[Setting, Dict[str, object]]:
    """How each series is drawn: lines through three points and more, since two are not a curve.

    Marks in one place are all seen: those of each next method and strategy are smaller and in front, and those of
    alpha, in front of the other blends', are hollow.
    """
    looks: Dict[Setting, Dict[str, object]] = {}
    found = sorted({group.setting.series for group in groups}, key=Setting.order)
    kinds = list(dict.fromkeys(series.pair for series in found))
    blends = list(dict.fromkeys(["alpha", "smoe", *sorted(series.blend for series in found)]))
    marks = {**dict(zip((blend for blend in blends if blend not in MARKS), itertools.cycle(OTHER_MARKS))), **MARKS}
    smaller = min(2, (LARGEST_MARK - MARK) / max(1, len(kinds) - 1))
    for series in found:
        mark, dash = marks[series.blend]
        points = sum(group.setting.series == series for group in groups)
        hollow, place = series.blend == "alpha", kinds.index(series.pair)
        # The blends of one method take neighbouring colours.
        color = COLORS[(place * len(blends) + blends.index(series.blend)) % len(COLORS)]
        looks[series] = {"color": color, "marker": mark, "markersize": MARK + smaller * (len(kinds) - 1 - place),
                         "markerfacecolor": "none" if hollow else color, "markeredgewidth": 1.5,
                         "linestyle": dash if points > 2 else "", "zorder": 3 + place + 0.5 * hollow}
    return looks


def _drawn(group: Group, name: str) -> bool:
    mean = group.measured(name).value
    return mean is not None and math.isfinite(mean) and (mean > 0 or name not in AMOUNTS)


def legend(drawn: Figure, handles: Sequence[object]) -> None:
    """Above the panels, in a strip that makes the figure higher."""
    widest = LEGEND_MARK + LEGEND_LETTER * max(len(handle.get_label()) for handle in handles)
    columns = max(1, min(len(handles), int(drawn.get_figwidth() // widest)))
    lines = -(-len(handles) // columns)
    height = 0.12 + 0.24 * lines
    drawn.set_figheight(drawn.get_figheight() + height)
    drawn.tight_layout(rect=(0, 0, 1, 1 - height / drawn.get_figheight()))
    drawn.legend(handles=handles, loc="upper center", ncols=columns, handlelength=3)
