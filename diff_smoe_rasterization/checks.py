"""Types of arguments: what torch would refuse without the function's name, or with an AttributeError."""
from __future__ import annotations

import numbers
from typing import Any

import torch


def check_tensor(function: str, name: str, value: Any) -> None:
    """Raises TypeError if a named argument of a function is not a dense tensor."""
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{function}: {name} is of type {type(value).__name__}; it must be a torch.Tensor")
    if value.layout is not torch.strided:
        raise TypeError(f"{function}: {name} is sparse ({value.layout}); it must be dense: {name}.to_dense()")


def check_tensors(function: str, **values: Any) -> None:
    """Raises TypeError if one of the named arguments of a function is not a dense tensor, or on another device."""
    first_name, device = "", None
    for name, value in values.items():
        check_tensor(function, name, value)
        if device is None:
            first_name, device = name, value.device
        elif value.device != device:
            raise TypeError(f"{function}: {name} is on {value.device}; it must be on {device}, as {first_name} is")


def checked_number(function: str, name: str, value: Any) -> float:
    """The value of a named argument, a number or a tensor [], as a float. Raises TypeError if it is neither."""
    is_scalar = isinstance(value, torch.Tensor) and value.dim() == 0 and not value.is_complex()
    if not is_scalar and not isinstance(value, numbers.Real):
        raise TypeError(f"{function}: {name} is of type {type(value).__name__}; it must be a number")
    return float(value)
