"""What to type for a training that takes minutes on a processor, and the image size for it."""
from __future__ import annotations

import math
from typing import Dict

from ..system.process import command, typed

FLAG = "--fast"
# What two processor cores train in minutes.
MAX_PIXELS = 70_000  # of an image
# A hint names a divisor. Without photographs at hand they are taken for usual ones.
USUAL_DIVISOR = 4
MOST_PIXELS = 240_000  # of an image in a hint: 4 for 1,600 pixels of width, 8 for 4,000


def short_flags(width: int = 0, height: int = 0) -> str:
    """The options of `dsmoe train` for minutes on a processor, for images of that size, else for usual ones."""
    divisor = USUAL_DIVISOR
    if width:
        divisor = next((n for n in (1, 2, 4) if width * height <= MOST_PIXELS * n * n), 8)
    return FLAG if divisor == 1 else f"{FLAG} --resolution {divisor}"


def train_command(scene: str, model: str, device: str, width: int = 0, height: int = 0) -> str:
    """What to type to train on a scene with images of that size, if it is known: on a CPU with the short options."""
    words = [command(), "train", typed(scene), "-o", typed(model)]
    return " ".join([*words, *([short_flags(width, height)] if device == "cpu" else [])])


def smaller_images(width: int, height: int) -> Dict[str, int]:
    """The option that reduces images of that size to what a processor trains in minutes; none if they are as small."""
    too_large = width * height > MAX_PIXELS
    return {"resolution": int(math.sqrt(MAX_PIXELS * width / height))} if too_large else {}
