"""How many Gaussians fit into the memory of the GPUs, said before a training starts."""
from __future__ import annotations

import torch

from ..options.config import TrainConfig
from .graphs import PIXEL_BYTES

# How many numbers of memory a Gaussian takes at the peak. A parameter takes five: itself, its gradient, Adam's two
# moments, and what a densification copies. The others are activations, places on the image, statistics and tile lists.
# From 1.2 to 3.0 million Gaussians of degree 3 each adds 1,431 B (bonsai, alpha) and 1,516 B (smoe), by
# benchmarks/results/tails_h100.jsonl and near_*.jsonl.
FOR_EACH_PARAMETER, OTHERS = 5, 65
# Each further view of a batch adds rows, and gradients by these and by places: 64 B if half of the Gaussians are seen.
OF_A_FURTHER_VIEW = 16
PARAMETERS_BESIDE_COLOR = 11  # mean, opacity, scales, rotation


def gaussian_bytes(config: TrainConfig) -> int:
    """About how much memory a Gaussian takes at the peak of a training."""
    parameters = PARAMETERS_BESIDE_COLOR + 3 * (config.sh_degree + 1)**2
    return 4 * (FOR_EACH_PARAMETER * parameters + OTHERS + OF_A_FURTHER_VIEW * (config.batch - 1))


def free_bytes(pixels: int, kept: int = 0) -> int:
    """How much of this process's GPU is left for Gaussians, where images have so many pixels.

    kept: bytes of what a training will make and keep beside them.
    """
    cached = torch.cuda.memory_reserved() - torch.cuda.memory_allocated()  # by torch, for later
    return max(0, torch.cuda.mem_get_info()[0] + cached - PIXEL_BYTES * pixels - kept)
