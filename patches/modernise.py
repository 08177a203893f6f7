"""What --modernise does as a script begins: what a trainer needs to start on today's torch, CUDA and Python."""
from __future__ import annotations

import builtins
import os
import sys
from functools import partial
from typing import Any

import numpy
import torch
from PIL import Image

from .runtime import STAND_INS

EIGH_AT_ONCE = 16_384  # cuSOLVER's batched solver of CUDA 12.8 and later fails on batches somewhere above 32,000


def start() -> None:
    """Changes modules of this process; README.md has the list and the reasons."""
    sys.path.insert(1, str(STAND_INS))  # behind the script's folder
    os.environ.setdefault("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # torch.load, if a call does not say
    for name in ("int", "float", "bool", "object"):
        if name not in vars(numpy):
            setattr(numpy, name, getattr(builtins, name))
    Image.fromarray = partial(picture, Image.fromarray)
    torch.linalg.eigh = partial(eigh_in_parts, torch.linalg.eigh)
    torch.unique = partial(unique_rows, torch.unique)


def picture(fromarray: Any, obj: Any, *arguments: Any, **keywords: Any) -> Any:
    """What PIL.Image.fromarray returns, which takes np.byte for np.uint8."""
    return fromarray(obj.view("uint8") if obj.dtype == "int8" else obj, *arguments, **keywords)


def eigh_in_parts(eigh: Any, A: Any, UPLO: str = "L", **keywords: Any) -> Any:
    """What torch.linalg.eigh returns, computed for so many matrices [..., n, n] at once as its CUDA solver can take."""
    flat = A.reshape(-1, *A.shape[-2:])
    if len(flat) <= EIGH_AT_ONCE or keywords:
        return eigh(A, UPLO=UPLO, **keywords)
    parts = [eigh(part, UPLO=UPLO) for part in flat.split(EIGH_AT_ONCE)]
    values, vectors = (torch.cat(results) for results in zip(*parts))
    return type(parts[0])((values.reshape(A.shape[:-1]), vectors.reshape(A.shape)))


def unique_rows(unique: Any, input: Any, sorted: bool = True, return_inverse: bool = False,
                return_counts: bool = False, dim: Any = None) -> Any:
    """What torch.unique returns; of integers along dim 0 without the merge sort that may fail on CUDA.

    With that of CUB (NVIDIA/cccl 5456) processes that share a GPU ended with cudaErrorIllegalAddress. In one dimension
    torch.unique has a radix sort. As in torch, rows are sorted whatever `sorted` says.
    """
    if dim != 0 or input.dim() == 0 or input.numel() == 0 or input.is_floating_point() or input.is_complex():
        return unique(input, sorted, return_inverse, return_counts, dim)
    inverse = torch.zeros(len(input), dtype=torch.int64, device=input.device)
    for column in input.reshape(len(input), -1).unbind(1):
        values, rank = unique(column, return_inverse=True)
        # Of the columns so far and this one. Both are ranks below N: no key reaches N^2, which fits int64 for N < 3e9.
        _, inverse, counts = unique(inverse * len(values) + rank, return_inverse=True, return_counts=True)
    rows = input.new_empty(len(counts), *input.shape[1:])
    rows[inverse] = input  # of rows that are equal any one
    results = (rows,) + (inverse,) * return_inverse + (counts,) * return_counts
    return results if len(results) > 1 else rows
