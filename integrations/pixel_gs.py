"""The API of Pixel-GS's rasterizer: how many pixels blended each Gaussian, and `depth_threshold` in the settings.

The gradient of means2D, by which the trainer densifies, is multiplied by (z / depth_threshold)^2, at most 1: less
grows in front of the camera.
"""
from ._rasterizer import classes_of, results_of, scaled_gradients

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    points = inputs.get("means2D")
    if settings.depth_threshold and points is not None:
        depths = (inputs["means3D"] @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]).detach()
        factors = (depths / settings.depth_threshold).square().clamp(max=1)
        inputs = {**inputs, "means2D": scaled_gradients(factors, {"": points})[""]}
    return results_of(("color", "radii", "pixels"), settings, inputs)


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("pixel_gs", __name__, _render)
