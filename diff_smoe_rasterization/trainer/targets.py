"""Ground truth as the loss takes it, kept between steps as far as memory allows."""
from __future__ import annotations

from typing import Dict, Sequence

from .images import View
from .losses import TargetMoments, target_moments

MAX_BYTES = 2 * 1024**3  # beyond it, moments are computed anew in each step
BYTES_PER_PIXEL = 3 * 3 * 4  # image, mean and variance, three float32 channels each


class Targets:
    """SSIM moments of training views by index; the result does not depend on what is kept."""

    def __init__(self, views: Sequence[View], max_bytes: int = MAX_BYTES) -> None:
        self.views = views
        self.bytes_left = max_bytes
        self.kept: Dict[int, TargetMoments] = {}

    def __getitem__(self, index: int) -> TargetMoments:
        if index in self.kept:
            return self.kept[index]
        image = self.views[index].image_float()
        moments = target_moments(image)
        size = image[0].numel() * BYTES_PER_PIXEL
        if size <= self.bytes_left:
            self.bytes_left -= size
            self.kept[index] = moments
        return moments
