"""The API of rasterizers that return a depth and alpha, of dreamgaussian, LGM, FSGS and SC-GS.

`confidence` [N, 1] in the settings multiplies the gradients of each Gaussian.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("depth_alpha", __name__)
