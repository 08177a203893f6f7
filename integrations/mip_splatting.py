"""The API of Mip-Splatting's rasterizer, which TRELLIS uses: `kernel_size` replaces the low-pass filter's 0.3.

Opacities are compensated as under `antialiasing`. The third column of means2D gets the sum of absolute gradients of
both axes. `subpixel_offset` may be None or zeros: pixels sampled off their centres are refused.
"""
from ._rasterizer import classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    offset = settings.subpixel_offset
    if offset is not None and offset.numel() > 0 and bool(offset.any()):
        raise NotImplementedError("rasterize: subpixel_offset is not zero (Mip-Splatting's --sample_more_highres); "
                                  "this package samples pixels only at their centres")
    if settings.kernel_size is not None:
        settings = settings._replace(low_pass=settings.kernel_size)
    return results_of(("color", "radii"), settings._replace(antialiasing=True), inputs)


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("mip_splatting", __name__, _render)
