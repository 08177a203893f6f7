"""The API of Inria's rasterizers of 2024: `antialiasing`, `dc`, and a call that returns color, radii, inverse depth.

Two public branches share these names. The one that brings SparseGaussianAdam puts `dc` before `shs`, and so does this
module; the other has no `dc`, and its callers name `shs`. A trainer that finds SparseGaussianAdam here renders with
`dc` from then on: [N, 1, 3], if shs [N, K - 1, 3] holds only the other coefficients. `fused_ssim` is what the same
trainer imports from the package `fused_ssim`, `compute_relocation` what forks with 3DGS-MCMC's strategy import.
"""
from diff_smoe_rasterization import SparseGaussianAdam, fused_ssim

from ._rasterizer import classes_of
from .mcmc import compute_relocation

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam", "compute_relocation",
           "fused_ssim", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("inria_2024", __name__)
