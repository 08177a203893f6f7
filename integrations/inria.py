"""The API of Inria's rasterizer of 2023: twelve settings, and a call that returns color, radii.

It is the package's own API, so nothing is left to adapt. Further settings of the package may be given by keyword.
"""
from diff_smoe_rasterization import GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]
