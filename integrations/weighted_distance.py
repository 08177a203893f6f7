"""What c3dgs imports from its extension `weighted_distance`, in plain torch: the nearest row of a codebook."""
from __future__ import annotations

from typing import Tuple

import torch

__all__ = ["weightedDistance"]

DISTANCES_AT_ONCE = 2 ** 26  # 256 MiB of float32


def weightedDistance(coefs: torch.Tensor, codebook: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor]:
    """Returns each row's squared distance [N] to the nearest row of the codebook, and the number [N] of that, int64.

    Of rows whose distances differ by no more than rounding, either may be taken; the distance is of the one taken.
    Rows of the codebook with an infinity or a NaN, or whose squares overflow, are taken last. Under TF32 or autocast
    the nearest is found with their precision.
    coefs: [N, K]; codebook: [C, K], C > 0, of the same type and on the same device. No gradient.
    Raises ValueError if the shapes do not fit.
    """
    if coefs.dim() != 2 or codebook.dim() != 2 or coefs.shape[1] != codebook.shape[1] or not len(codebook):
        raise ValueError(f"weightedDistance: coefs has shape {list(coefs.shape)}, codebook {list(codebook.shape)}; "
                         "they must be [N, K] and [C, K] with C > 0")
    coefs, codebook = coefs.detach(), codebook.detach()
    # Products lose fewer digits near the origin. A median, since either argument may have rows far from all others:
    # c3dgs divides random rows of a codebook by their trace.
    center = codebook.nanmedian(0).values
    centred = codebook - center
    half_squares = 0.5 * centred.square().sum(1)
    finite = half_squares.isfinite()
    centred = torch.where(finite[:, None], centred, 0)
    half_squares = torch.where(finite, half_squares, torch.inf)
    distances = coefs.new_empty(len(coefs))
    indices = torch.empty(len(coefs), dtype=torch.int64, device=coefs.device)
    rows = max(1, DISTANCES_AT_ONCE // len(codebook))
    for begin in range(0, len(coefs), rows):
        part = slice(begin, begin + rows)
        # |x - c|^2 = |x|^2 + 2 (|c|^2 / 2 - x c), whose first term is the same for all c.
        indices[part] = torch.addmm(half_squares, coefs[part] - center, centred.T, alpha=-1).argmin(1)
        # By differences: by products, small distances would lose their digits.
        distances[part] = (coefs[part] - codebook[indices[part]]).square().sum(1)
    return distances, indices
