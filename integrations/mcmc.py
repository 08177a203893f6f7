"""The API of 3DGS-MCMC's rasterizer: a third result, `is_used`, and `compute_relocation`, which its trainer imports."""
from __future__ import annotations

from typing import Tuple

import torch

from diff_smoe_rasterization.gaussians import divided

from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "compute_relocation", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("mcmc", __name__)


def compute_relocation(opacity_old: torch.Tensor, scale_old: torch.Tensor, N: torch.Tensor, binoms: torch.Tensor,
                       n_max: int) -> Tuple[torch.Tensor, torch.Tensor]:
    """Returns opacities [M] and scales [M, 3] of Gaussians that N [M] equal ones in one place take over (Eq. 9).

    opacity_old: [M]. scale_old: [M, 3]. N is taken as n_max if it is more; binoms are not read.
    """
    opacities, factors = divided(opacity_old.reshape(-1), N.reshape(-1).clamp(max=n_max))
    return opacities.reshape(opacity_old.shape), factors[:, None] * scale_old
