"""The API of feature-3dgs's rasterizer: `semantic_feature` [N, 1, F] is blended beside the colours in one rendering."""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("feature_3dgs", __name__)
