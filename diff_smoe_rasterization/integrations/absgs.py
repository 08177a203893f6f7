"""The API of AbsGS's rasterizer: means2D [N, 4], whose last two columns get sums of absolute gradients, and weights."""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("absgs", __name__)
