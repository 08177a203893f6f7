"""The API of Pixel-GS's rasterizer: how many pixels blended each Gaussian, and `depth_threshold` in the settings.

The gradient of means2D, by which the trainer densifies, is multiplied by (z / depth_threshold)^2, at most 1: less
grows in front of the camera.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("pixel_gs", __name__)
