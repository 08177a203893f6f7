"""Raw parameters of a trainer where values are expected: logits as opacities, logarithms as scales, raw quaternions.

They render without an error, and wrongly. So the first call of each function looks for them, and every call under
`debug`.
"""
from __future__ import annotations

import warnings
from typing import Any, Callable, Dict, Set, Tuple

import torch

from .autograd import is_compiling, is_transformed

_TOLERANCE = 0.01  # of a quaternion's length: half precision and quantised codebooks are closer to 1
_SIGNS: Dict[str, Tuple[Callable[[torch.Tensor], torch.Tensor], str]] = {
    "opacities": (lambda rows: rows < 0, "negative, as logits are; opacities are torch.sigmoid(logits)"),
    "scales": (lambda rows: rows < 0, "negative, as logarithms are; scales are torch.exp(logarithms)"),
    "rotations": (lambda rows: (rows.norm(dim=1, keepdim=True) - 1).abs() > _TOLERANCE,
                  "of another length than 1, and are used as given; torch.nn.functional.normalize(rotations) is a "
                  "rotation's"),
}
_looked: Set[str] = set()  # the functions that were called
_said: Set[str] = set()  # the arguments that a warning was about


def look_for_raw_values(function: str, inputs: Dict[str, Any], debug: bool) -> None:
    """Warns once of each argument that looks raw, in the first call of a function, and in each under `debug`.

    The host waits for the device then, so a CUDA graph that is captured is left alone.
    """
    if is_compiling() or (function in _looked and debug is not True) or is_transformed():
        return
    _looked.add(function)
    for name, (sign, what) in _SIGNS.items():
        given = inputs.get(name)
        if name in _said or not _can_be_read(given):
            continue
        rows: torch.Tensor = given.reshape(len(given), -1)  # type: ignore[union-attr, arg-type]
        with torch.no_grad():
            count = int((sign(rows).any(1) & rows.isfinite().all(1)).sum())
        if count:
            _said.add(name)
            warnings.warn(f"{function}: {count} of {len(rows)} {name} are {what}", stacklevel=4)


def _can_be_read(rows: Any) -> bool:
    return (type(rows) in (torch.Tensor, torch.nn.Parameter) and rows.is_floating_point()
            and rows.numel() > 0 and rows.dim() > 0 and not (rows.is_cuda and torch.cuda.is_current_stream_capturing()))
