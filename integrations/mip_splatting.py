"""The API of Mip-Splatting's rasterizer, which TRELLIS uses: `kernel_size` replaces the low-pass filter's 0.3.

Opacities are compensated as under `antialiasing`. The third column of means2D gets the sum of absolute gradients of
both axes. `subpixel_offset` may be None or zeros: pixels sampled off their centres are refused.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("mip_splatting", __name__)
