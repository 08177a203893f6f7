"""Images of bytes as floats."""
from __future__ import annotations

import torch


def as_float(image: torch.Tensor, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """An image of bytes in [0, 1], of this type; floats as they are."""
    return image if image.is_floating_point() else image.to(dtype) / 255
