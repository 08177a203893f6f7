"""The API of rasterizers that return a depth, of 4DGaussians, Deformable 3D Gaussians, GaussianEditor and SplaTAM.

`means2D_densify` gets the gradient of means2D too.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("depth", __name__)
