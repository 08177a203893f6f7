"""The API of LangSplat's rasterizer: `language_feature_precomp` [N, F] is blended beside the colours in one rendering.

Without `include_feature` in the settings the features are not read, and their image is black.
"""
from ._rasterizer import classes_of, results_of, results_with_features

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    features = inputs.pop("language_feature_precomp", None)
    if settings.include_feature and features is not None:
        return results_with_features(("color", "language_feature", "radii"), settings, inputs, "language_feature",
                                     features)
    color, radii = results_of(("color", "radii"), settings, inputs)
    return color, color.new_zeros(3, *color.shape[1:]), radii


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("langsplat", __name__, _render)
