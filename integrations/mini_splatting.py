"""The API of Mini-Splatting's rasterizer: scores of each Gaussian beside the image, and `render_depth`.

The original's rays of `render_depth` are shifted by 1% of the way to the origin; these go through the pixels' centres.
"""
from __future__ import annotations

from typing import Dict

import torch

from diff_smoe_rasterization import rasterize_with_splats
from diff_smoe_rasterization.gaussians import quaternion_to_matrix

from ._rasterizer import classes_of, pixel_rays, share_of_gaussians

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, _Rasterizer, rasterize_gaussians = classes_of("mini_splatting", __name__)


class GaussianRasterizer(_Rasterizer):
    __doc__ = _Rasterizer.__doc__

    @torch.no_grad()
    def render_depth(self, means3D, means2D, opacities, shs=None, colors_precomp=None, scales=None, rotations=None,
                     cov3D_precomp=None) -> Dict[str, torch.Tensor]:
        """Returns images: where the ray of each pixel is deepest inside the Gaussian of the largest weight there.

        render [C, H, W]. gidx [1, H, W] int32, which Gaussian; 0 if there is none, as are the following three.
        out_pts [3, H, W], the point; rendered_depth [1, H, W], its view z; discriminants [1, H, W], above 0 if the
        ray meets the ellipsoid of 3 sigma. accum_alpha [1, H, W], the share of the pixel that the background has.
        A Gaussian that is deepest behind the camera is not left out. Raises ValueError without Gaussians, or their
        scales and rotations.
        """
        if scales is None or rotations is None or not len(scales):
            raise ValueError("render_depth needs Gaussians with scales and rotations")
        settings = self.raster_settings
        rendering, splats = rasterize_with_splats(means3D, opacities, settings, shs=shs, colors_precomp=colors_precomp,
                                                  scales=scales, rotations=rotations, outputs=("alpha",))
        color, gidx = rendering.color, splats.gate_map().gaussians.long()
        found, shown = gidx >= 0, gidx.clamp(min=0)
        view = settings.viewmatrix.to(color)
        x, y = pixel_rays(settings, color)
        ray = x[None, :, None] * view[:3, 0] + y[:, None, None] * view[:3, 1] + view[:3, 2]  # of view z 1
        origin = settings.campos.to(color)
        axes = quaternion_to_matrix(rotations[shown]).transpose(-1, -2).contiguous()
        local = axes / (3 * scales[shown])[..., None]  # an ellipsoid becomes the unit sphere
        along = (local @ ray[..., None])[..., 0]
        start = (local @ (origin - means3D[shown])[..., None])[..., 0]
        a, b, c = (along * along).sum(-1), 2 * (along * start).sum(-1), (start * start).sum(-1) - 1
        depth = -b / (2 * a)
        length = (ray * ray).sum(-1).sqrt()  # the original's ray has the length 1 here
        images = {"out_pts": (origin + depth[..., None] * ray).permute(2, 0, 1), "rendered_depth": depth[None],
                  "discriminants": ((b * b - 4 * a * c) / length**2)[None], "gidx": shown[None].int()}
        return {"render": color, "accum_alpha": 1 - share_of_gaussians(rendering.alpha, settings),
                **{name: image.masked_fill(~found, 0) for name, image in images.items()}}
