"""A drop-in 3D Gaussian Splatting rasterizer whose blending can be gated: Steered Mixture-of-Experts colours.

    from diff_smoe_rasterization import GaussianRasterizationSettings, GaussianRasterizer

as with Inria's rasterizer of 2023; `blend_mode` in the settings is the one addition. `rasterize` is the full function.
"""
import os
import sys
from typing import TYPE_CHECKING, Any, List

from ._version import __version__
from .settings import BLEND_MODES, OUTPUTS, Contributions, GaussianRasterizationSettings, Importance, Rendering

_HOMES = {"build_info": "extension", "set_profiling": "extension", "stage_times": "extension", "fused_ssim": "losses",
          "distCUDA2": "neighbors", "FusedAdam": "optimizers", "SparseGaussianAdam": "optimizers",
          "LazyAdam": "lazy_adam", "DirectRendering": "direct",
          "GaussianRasterizer": "rasterizer", "rasterize": "rasterizer", "rasterize_gaussians": "rasterizer",
          "rasterize_with_splats": "rasterizer", "settings_from_camera": "camera", "Splats": "splats",
          "visible_radii": "rasterizer"}

if TYPE_CHECKING:
    from .camera import settings_from_camera
    from .direct import DirectRendering
    from .extension import build_info, set_profiling, stage_times
    from .lazy_adam import LazyAdam
    from .losses import fused_ssim
    from .neighbors import distCUDA2
    from .optimizers import FusedAdam, SparseGaussianAdam
    from .rasterizer import GaussianRasterizer, rasterize, rasterize_gaussians, rasterize_with_splats, visible_radii
    from .splats import Splats


def __getattr__(name: str) -> Any:
    import importlib

    if name in _HOMES.values():
        return importlib.import_module("." + name, __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module("." + _HOMES[name], __name__), name)
    return value


def __dir__() -> List[str]:
    return sorted({*globals(), *_HOMES, *_HOMES.values()})


# What is plain Python (settings, reference, the help of `dsmoe`) works without the compiled part; the names above
# say why they cannot be had when they are asked for. To load it takes seconds where torch is not loaded yet, so a
# program pays for it when it asks for one of them. Where torch is loaded, the import registers torch's ops at once,
# as programs expect that load an exported model; but for `dsmoe`, which does so where it renders.
if "torch" in sys.modules and os.path.basename((getattr(sys, "argv", None) or [""])[0]) != "dsmoe":
    try:
        for _name in _HOMES:
            __getattr__(_name)
    except ImportError:
        pass

# setup.py installs the folders integrations, patches and benchmarks inside the package. In a source tree they lie
# beside it, where its submodules are then looked for too. Beside an installed package such folders are a stranger's.
_beside = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
if all(os.path.isfile(os.path.join(_beside, *path)) for path in (("sources.txt",), ("build_support", "backend.py"))):
    __path__.append(_beside)

__all__ = ["BLEND_MODES", "Contributions", "DirectRendering", "FusedAdam", "GaussianRasterizationSettings",
           "GaussianRasterizer", "Importance", "LazyAdam", "OUTPUTS", "Rendering", "SparseGaussianAdam", "Splats",
           "__version__", "build_info", "distCUDA2", "fused_ssim", "rasterize", "rasterize_gaussians",
           "rasterize_with_splats", "set_profiling", "settings_from_camera", "stage_times", "visible_radii"]
