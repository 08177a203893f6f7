"""The API of DNGaussian's rasterizer of another name: `depth_alpha`, but for `confidence`."""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("dngaussian", __name__)
