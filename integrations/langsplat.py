"""The API of LangSplat's rasterizer: `language_feature_precomp` [N, F] is blended beside the colours in one rendering.

Without `include_feature` in the settings the features are not read, and their image is black.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("langsplat", __name__)
