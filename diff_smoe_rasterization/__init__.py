"""A drop-in 3D Gaussian Splatting rasterizer whose blending can be gated: Steered Mixture-of-Experts colours.

    from diff_smoe_rasterization import GaussianRasterizationSettings, GaussianRasterizer

as with Inria's rasterizer of 2023; `blend_mode` in the settings is the one addition. `rasterize` is the full function.
"""
from __future__ import annotations

import importlib

from ._version import __version__
from .settings import BLEND_MODES, OUTPUTS, GaussianRasterizationSettings, Rendering

# Loaded on first use, so that the parts in plain torch (`reference`, `settings`) work where nothing is compiled.
_COMPILED = {"GaussianRasterizer": "rasterizer", "rasterize": "rasterizer", "rasterize_gaussians": "rasterizer",
             "build_info": "extension", "set_profiling": "extension", "stage_times": "extension"}

__all__ = ["BLEND_MODES", "OUTPUTS", "GaussianRasterizationSettings", "Rendering", "__version__", *_COMPILED]


def __getattr__(name):
    if name not in _COMPILED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_COMPILED[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted({*globals(), *__all__})
