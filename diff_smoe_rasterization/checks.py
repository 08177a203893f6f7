"""Types of arguments: what torch would refuse without the function's name, or with an AttributeError."""
from __future__ import annotations

import functools
import numbers
from typing import Any, NoReturn

import torch


@functools.lru_cache(maxsize=None)
def has_kernels() -> bool:
    """Whether this build renders on a GPU."""
    from .extension import BACKENDS  # which loads the ops; the oracle does without

    return "cuda" in BACKENDS


def check_tensor(function: str, name: str, value: Any) -> None:
    """Raises TypeError if a named argument of a function is not a dense tensor."""
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{function}: {name} is of type {type(value).__name__}; it must be a torch.Tensor")
    if value.layout is not torch.strided:
        raise TypeError(f"{function}: {name} is sparse ({value.layout}); it must be dense: {name}.to_dense()")


def refuse_device(function: str, name: str, value: torch.Tensor) -> NoReturn:
    """Raises TypeError: this build has no code for a tensor's device. For a GPU it says why: a build hides that."""
    from .extension import BACKENDS, build_info

    reason = build_info()["without_cuda_because"] if value.device.type == "cuda" else None
    raise TypeError(f"{function}: {name} is on {value.device}; this build renders on {' and '.join(BACKENDS)}"
                    + (f": {reason}" if reason else ""))


def check_tensors(function: str, **values: Any) -> None:
    """Raises TypeError if one of the named arguments of a function is not a dense tensor, or on another device."""
    first_name, device = "", None
    for name, value in values.items():
        check_tensor(function, name, value)
        if device is None:
            first_name, device = name, value.device
            if device.type == "cuda" and not has_kernels():
                refuse_device(function, name, value)
        elif value.device != device:
            raise TypeError(f"{function}: {name} is on {value.device}; it must be on {device}, as {first_name} is")


def checked_number(function: str, name: str, value: Any) -> float:
    """The value of a named argument, a number or a tensor [], as a float. Raises TypeError if it is neither."""
    is_scalar = isinstance(value, torch.Tensor) and value.dim() == 0 and not value.is_complex()
    if not is_scalar and not isinstance(value, numbers.Real):
        raise TypeError(f"{function}: {name} is of type {type(value).__name__}; it must be a number")
    return float(value)
