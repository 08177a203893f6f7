"""Images of bytes as floats."""
from __future__ import annotations

import torch


def as_float(image: torch.Tensor) -> torch.Tensor:
    """An image of bytes as float32 in [0, 1]; floats as they are."""
    return image if image.is_floating_point() else image.float() / 255
