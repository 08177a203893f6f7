"""The API of the rasterizer of B32xN0/gaussian-splatting: `nearest_points` in the settings.

In scenes of DUSt3R the gradient of means3D is turned towards them; such scenes are refused. Elsewhere they are None.
"""
from ._rasterizer import classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    if settings.nearest_points is not None:
        raise NotImplementedError("rasterize: nearest_points are set (a scene of DUSt3R); this package does not turn "
                                  "gradients towards points; train without them, as on a COLMAP scene")
    return results_of(("color", "radii"), settings, inputs)


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("nearest_points", __name__, _render)
