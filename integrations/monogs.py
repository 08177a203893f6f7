"""The API of MonoGS's rasterizer: depth, opacity, n_touched, and the camera's gradient by `theta` and `rho`.

theta and rho [3] are a small rotation and translation that follow world to view: T becomes exp(rho, theta) T. Their
values are not read, only their gradients are of use; the trainer moves its camera by them. With a rolling shutter they
move the poses of both ends. `n_touched` counts every pixel that blended a Gaussian, also if it lies behind others: the
original counts those in front, of T > 1/2.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("monogs", __name__)
