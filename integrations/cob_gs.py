"""The API of COB-GS's rasterizer, which NG-GS uses: the stage without masks. `include_mask` is refused."""
import torch

from ._rasterizer import classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    if settings.include_mask:
        raise NotImplementedError("rasterize: include_mask is set (masks are segmented); this package renders only the "
                                  "images of the stage before")
    inputs = {name: value for name, value in inputs.items() if name not in ("mask_precomp", "mask_signals")}
    color, radii, inverse_depth = results_of(("color", "radii", "inverse_depth"), settings, inputs)
    return color, torch.zeros_like(inverse_depth), radii, inverse_depth


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("cob_gs", __name__, _render)
