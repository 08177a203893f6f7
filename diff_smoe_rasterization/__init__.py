"""A drop-in 3D Gaussian Splatting rasterizer whose blending can be gated: Steered Mixture-of-Experts colours.

    from diff_smoe_rasterization import GaussianRasterizationSettings, GaussianRasterizer

as with Inria's rasterizer of 2023; `blend_mode` in the settings is the one addition. `rasterize` is the full function.

A module is imported when one of its names is first used: importing torch takes seconds, and `settings` and the help of
`dsmoe` need none of it. Only if torch is loaded already, all names are imported at once, which registers the ops.
"""
import importlib
import sys
from typing import TYPE_CHECKING, Any, List

from ._version import __version__
from .settings import BLEND_MODES, OUTPUTS, Contributions, GateMap, GaussianRasterizationSettings, Importance, Rendering

_HOMES = {"build_info": "extension", "set_profiling": "extension", "stage_times": "extension", "fused_ssim": "losses",
          "distCUDA2": "neighbors", "Footprints": "footprints", "blend_footprints": "footprints",
          "project_gaussians": "footprints", "FusedAdam": "optimizers", "SparseGaussianAdam": "optimizers",
          "LazyAdam": "lazy_adam", "DirectRendering": "direct",
          "GaussianRasterizer": "rasterizer", "rasterize": "rasterizer", "rasterize_gaussians": "rasterizer",
          "rasterize_with_splats": "rasterizer", "settings_from_camera": "camera", "Splats": "splats",
          "visible_radii": "rasterizer"}

if TYPE_CHECKING:
    from .camera import settings_from_camera
    from .direct import DirectRendering
    from .extension import build_info, set_profiling, stage_times
    from .footprints import Footprints, blend_footprints, project_gaussians
    from .lazy_adam import LazyAdam
    from .losses import fused_ssim
    from .neighbors import distCUDA2
    from .optimizers import FusedAdam, SparseGaussianAdam
    from .rasterizer import GaussianRasterizer, rasterize, rasterize_gaussians, rasterize_with_splats, visible_radii
    from .splats import Splats


def __getattr__(name: str) -> Any:
    if name in _HOMES.values():
        return importlib.import_module("." + name, __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module("." + _HOMES[name], __name__), name)
    return value


def __dir__() -> List[str]:
    return sorted({*globals(), *_HOMES, *_HOMES.values()})


if "torch" in sys.modules:
    try:
        for _name in _HOMES:
            __getattr__(_name)
    except ImportError:  # not built; the first name that is used says so
        pass

__all__ = ["BLEND_MODES", "Contributions", "DirectRendering", "Footprints", "FusedAdam", "GateMap",
           "GaussianRasterizationSettings", "GaussianRasterizer", "Importance", "LazyAdam", "OUTPUTS", "Rendering",
           "SparseGaussianAdam", "Splats", "__version__", "blend_footprints", "build_info", "distCUDA2", "fused_ssim",
           "project_gaussians", "rasterize", "rasterize_gaussians", "rasterize_with_splats", "set_profiling",
           "settings_from_camera", "stage_times", "visible_radii"]
