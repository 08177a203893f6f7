"""Options of a training that takes minutes on a processor, or about a minute on a GPU, and the command to type."""
from __future__ import annotations

import math
import shlex
from typing import Any, Dict

from .system.process import command

# A few thousand steps are too few to recover from an opacity reset, so neither kind of scene gets one. The threshold
# is higher than that of full-size images: in NDC units, small images have larger gradients.
ON_CPU = {"iterations": 2000, "strategy": "steady", "densify_grad_threshold": 0.001}
# Larger scenes are reduced to what two processor cores train in minutes.
MAX_PIXELS = 70_000  # of an image
MAX_POINTS = 30_000
# At full size: both modes together take about a minute on an H100 or H200, some minutes on smaller cards.
ON_GPU = {"iterations": 15_000, "strategy": "steady"}
# What a hint names on a CPU. Without photographs at hand they are taken for usual ones.
FLAGS = "--iterations 3000 --scale-recipe"
USUAL_DIVISOR = 4
MOST_PIXELS = 240_000  # of an image in a hint: 4 for 1,600 pixels of width, 8 for 4,000


def short_flags(width: int = 0, height: int = 0) -> str:
    """The options of `dsmoe train` for minutes on a processor, for images of that size, else for usual ones."""
    divisor = USUAL_DIVISOR
    if width:
        divisor = next((n for n in (1, 2, 4) if width * height <= MOST_PIXELS * n * n), 8)
    return FLAGS if divisor == 1 else f"{FLAGS} --resolution {divisor}"


def train_command(scene: str, model: str, device: str, width: int = 0, height: int = 0) -> str:
    """What to type to train on a scene with images of that size, if it is known: on a CPU with the short options."""
    words = [command(), "train", shlex.quote(scene), "-o", shlex.quote(model)]
    return " ".join([*words, *([short_flags(width, height)] if device == "cpu" else [])])


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
