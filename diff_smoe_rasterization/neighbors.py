"""Distances to the nearest points, from which trainers take the first scales."""
from __future__ import annotations

import torch

from .checks import check_tensors


def distCUDA2(points: torch.Tensor) -> torch.Tensor:
    """Mean squared distance of each point to its three nearest others: the function of the package simple-knn.

    points: [N, 3], float32 or float64, on a GPU or on the CPU. Fewer than four points: the mean over those there are,
    0 for a single one. Coinciding points are at distance 0. Returns: [N] of the same type. Exact but for rounding.
    Raises ValueError if the shape does not fit or a coordinate is not finite, TypeError for another type.
    """
    check_tensors("distCUDA2", points=points)
    from .autograd import refuse_transforms  # loading it registers the op

    refuse_transforms("distCUDA2", [points])
    return torch.ops.diff_smoe_rasterization.mean_squared_neighbour_distances(points.detach())

