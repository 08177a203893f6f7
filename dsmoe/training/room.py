"""How many Gaussians fit into the memory of the GPUs, said before a training starts."""
from __future__ import annotations

import torch

from ..config import TrainConfig
from .graphs import PIXEL_BYTES

# Numbers of memory that a Gaussian takes at the peak: for each of its parameters that one, its gradient, two moments of
# Adam, and what a densification copies. Others are activations, places on the image, statistics and tile lists. By
# benchmarks/RESULTS.md 1.2 to 3.0 million Gaussians of degree 3 add 1,431 B each (bonsai, alpha) and 1,517 B (smoe).
FOR_EACH_PARAMETER, OTHERS = 5, 65
# In a batch also the gradients of one view beside their sum, and for each further view its footprints and gradients by
# places. By benchmarks/results/distributed_*.jsonl 1,635 B with two views a step and 1,855 B with eight were the peak,
# without a densification.
FOR_EACH_PARAMETER_OF_A_BATCH, OF_A_FURTHER_VIEW = 1, 10
PARAMETERS_BESIDE_COLOR = 11  # mean, opacity, scales, rotation


def gaussian_bytes(config: TrainConfig) -> int:
    """About how much memory a Gaussian takes at the peak of a training."""
    parameters = PARAMETERS_BESIDE_COLOR + 3 * (config.sh_degree + 1)**2
    numbers = FOR_EACH_PARAMETER * parameters + OTHERS
    if config.batch > 1:
        numbers += FOR_EACH_PARAMETER_OF_A_BATCH * parameters + OF_A_FURTHER_VIEW * (config.batch - 1)
    return 4 * numbers


def free_bytes(pixels: int) -> int:
    """How much of this process's GPU is left for Gaussians, where images have so many pixels."""
    kept = torch.cuda.memory_reserved() - torch.cuda.memory_allocated()  # by torch, for later
    return max(0, torch.cuda.mem_get_info()[0] + kept - PIXEL_BYTES * pixels)
