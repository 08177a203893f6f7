"""The API of Taming-3DGS's rasterizer: `pixel_weights` in the settings, and a call that returns thirteen tensors.

What a trainer scores Gaussians by is among them. As in the flavour of 2024, `dc` may come apart from `shs`, and
SparseGaussianAdam and `fused_ssim` are here.
"""
from __future__ import annotations

import torch

import diff_smoe_rasterization
from diff_smoe_rasterization import SparseGaussianAdam, fused_ssim, rasterize_with_splats

from ._rasterizer import settings_with

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam", "fused_ssim",
           "rasterize_gaussians"]

GaussianRasterizationSettings = settings_with(["pixel_weights"], __name__)
GaussianRasterizationSettings.__doc__ = """The package's settings, with `pixel_weights` as the thirteenth.

pixel_weights: [H, W], what to sum over the pixels of each Gaussian; None, or a tensor without elements, for no sums.
"""


def rasterize_gaussians(means3D, means2D, dc, sh, colors_precomp, opacities, scales, rotations, cov3Ds_precomp,
                        raster_settings):
    """Renders as `diff_smoe_rasterization.rasterize`, whose shapes and errors are these.

    Returns, with N Gaussians and an image of H x W pixels:
        color: [C, H, W], the only result with a gradient.
        radii: [N] int32.
        counts: [H, W] int32, zeros; [0] without pixel_weights.
        lists, lists_render, lists_distance: [0], int32 and twice the type of means3D.
        centers: [N, 2] pixels, and depths: [N] view z; 0 if the radius is.
        my_radii: [N] int32, a copy of radii.
        accum_weights, accum_count, accum_blend, accum_dist: [N], int32 the second, [0] without pixel_weights: over the
            pixels that blended a Gaussian the sums of pixel_weights, of 1, of its weight and of the distance from its
            centre in pixels. The weight is alpha T, in `smoe_std` alpha, divided by no gate sum.
    Raises ValueError or TypeError if pixel_weights does not fit too.
    """
    rendering, splats = rasterize_with_splats(means3D, opacities, raster_settings, means2D=means2D, dc=dc, shs=sh,
                                              colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                                              cov3D_precomp=cov3Ds_precomp)
    color, radii, pixel_weights = rendering.color, rendering.radii, raster_settings.pixel_weights

    def empty(like):
        return like.new_empty(0)

    if pixel_weights is None or isinstance(pixel_weights, torch.Tensor) and pixel_weights.numel() == 0:
        counts, sums = empty(radii), (empty(color), empty(radii), empty(color), empty(color))
    else:
        counts, sums = radii.new_zeros(color.shape[1:]), splats.contributions(pixel_weights)
    return (color, radii, counts, empty(radii), empty(color), empty(color), splats.centers, splats.depths,
            radii.clone(), *sums)


class GaussianRasterizer(diff_smoe_rasterization.GaussianRasterizer):
    """Renders as `rasterize_gaussians`. raster_settings: GaussianRasterizationSettings of this module."""

    def forward(self, means3D, means2D, opacities, dc=None, shs=None, colors_precomp=None, scales=None, rotations=None,
                cov3D_precomp=None):
        """Returns thirteen tensors, as `rasterize_gaussians` names them.

        dc: [N, 1, 3], if shs [N, K - 1, 3] holds only the other coefficients; without it shs is [N, K, 3].
        """
        return rasterize_gaussians(means3D, means2D, dc, shs, colors_precomp, opacities, scales, rotations,
                                   cov3D_precomp, self.raster_settings)
