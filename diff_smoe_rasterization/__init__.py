"""A drop-in 3D Gaussian Splatting rasterizer whose blending can be gated: Steered Mixture-of-Experts colours.

    from diff_smoe_rasterization import GaussianRasterizationSettings, GaussianRasterizer

as with Inria's rasterizer of 2023; `blend_mode` in the settings is the one addition. `rasterize` is the full function.
"""
from ._version import __version__
from .settings import BLEND_MODES, OUTPUTS, GaussianRasterizationSettings, Rendering

try:
    from .extension import build_info, set_profiling, stage_times
    from .rasterizer import GaussianRasterizer, rasterize, rasterize_gaussians
except ImportError:
    # What is plain Python (settings, reference, the `dsmoe` command's help) works without the compiled part. The other
    # names say why they cannot be had when they are asked for: importing them again raises the same error.
    def __getattr__(name):
        if name in ("build_info", "set_profiling", "stage_times"):
            from . import extension as module
        elif name in ("GaussianRasterizer", "rasterize", "rasterize_gaussians"):
            from . import rasterizer as module
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(module, name)

__all__ = ["BLEND_MODES", "OUTPUTS", "GaussianRasterizationSettings", "GaussianRasterizer", "Rendering", "__version__",
           "build_info", "rasterize", "rasterize_gaussians", "set_profiling", "stage_times"]
