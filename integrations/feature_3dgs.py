"""The API of feature-3dgs's rasterizer: `semantic_feature` [N, 1, F] is blended beside the colours in one rendering."""
from ._rasterizer import classes_of, results_with_features

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    return results_with_features(("color", "feature_map", "radii", "depth"), settings, inputs, "feature_map",
                                 inputs.pop("semantic_feature"))


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("feature_3dgs", __name__, _render)
