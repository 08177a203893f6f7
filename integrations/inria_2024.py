"""The API of Inria's rasterizers of 2024: `antialiasing`, `dc`, and a call that returns color, radii, inverse depth.

Two public branches share these names. The one that brings SparseGaussianAdam puts `dc` before `shs`, and so does this
module; the other has no `dc`, and its callers name `shs`. A trainer that finds SparseGaussianAdam here renders with
`dc` from then on. `fused_ssim` is what the same trainer imports from the package `fused_ssim`.
"""
from __future__ import annotations

import diff_smoe_rasterization
from diff_smoe_rasterization import GaussianRasterizationSettings, SparseGaussianAdam, fused_ssim, rasterize

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam", "fused_ssim",
           "rasterize_gaussians"]


def rasterize_gaussians(means3D, means2D, dc, sh, colors_precomp, opacities, scales, rotations, cov3Ds_precomp,
                        raster_settings):
    """Renders as `diff_smoe_rasterization.rasterize`, whose shapes and errors are these.

    Returns: color [C, H, W], radii [N] int32, inverse depth [1, H, W]: in `alpha` mode sum(w / z) over the Gaussians of
    a pixel, w = alpha T; in the SMoE modes divided by what colours are divided by. The last has a gradient too.
    """
    rendering = rasterize(means3D, opacities, raster_settings, means2D=means2D, dc=dc, shs=sh,
                          colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                          cov3D_precomp=cov3Ds_precomp, outputs=("inverse_depth",))
    return rendering.color, rendering.radii, rendering.inverse_depth


class GaussianRasterizer(diff_smoe_rasterization.GaussianRasterizer):
    """Renders as `rasterize_gaussians`. raster_settings: GaussianRasterizationSettings."""

    def forward(self, means3D, means2D, opacities, dc=None, shs=None, colors_precomp=None, scales=None, rotations=None,
                cov3D_precomp=None):
        """Returns color [C, H, W], radii [N] int32, inverse depth [1, H, W].

        dc: [N, 1, 3], where shs [N, K - 1, 3] holds only the other coefficients; without it shs is [N, K, 3].
        """
        return rasterize_gaussians(means3D, means2D, dc, shs, colors_precomp, opacities, scales, rotations,
                                   cov3D_precomp, self.raster_settings)
