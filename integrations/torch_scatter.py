"""What trainers use of torch_scatter, in plain torch: `scatter` (c3dgs) and `scatter_max` (HAC, HAC++)."""
from __future__ import annotations

from typing import Optional, Tuple

import torch

from diff_smoe_rasterization.checks import check_tensors

__all__ = ["scatter", "scatter_max"]


def scatter(src: torch.Tensor, index: torch.Tensor, dim: int = -1, out: Optional[torch.Tensor] = None,
            dim_size: Optional[int] = None, reduce: str = "sum") -> torch.Tensor:
    """Sums the elements of `src` that have the same index along `dim`.

    src: any shape. index: int64, of one axis, that of `dim`, or of the first axes of `src`; axes of size 1 and those
    that are missing are expanded. dim_size: the size of the result along `dim`; None: the largest index + 1. Has a
    gradient by `src`.
    Raises NotImplementedError for what the trainers do not use: `out`, and another reduction than "sum" or "add".
    """
    if out is not None or reduce not in ("sum", "add"):
        raise NotImplementedError(f"scatter: reduce is {reduce!r}, out is {'None' if out is None else 'given'}; this "
                                  "module offers only sums into a new tensor")
    index, shape = _fitted("scatter", src, index, dim, dim_size)
    return src.new_zeros(shape).scatter_add_(dim, index, src)


def scatter_max(src: torch.Tensor, index: torch.Tensor, dim: int = -1, out: Optional[torch.Tensor] = None,
                dim_size: Optional[int] = None) -> Tuple[torch.Tensor, torch.Tensor]:
    """Returns the largest of the elements of `src` that have the same index along `dim`, and its place.

    Arguments as for `scatter`. Returns the maxima, 0 if no element has that index, and their int64 positions along
    `dim`: the first of equal ones, the size of `src` if there is none. The maxima have a gradient by `src`.
    Raises NotImplementedError if `out` is given.
    """
    if out is not None:
        raise NotImplementedError("scatter_max: out is given; this module offers only maxima in a new tensor")
    index, shape = _fitted("scatter_max", src, index, dim, dim_size)
    size = src.shape[dim]
    values = src.detach()
    largest = values.new_zeros(shape).scatter_reduce_(dim, index, values, "amax", include_self=False)
    is_largest = values == largest.gather(dim, index)
    along = [1] * src.dim()
    along[dim] = size
    places = torch.arange(size, device=src.device).reshape(along).expand_as(src).masked_fill(~is_largest, size)
    places = places.new_full(shape, size).scatter_reduce_(dim, index, places, "amin")
    # Gathered by place, the maxima carry the gradient; a row of zeros stands for what no element belongs to.
    padding = list(src.shape)
    padding[dim] = 1
    return torch.cat([src, src.new_zeros(padding)], dim).gather(dim, places), places


def _fitted(function, src, index, dim, dim_size):
    """Returns the index in the shape of `src`, and the shape of the result. Raises TypeError or ValueError."""
    check_tensors(function, src=src, index=index)
    if index.dtype != torch.int64:
        raise TypeError(f"{function}: index is {index.dtype}; it must be torch.int64")
    if not -src.dim() <= dim < src.dim():
        raise ValueError(f"{function}: dim is {dim}; src has {src.dim()} axes")
    before = dim % src.dim() if index.dim() == 1 else 0
    behind = src.dim() - index.dim() - before
    # What is missing counts as 1: behind the axes of the index, and around a single one.
    axes = [1] * before + list(index.shape) + [1] * behind
    if behind < 0 or any(size not in (1, wanted) for size, wanted in zip(axes, src.shape)):
        raise ValueError(f"{function}: index has shape {list(index.shape)}; it must fit src, {list(src.shape)}")
    index, shape = index.reshape(axes).expand_as(src), list(src.shape)
    shape[dim] = dim_size if dim_size is not None else (int(index.max()) + 1 if index.numel() else 0)
    return index, shape
