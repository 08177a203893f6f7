"""The API of COB-GS's rasterizer, and of NG-GS's: that of 2024, and a mask that only their second stage asks for."""
import torch

from ._rasterizer import classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    if settings.include_mask:
        raise NotImplementedError("rasterize: include_mask is set (masks are segmented); this package renders the "
                                  "images of the stage before alone")
    inputs = {name: value for name, value in inputs.items() if name not in ("mask_precomp", "mask_signals")}
    color, radii, inverse_depth = results_of(("color", "radii", "inverse_depth"), settings, inputs)
    return color, torch.zeros_like(inverse_depth), radii, inverse_depth


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("cob_gs", __name__, _render)
