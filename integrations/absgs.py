"""The API of AbsGS's rasterizer: means2D [N, 4] gets sums of absolute gradients, and weights are a third result."""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("absgs", __name__)
