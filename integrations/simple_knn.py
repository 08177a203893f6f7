"""The API of simple_knn, of both kinds: distCUDA2 gives distances alone, or also which the neighbours are.

FSGS and its forks have the second kind. A call's file says which it is written for: there a result is unpacked.
"""
from __future__ import annotations

import ast
import functools
import sys
from pathlib import Path
from typing import Tuple, Union

import torch

from diff_smoe_rasterization import distCUDA2 as distances_of

__all__ = ["distCUDA2", "neighbours_of"]
CHUNK = 256  # points that are searched together


def distCUDA2(points: torch.Tensor) -> Union[torch.Tensor, Tuple[torch.Tensor, torch.Tensor]]:
    """Mean squared distance of each point [N, 3] to its three nearest others, [N].

    Called from a file that unpacks a result of it, it returns the neighbours' indices [N, 3] too, the nearest first.
    Raises TypeError where the file takes an element of a result and unpacks none: it may mean a result or a point.
    """
    distances = distances_of(points)
    file = sys._getframe(1).f_code.co_filename
    kinds = _uses_of(file)
    if kinds == {"element"}:
        raise TypeError(f"{file} takes an element of what distCUDA2 returns; it may be a point's distance, or all "
                        "distances, beside the neighbours' indices: install the simple_knn that it was written for")
    return (distances, neighbours_of(points, distances)) if "unpacked" in kinds else distances


def neighbours_of(points: torch.Tensor, distances: torch.Tensor) -> torch.Tensor:
    """Returns the indices [N, 3] int32 of the three nearest others, the nearest first.

    distances: of `distCUDA2`. They say how far away the third one can be, so only points in such a slice of the longest
    axis are looked at. Raises ValueError for fewer than four points.
    """
    points, count = points.detach(), len(points)
    if count < 4:
        raise ValueError(f"distCUDA2: {count} points have no three neighbours each")
    axis = int((points.amax(0) - points.amin(0)).argmax())
    along, order = points[:, axis].contiguous().sort()
    ordered, reach = points[order], (3 * distances[order]).sqrt() * (1 + 1e-5)  # of all rounding
    found = torch.empty(count, 3, dtype=torch.int32, device=points.device)
    for begin in range(0, count, CHUNK):
        own = slice(begin, begin + CHUNK)
        first = int(torch.searchsorted(along, (along[own] - reach[own]).amin()))
        last = int(torch.searchsorted(along, (along[own] + reach[own]).amax(), right=True))
        squared = (ordered[own, None] - ordered[None, first:last]).square().sum(2)
        rows = torch.arange(len(squared), device=points.device)
        squared[rows, rows + begin - first] = torch.inf
        found[order[own]] = order[first + squared.topk(3, largest=False).indices].int()
    return found


@functools.lru_cache(maxsize=None)
def _uses_of(file: str) -> frozenset:
    """What a file does with results of distCUDA2: "unpacked", or an "element" that is taken by a number."""
    try:
        nodes = list(ast.walk(ast.parse(Path(file).read_bytes())))
    except (OSError, SyntaxError):
        return frozenset()

    def is_call(node: ast.AST) -> bool:
        function = getattr(node, "func", None)
        return "distCUDA2" in (getattr(function, "id", ""), getattr(function, "attr", ""))

    def number(node: ast.Subscript) -> object:  # Python 3.8 has one node more around it
        index = getattr(node.slice, "value", None)
        return getattr(index, "value", index)

    unpacked = {"unpacked" for node in nodes if isinstance(node, ast.Assign) and is_call(node.value)
                and isinstance(node.targets[0], ast.Tuple)}
    return frozenset(unpacked | {"element" for node in nodes if isinstance(node, ast.Subscript) and is_call(node.value)
                                 and isinstance(number(node), int)})
