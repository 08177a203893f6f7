"""The API of gaussian-grouping's rasterizer: `sh_objs` [N, 1, F] are blended beside the colours in one rendering."""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("grouping", __name__)
