"""The API of rasterizers that return color, radii, depth, alpha: of dreamgaussian, LGM, DNGaussian, FSGS, SC-GS.

`confidence` [N, 1], a setting of FSGS, multiplies the gradients of each Gaussian but for `means2D`.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("depth_alpha", __name__)
