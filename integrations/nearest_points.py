"""The API of the rasterizer of B32xN0/gaussian-splatting: `nearest_points` in the settings.

In scenes of DUSt3R the gradient of means3D is turned towards them; such scenes are refused. Elsewhere they are None.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("nearest_points", __name__)
