"""The API of FastGS's rasterizer: means2D [N, 4] as in absgs, and how many pixels of a map blended each Gaussian.

`metric_map` has a 1 for each pixel that counts; `get_flag` says whether to count. `mult` shrinks the original's
footprints; here they are exact.
"""
from diff_smoe_rasterization import SparseGaussianAdam, rasterize_with_splats
from diff_smoe_rasterization.checks import check_tensor

from ._rasterizer import check_size, classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam", "rasterize_gaussians"]


def _render(settings, inputs):
    if not settings.get_flag:
        color, radii = results_of(("color", "radii"), settings, inputs)
        return color, radii, radii.new_zeros(radii.shape)
    rendering, splats = rasterize_with_splats(settings=settings, **inputs)
    check_tensor("rasterize", "metric_map", settings.metric_map)
    check_size("metric_map", settings.metric_map, rendering.color[0].numel())
    counted = (settings.metric_map.reshape(rendering.color.shape[1:]) == 1).to(rendering.color.dtype)
    return rendering.color, rendering.radii, splats.contributions(counted).pixel_weights.round().to(rendering.radii)


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("fastgs", __name__, _render)
