"""The API of LucidDreamer's rasterizer: depth, and the share that the background has, are one image."""
import torch

from ._rasterizer import classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    color, radii, depth, alpha = results_of(("color", "radii", "depth", "alpha"), settings, inputs)
    return color, radii, torch.cat([depth, 1 - alpha])


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("lucid_dreamer", __name__, _render)
