"""A drop-in 3D Gaussian Splatting rasterizer whose blending can be gated: Steered Mixture-of-Experts colours.

    from diff_smoe_rasterization import GaussianRasterizationSettings, GaussianRasterizer

as with Inria's rasterizer of 2023; `blend_mode` in the settings is the one addition. `rasterize` is the full function.
"""
import os

from ._version import __version__
from .settings import BLEND_MODES, OUTPUTS, GaussianRasterizationSettings, Rendering

try:
    from .extension import build_info, set_profiling, stage_times
    from .losses import fused_ssim
    from .neighbors import distCUDA2
    from .optimizers import FusedAdam, SparseGaussianAdam
    from .rasterizer import GaussianRasterizer, rasterize, rasterize_gaussians
except ImportError:
    # What is plain Python (settings, reference, the `dsmoe` command's help) works without the compiled part. The other
    # names say why they cannot be had when they are asked for: importing them again raises the same error.
    _HOMES = {"build_info": "extension", "set_profiling": "extension", "stage_times": "extension",
              "fused_ssim": "losses", "distCUDA2": "neighbors", "FusedAdam": "optimizers",
              "SparseGaussianAdam": "optimizers", "GaussianRasterizer": "rasterizer", "rasterize": "rasterizer",
              "rasterize_gaussians": "rasterizer"}

    def __getattr__(name):
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        import importlib

        return getattr(importlib.import_module("." + _HOMES[name], __name__), name)

# setup.py installs the folders integrations, patches and benchmarks inside the package. In a source tree they lie beside
# it, where its submodules are then looked for too. Beside an installed package such folders are a stranger's.
_beside = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
if all(os.path.isfile(os.path.join(_beside, *path)) for path in (("sources.txt",), ("build_support", "backend.py"))):
    __path__.append(_beside)

__all__ = ["BLEND_MODES", "FusedAdam", "GaussianRasterizationSettings", "GaussianRasterizer", "OUTPUTS", "Rendering",
           "SparseGaussianAdam", "__version__", "build_info", "distCUDA2", "fused_ssim", "rasterize",
           "rasterize_gaussians", "set_profiling", "stage_times"]
