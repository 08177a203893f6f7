"""The API of simple_knn, of both kinds: distCUDA2 gives distances, and on request the neighbours' indices.

FSGS and its forks have the second kind. A call's file says which it is written for: there a result is unpacked.
"""
from __future__ import annotations

import ast
import functools
import math
import sys
from pathlib import Path
from typing import Tuple, Union

import torch

from diff_smoe_rasterization import distCUDA2 as distances_of

__all__ = ["distCUDA2", "neighbours_of"]
CHUNK = 64  # points that are searched together


def distCUDA2(points: torch.Tensor) -> Union[torch.Tensor, Tuple[torch.Tensor, torch.Tensor]]:
    """Mean squared distance of each point [N, 3] to its three nearest others, [N].

    Called from a file that unpacks a result of it, it returns the neighbours' indices [N, 3] too, the nearest first.
    Raises TypeError if the file takes an element of a result and unpacks none: it may mean a result or a point.
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

    distances: of `distCUDA2`. They say how far away the third one can be, so only points in such a box are looked at.
    Raises ValueError for fewer than four points.
    """
    points, count = points.detach(), len(points)
    if count < 4:
        raise ValueError(f"distCUDA2: {count} points have no three neighbours each")
    every = torch.arange(count, device=points.device)
    cells, order = 1, every
    for axis in range(3):  # cells of equal numbers of points: slabs along x, in each columns along y, then along z
        order = _sorted_within(order, points[:, axis], every * cells // count)
        cells *= math.ceil((count / CHUNK) ** (1 / 3))
    ordered, reach = points[order], (3 * distances[order]).sqrt() * (1 + 1e-5)  # of all rounding
    found = torch.empty(count, 3, dtype=torch.int32, device=points.device)
    for own in every.split(CHUNK):
        chunk, most = ordered[own], reach[own].amax()
        near = ((ordered >= chunk.amin(0) - most) & (ordered <= chunk.amax(0) + most)).all(1).nonzero()[:, 0]
        squared = (chunk[:, None] - ordered[near]).square().sum(2).masked_fill_(near == own[:, None], torch.inf)
        found[order[own]] = order[near[squared.topk(3, largest=False).indices]].int()
    return found


def _sorted_within(order: torch.Tensor, values: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    """Returns the order sorted by values in each cell of it; cells ascend."""
    by_value = values[order].argsort(stable=True)
    return order[by_value[cells[by_value].argsort(stable=True)]]


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
