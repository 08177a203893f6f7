"""The API of Scaffold-GS's rasterizer, which HAC and HAC++ use: Inria's of 2023 and `visible_filter`."""
from __future__ import annotations

import torch

import diff_smoe_rasterization
from diff_smoe_rasterization import GaussianRasterizationSettings, rasterize_gaussians
from diff_smoe_rasterization.rasterizer import visible_radii

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizer(diff_smoe_rasterization.GaussianRasterizer):
    """Renders as Inria's module of 2023. raster_settings: GaussianRasterizationSettings."""

    @torch.no_grad()
    def visible_filter(self, means3D, scales=None, rotations=None, cov3D_precomp=None):
        """Returns the radii [N] int32 that a rendering would have, 0 for what the view does not see.

        means3D: [N, 3]; scales [N, 3] with rotations [N, 4], or cov3D_precomp [N, 6]. Views such as `scales[:, :3]` are
        taken as they are. Which radii are 0 depends on the blend mode: the anchors need that of their rendering.
        Raises ValueError or TypeError where arguments do not fit, as `rasterize` does.
        """
        return visible_radii(means3D, self.raster_settings, scales, rotations, cov3D_precomp)
