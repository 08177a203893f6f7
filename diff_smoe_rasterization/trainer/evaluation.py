"""Quality and speed of a model over a set of views."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, List, Optional, Sequence

import torch
from tqdm import tqdm

from .images import View
from .metrics import image_metrics
from .rendering import Renderer
from .stopwatch import synchronised_time

WARM_UP_VIEWS = 2  # rendered untimed before the first timed one


@dataclass(frozen=True)
class Evaluation:
    """Means over views, each view counting once."""

    metrics: Dict[str, Optional[float]]  # psnr, ssim, psnr_float; None where there are no views
    fps: Optional[float]  # 1 / mean seconds per view, images rendered and nothing else
    per_view: List[Dict[str, object]]  # name, metrics and milliseconds of each view


def evaluate(renderer: Renderer, views: Sequence[View], device: str, progress: bool = False) -> Evaluation:
    """Renders every view; times rendering alone, synchronised, without loading, metrics or disk."""
    per_view: List[Dict[str, object]] = []
    seconds = 0.0
    with torch.no_grad():
        for view in views[:WARM_UP_VIEWS]:
            renderer(view.camera)
        for view in tqdm(views, desc="evaluation", unit="view", disable=not progress, leave=False):
            started = synchronised_time(device)
            color = renderer(view.camera).color
            elapsed = synchronised_time(device) - started
            seconds += elapsed
            row: Dict[str, object] = {"name": view.camera.name, "milliseconds": elapsed * 1000}
            row.update(image_metrics(color, view.image_float()))
            per_view.append(row)
    metrics: Dict[str, Optional[float]] = {}
    for name in ("psnr", "ssim", "psnr_float"):
        values = [float(row[name]) for row in per_view]  # type: ignore[arg-type]
        metrics[name] = sum(values) / len(values) if values else None
    return Evaluation(metrics, len(views) / seconds if views else None, per_view)
