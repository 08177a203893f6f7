"""A drop-in 3D Gaussian Splatting rasterizer whose blending can be gated: Steered Mixture-of-Experts colours.

    from diff_smoe_rasterization import GaussianRasterizationSettings, GaussianRasterizer

as with Inria's rasterizer of 2023; `blend_mode` in the settings is the one addition. `rasterize` is the full function.
"""
from ._version import __version__
from .extension import build_info, set_profiling, stage_times
from .rasterizer import GaussianRasterizer, rasterize, rasterize_gaussians
from .settings import BLEND_MODES, OUTPUTS, GaussianRasterizationSettings, Rendering

__all__ = ["BLEND_MODES", "OUTPUTS", "GaussianRasterizationSettings", "GaussianRasterizer", "Rendering", "__version__",
           "build_info", "rasterize", "rasterize_gaussians", "set_profiling", "stage_times"]
