"""Which of the Gaussians a process has, and what it must ask of the others. Alone, it has all."""
from __future__ import annotations

from typing import Callable, NamedTuple

import torch

BITS = 21  # of a coordinate: three of them fill an int64
SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
          (2, 0x1249249249249249))  # shifts and masks that move bit i of a number to bit 3 i


class Route(NamedTuple):
    """Pairs of a Gaussian and a place, which takes something of it: what a process has of them."""

    origins: torch.Tensor  # own rows from which something goes, as often as it does
    places: torch.Tensor  # own rows to which something comes
    send: Callable[[torch.Tensor], torch.Tensor]  # from a row for each of `origins` to one for each of `places`


def z_order(points: torch.Tensor) -> torch.Tensor:
    """Indices [N] of points [N, 3] along a Z-order curve (Morton 1966) through the box around them.

    A view shows runs of neighbours. So kernels read few cache lines of which they need only a part.
    """
    low, high = points.amin(0), points.amax(0)
    codes = ((points - low) / (high - low).clamp(min=1e-30) * (2**BITS - 1)).long()
    for shift, mask in SPREAD:
        codes = (codes | (codes << shift)) & mask
    x, y, z = codes.unbind(1)
    return (x | (y << 1) | (z << 2)).sort(stable=True).indices


class Shards:
    """All Gaussians are in this process. distributed/shards.py has what holds where there are several.

    The Gaussians have one order, that of one process; each has a run of it.
    """

    def total(self, count: int) -> int:
        """How many Gaussians all processes have together, where this one has `count` and they are settled."""
        return count

    def every(self, rows: torch.Tensor) -> torch.Tensor:
        """The rows of all Gaussians. rows: [N, ...] those of this process's."""
        return rows

    def own_rows(self, rows: torch.Tensor) -> torch.Tensor:
        """This process's rows of those of all Gaussians."""
        return rows

    def decide(self, function: Callable[..., torch.Tensor], *values: torch.Tensor) -> torch.Tensor:
        """function(values of all Gaussians), the same in all processes. values: [N, ...] of this process's Gaussians.

        The function may draw random numbers, as many in every process.
        """
        return function(*values)

    def route(self, origins: torch.Tensor, places: torch.Tensor) -> Route:
        """What this process has of pairs of an origin and a place. Both: [M] rows among all Gaussians; places differ.
        """
        return Route(origins, places, lambda rows: rows)

    def draw(self, function: Callable[[int], torch.Tensor], count: int) -> torch.Tensor:
        """This process's part of what function(total) draws for all things: [K, total, ...] -> [K, count, ...]."""
        return function(count)

    def arrange(self, rows: torch.Tensor, means: torch.Tensor) -> torch.Tensor:
        """In which order the rows [M] of Gaussians that stay are kept. means: [N, 3] of all Gaussians, world."""
        return rows[z_order(means.index_select(0, rows))] if len(rows) > 0 else rows

    def settle(self, kinds: torch.Tensor) -> None:
        """Puts the Gaussians in order once some were added or removed: by kind, within a kind as they lie.

        kinds: [N] int64, rising; and divides them evenly.
        """
