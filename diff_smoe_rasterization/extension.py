"""The compiled extension: loading it, or saying in plain words why it does not load, and what it was built with."""
from __future__ import annotations

import importlib
import os
from typing import Any, Dict, NoReturn, Optional, Tuple

import torch

from ._version import __version__

_BUILD_AGAIN = "build it again against this torch: pip install --no-build-isolation --no-deps --force-reinstall ."


def _recorded(name: str) -> Optional[str]:
    """Returns what the build wrote down under this name, readable even where the extension cannot be loaded."""
    try:
        return getattr(importlib.import_module("._build_info", __package__), name, None)
    except ImportError:
        return None


def _release(version: str) -> str:
    return ".".join(version.split(".")[:2])


def _numbers(version: str) -> Tuple[int, ...]:
    return tuple(int(number) for number in version.split(".")[:2])


def _fail(reason: str, cause: Optional[BaseException] = None) -> NoReturn:
    raise ImportError(f"diff_smoe_rasterization: {reason}") from cause


def _load() -> Any:
    built_against = _recorded("TORCH_VERSION")
    stable_since = _recorded("STABLE_ABI_SINCE")
    if stable_since is not None and _numbers(torch.__version__) < _numbers(stable_since):
        _fail(f"this build works with torch {stable_since} and later, but torch {torch.__version__} is running; update "
              "torch, or build it against this one, in the source folder: pip install --no-build-isolation -e .")
    mismatch = f"its extension was built against torch {built_against}, but torch {torch.__version__} is running; "
    if stable_since is None and built_against is not None and _release(built_against) != _release(torch.__version__):
        _fail(mismatch + _BUILD_AGAIN)
    try:
        return importlib.import_module("._C", __package__)
    except ModuleNotFoundError as error:
        if error.name != f"{__package__}._C":
            raise
        folder = os.path.dirname(os.path.abspath(__file__))
        _fail(f"its extension _C is not built for this Python in {folder}; in the source folder type: "
              "pip install --no-build-isolation -e .", error)
    except ImportError as error:
        _fail((f"its extension does not load ({error}); it was built against torch "
               f"{built_against or 'of another build'}, and torch {torch.__version__} is running; ") + _BUILD_AGAIN,
              error)


def _built_with_cuda() -> bool:
    try:
        return _C.build_info()["cuda_built"]
    except ValueError as error:  # DSMOE_SIMD names no level of this processor
        _fail(str(error))


_C = _load()

BACKENDS = ("cpu", "cuda") if _built_with_cuda() else ("cpu",)
"""The device types that this build renders on."""


def build_info() -> Dict[str, Any]:
    """Returns what this build is and what it runs on.

    Keys: version, torch (running), torch_built_with, stable_abi_since (the oldest torch that this build works with;
    None where torch_built_with is the only one), compiler, cuda_built, without_cuda_because (None where it is built or
    the build left no word), simd_level ("avx512", "avx2" or "baseline"), num_threads (torch's, which the CPU backend
    uses).
    """
    return {"version": __version__, "torch": torch.__version__, **_C.build_info(),
            "stable_abi_since": _recorded("STABLE_ABI_SINCE"),
            "without_cuda_because": _recorded("WITHOUT_CUDA_BECAUSE") or None}


def cmake_prefix_path() -> str:
    """Returns what CMAKE_PREFIX_PATH needs for find_package(diff_smoe_rasterization) in C++: this package and torch."""
    return ";".join([os.path.dirname(os.path.abspath(__file__)), torch.utils.cmake_prefix_path])


def set_profiling(enabled: bool) -> None:
    """Turns the clock of `stage_times` on or off; it is off at first. It covers the whole process.

    On CUDA every pass then waits for its kernels.
    """
    _C.set_profiling(enabled)


def stage_times() -> Dict[str, float]:
    """Returns the seconds of each stage of the last rendering and of the last backward pass, on any device.

    Keys: project, sort, bin, blend, blend_backward, project_backward in seconds; forward_pairs and backward_pairs count
    the (Gaussian, pixel) pairs that the blend evaluated. All are 0 until something was rendered under
    `set_profiling(True)`.
    """
    return _C.stage_times()
