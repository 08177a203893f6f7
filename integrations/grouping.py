"""The API of gaussian-grouping's rasterizer: `sh_objs` [N, 1, F] are blended beside the colours in one rendering."""
from ._rasterizer import classes_of, results_of, results_with_features

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    objects = inputs.pop("sh_objs", None)
    if objects is None:
        color, radii = results_of(("color", "radii"), settings, inputs)
        return color, radii, color.new_zeros(0, *color.shape[1:])
    return results_with_features(("color", "radii", "objects"), settings, inputs, "objects", objects)


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("grouping", __name__, _render)
