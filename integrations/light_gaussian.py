"""The API of LightGaussian's rasterizer: under `f_count` two scores of each Gaussian come before the usual results.

They are how many pixels blended it, and that number times its opacity.
"""
from ._rasterizer import classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    scores = ("counts", "opacity_sums") if settings.f_count else ()
    return results_of((*scores, "color", "radii"), settings, inputs)


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("light_gaussian", __name__, _render)
