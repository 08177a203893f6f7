"""The API of Mini-Splatting's rasterizer: scores of each Gaussian beside the image, and `render_depth`.

Which Gaussian has the largest weight in a pixel is found by one more walk over the image, in plain torch. That takes
many times as long as the rendering. The original's rays of `render_depth` are shifted by 1% of the way to the origin;
these go through the pixels' centres.
"""
from __future__ import annotations

from typing import Any, Dict

import torch

from diff_smoe_rasterization import GaussianRasterizationSettings as Settings

from ._rasterizer import classes_of, results_of
from ._walk import Walk

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    color, *rest = results_of(("color", "radii", "weights", "counts"), settings, inputs)
    strongest = _strongest(settings, inputs).reshape(-1)
    pixels = torch.bincount(strongest[strongest >= 0], minlength=len(inputs["means3D"]))
    return color, *rest, pixels.to(color.dtype)


GaussianRasterizationSettings, _Rasterizer, rasterize_gaussians = classes_of("mini_splatting", __name__, _render)


class GaussianRasterizer(_Rasterizer):
    __doc__ = _Rasterizer.__doc__

    @torch.no_grad()
    def render_depth(self, means3D, means2D, opacities, shs=None, colors_precomp=None, scales=None, rotations=None,
                     cov3D_precomp=None) -> Dict[str, torch.Tensor]:
        """Returns images: where the ray of each pixel is deepest inside the Gaussian of the largest weight there.

        render [C, H, W]. gidx [1, H, W] int32, which Gaussian; 0 where there is none, as are the following three.
        out_pts [3, H, W], the point; rendered_depth [1, H, W], its view z; discriminants [1, H, W], above 0 where the
        ray meets the ellipsoid of 3 sigma. accum_alpha [1, H, W], the share of the pixel that the background has.
        A Gaussian that is deepest behind the camera is not left out. Raises ValueError without Gaussians, or their
        scales and rotations.
        """
        if scales is None or rotations is None or not len(scales):
            raise ValueError("render_depth needs Gaussians with scales and rotations")
        settings = self.raster_settings
        inputs = {"means3D": means3D, "opacities": opacities, "shs": shs, "colors_precomp": colors_precomp,
                  "scales": scales, "rotations": rotations}
        color, share = results_of(("color", "alpha"), settings, inputs)
        gidx = _strongest(settings, inputs)
        found, shown = gidx >= 0, gidx.clamp(min=0)
        view = settings.viewmatrix.to(color)
        lens = torch.linalg.solve(view, settings.projmatrix.to(color))
        y, x = ((2 * torch.arange(size).to(color) + 1) / size - 1 for size in gidx.shape)
        x, y = (x - lens[2, 0]) / lens[0, 0], (y - lens[2, 1]) / lens[1, 1]
        ray = x[None, :, None] * view[:3, 0] + y[:, None, None] * view[:3, 1] + view[:3, 2]  # of view z 1
        origin = settings.campos.to(color)
        w, i, j, k = rotations[shown].unbind(-1)
        axes = torch.stack([1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j),
                            2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i),
                            2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)], -1)
        local = axes.unflatten(-1, (3, 3)) / (3 * scales[shown])[..., None]  # an ellipsoid becomes the unit sphere
        along = (local @ ray[..., None])[..., 0]
        start = (local @ (origin - means3D[shown])[..., None])[..., 0]
        a, b, c = (along * along).sum(-1), 2 * (along * start).sum(-1), (start * start).sum(-1) - 1
        depth = -b / (2 * a)
        length = (ray * ray).sum(-1).sqrt()  # the original's ray has the length 1 here
        images = {"out_pts": (origin + depth[..., None] * ray).permute(2, 0, 1), "rendered_depth": depth[None],
                  "discriminants": ((b * b - 4 * a * c) / length**2)[None], "gidx": shown[None].int()}
        return {"render": color, "accum_alpha": 1 - share,
                **{name: image.masked_fill(~found, 0) for name, image in images.items()}}


@torch.no_grad()
def _strongest(settings: Settings, inputs: Dict[str, Any]) -> torch.Tensor:
    """Returns which Gaussian has the largest weight in each pixel [H, W], -1 where none has one."""
    walk = Walk(settings, inputs)
    best = walk.image_of_tiles(0.0)
    strongest = walk.image_of_tiles(-1)
    for tiles, which, weight in walk.steps():
        largest, index = weight.max(1)
        better = largest > best[tiles]
        best[tiles] = torch.where(better, largest, best[tiles])
        found = which.gather(1, index.flatten(1)).reshape(index.shape)
        strongest[tiles] = torch.where(better, found, strongest[tiles])
    return walk.untiled(strongest)
