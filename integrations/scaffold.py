"""The API of Scaffold-GS's rasterizer, which HAC and HAC++ use: Inria's of 2023 and `visible_filter`."""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("scaffold", __name__)
