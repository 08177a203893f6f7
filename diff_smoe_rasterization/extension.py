"""The torch ops, or why they do not load, in plain words; and what the build is."""
from __future__ import annotations

import os
from typing import Any, Dict, Tuple

import torch

from ._version import __version__
from .build_record import BUILD, fail, recorded

_BUILD_AGAIN = "build it again against this torch: pip install --no-build-isolation --no-deps --force-reinstall ."


def _release(version: str) -> str:
    return ".".join(version.split(".")[:2])


def _numbers(version: str) -> Tuple[int, ...]:
    return tuple(int(number) for number in version.split(".")[:2])


def _check_torch() -> None:
    built_against = recorded("TORCH_VERSION")
    stable_since = recorded("STABLE_ABI_SINCE")
    if stable_since is not None and _numbers(torch.__version__) < _numbers(stable_since):
        fail(f"this build works with torch {stable_since} and later, but torch {torch.__version__} is running; update "
             f"torch, or build it against this one, {BUILD}")
    mismatch = f"its ops were built against torch {built_against}, but torch {torch.__version__} is running; "
    if stable_since is None and built_against is not None and _release(built_against) != _release(torch.__version__):
        fail(mismatch + _BUILD_AGAIN)


def _load_ops() -> None:
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "_ops.so")
    if not os.path.isfile(path):
        fail(f"its ops are not built: there is no {path}; {BUILD}")
    try:
        torch.ops.load_library(path)
    except OSError as error:
        fail((f"its ops do not load ({error}); they were built against torch "
              f"{recorded('TORCH_VERSION') or 'of another build'}, "
              f"and torch {torch.__version__} is running; ") + _BUILD_AGAIN, error)


def _built_with_cuda() -> bool:
    try:
        return _core.build_info()["cuda_built"]
    except ValueError as error:  # DSMOE_SIMD names no level of this processor
        fail(str(error))


_check_torch()
from .core import _core  # noqa: E402  (which would not say that PyTorch is another)

_load_ops()

BACKENDS = ("cpu", "cuda") if _built_with_cuda() else ("cpu",)
"""The device types that this build renders on."""


def build_info() -> Dict[str, Any]:
    """Returns what this build is and what it runs on.

    Keys: version, torch (running), torch_built_with, stable_abi_since (the oldest torch that this build works with;
    None if torch_built_with is the only one), compiler, cuda_built, without_cuda_because (None if it is built or
    the build left no word), simd_level ("avx512", "avx2" or "baseline"), num_threads (torch's, which the CPU backend
    uses).
    """
    return {"version": __version__, "torch": torch.__version__, "torch_built_with": recorded("TORCH_VERSION"),
            "num_threads": torch.get_num_threads(), **_core.build_info(),
            "stable_abi_since": recorded("STABLE_ABI_SINCE"),
            "without_cuda_because": recorded("WITHOUT_CUDA_BECAUSE") or None}


def cmake_prefix_path() -> str:
    """Returns what CMAKE_PREFIX_PATH needs for find_package(diff_smoe_rasterization) in C++: this package and torch."""
    return ";".join([os.path.dirname(os.path.abspath(__file__)), torch.utils.cmake_prefix_path])


def set_profiling(enabled: bool) -> None:
    """Turns the clock of `stage_times` on or off; it is off at first. It covers the whole process.

    On CUDA every pass then waits for its kernels.
    """
    _core.set_profiling(enabled)


def stage_times() -> Dict[str, float]:
    """Returns the seconds of each stage of the last rendering and of the last backward pass, on any device.

    Keys: project, sort, bin, blend, blend_backward, project_backward in seconds; forward_pairs and backward_pairs count
    the (Gaussian, pixel) pairs that the blend evaluated. All are 0 until something was rendered under
    `set_profiling(True)`.
    """
    return _core.stage_times()
