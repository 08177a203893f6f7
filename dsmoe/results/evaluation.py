"""Quality and speed of a model over a set of views."""
from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence, Tuple

import torch

from ..errors import TrainerError
from ..scenes.images import View
from ..system.progress import progress_bar
from ..system.stopwatch import synchronised_time
from .metrics import image_metrics, psnr, quantised
from .rendering import Renderer

WARM_UP_VIEWS = 2  # rendered untimed before the first timed one
PASSES = 5  # over all views; a view's time is the median, since other programs easily disturb milliseconds
SECONDS = 2.0  # of rendering, behind which no further pass begins
Measure = Callable[..., Mapping[str, Optional[float]]]
METRICS = ("psnr", "ssim", "psnr_float")  # what image_metrics gives


def psnr_alone(image: torch.Tensor, target: torch.Tensor, mask: Optional[torch.Tensor] = None,
               padding: str = "same") -> Dict[str, Optional[float]]:
    """The headline PSNR of `image_metrics`, without what takes longer."""
    return {"psnr": psnr(quantised(image), target, mask), "ssim": None, "psnr_float": None}


@dataclass(frozen=True)
class Evaluation:
    """Means over views, each view counting once."""

    metrics: Dict[str, Optional[float]]  # psnr, ssim, psnr_float and what else was measured; None if there are none
    fps: Optional[float]  # 1 / mean seconds of a view, images rendered and nothing else
    per_view: List[Dict[str, object]]  # name, metrics and milliseconds of each view


def evaluate(renderer: Renderer, views: Sequence[View], device: str, progress: bool = False,
             measure: Measure = image_metrics, passes: int = PASSES) -> Evaluation:
    """Renders every view; times only the rendering, synchronised, without loading, metrics or disk.

    measure: from a rendering and its ground truth, [3, H, W], its view's mask, [1, H, W] or None, and its camera's
    padding to metrics by name. passes: how often the views are rendered, as long as that takes less than SECONDS in
    all; the time of a view is the median. Raises what `summary` raises.
    """
    return summary(rows_of_views(lambda views: {0: renderer(views[0].camera).color}, [[view] for view in views], device,
                                 progress, measure, passes))


def rows_of_views(render: Callable[[Sequence[View]], Dict[int, torch.Tensor]], batches: Sequence[Sequence[View]],
                  device: str, progress: bool = False, measure: Measure = image_metrics, passes: int = PASSES,
                  agreed: Callable[[float], float] = float) -> List[Dict[str, Any]]:
    """What `summary` takes. `evaluate` says what is timed; a view's time is its share of its batch's.

    render: the images of a batch by their index in it, all or some. agreed: from the seconds that one process
    has rendered to the seconds by which all decide on another pass.
    """
    rows: List[List[Dict[str, Any]]] = []  # of each batch
    seconds: List[List[float]] = []  # of each batch, in each pass

    def timed(views: Sequence[View]) -> Tuple[Dict[int, torch.Tensor], float]:
        started = synchronised_time(device)
        colors = render(views)
        return colors, synchronised_time(device) - started

    with torch.no_grad():
        for views in batches[:WARM_UP_VIEWS]:
            render(views)
        for views in progress_bar(batches, desc="evaluation", unit="view", disable=not progress, leave=False):
            colors, elapsed = timed(views)
            seconds.append([elapsed])
            rows.append([{"name": views[index].camera.name, "milliseconds": None,
                          **measure(color, views[index].image_float(), views[index].mask_float(),
                                    views[index].camera.padding)}
                         for index, color in colors.items()])
        for _ in range(passes - 1):
            if agreed(sum(map(sum, seconds))) >= SECONDS:
                break
            for views, times in zip(batches, seconds):
                times.append(timed(views)[1])
    for views, times, of_batch in zip(batches, seconds, rows):
        for row in of_batch:
            row["milliseconds"] = 1000 * statistics.median(times) / len(views)
    return sum(rows, [])


def summary(per_view: List[Dict[str, Any]]) -> Evaluation:
    """Means of what was measured of each view. A metric that is None for some views is the mean over the others.

    Raises TrainerError for a rendering that has NaN or infinite pixels, which cannot be measured.
    """
    for row in per_view:
        if math.isnan(row["psnr"]):
            raise TrainerError(f"the rendering of {row['name']} has NaN or infinite pixels")
    names = list(METRICS) + [name for name in (per_view[0] if per_view else ())
                             if name not in (*METRICS, "name", "milliseconds")]
    metrics: Dict[str, Optional[float]] = {}
    for name in names:
        values = [float(row[name]) for row in per_view if row[name] is not None]
        metrics[name] = sum(values) / len(values) if values else None
    seconds = sum(row["milliseconds"] for row in per_view) / 1000
    return Evaluation(metrics, len(per_view) / seconds if seconds else None, per_view)
