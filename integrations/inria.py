"""The API of Inria's rasterizer of 2023: twelve settings, and a call that returns color, radii.

It is the package's own API, but that means2D [N, 4] gets sums of absolute gradients, as forks for AbsGS need. Further
settings of the package may be given by keyword.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("inria", __name__)
