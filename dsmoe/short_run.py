"""Options of a training that takes minutes on a processor, or about a minute on a GPU."""
from __future__ import annotations

import math
from typing import Any, Dict

# A few thousand steps are too few to recover from an opacity reset, so neither kind of scene gets one. The threshold
# is higher than that of full-size images: in NDC units, small images have larger gradients.
ON_CPU = {"iterations": 2000, "schedule": "steady", "densify_grad_threshold": 0.001}
# Larger scenes are reduced to what two processor cores train in minutes.
MAX_PIXELS = 70_000  # of an image
MAX_POINTS = 30_000
# At full size: both modes together take about a minute on an H100 or H200, some minutes on smaller cards.
ON_GPU = {"iterations": 15_000, "schedule": "steady"}


def short_run(device: str, width: int, height: int, points: int) -> Dict[str, Any]:
    """The options for images of that size, and that many points to start from."""
    if device != "cpu":
        return dict(ON_GPU)
    chosen: Dict[str, Any] = dict(ON_CPU)
    if width * height > MAX_PIXELS:
        chosen["resolution"] = int(math.sqrt(MAX_PIXELS * width / height))
    if points > MAX_POINTS:
        chosen["init_points"] = MAX_POINTS
    return chosen
