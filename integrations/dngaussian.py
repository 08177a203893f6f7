"""The API of DNGaussian's rasterizer, `diff_gaussian_rasterization_depth`: a depth and alpha."""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("dngaussian", __name__)
