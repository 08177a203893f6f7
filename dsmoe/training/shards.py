"""Which of the Gaussians a process has, and what it must ask of the others. Alone, it has all."""
from __future__ import annotations

from typing import Callable, NamedTuple

import torch


class Route(NamedTuple):
    """Pairs of a Gaussian and a place, which takes something of it: what a process has of them."""

    origins: torch.Tensor  # own rows from which something goes, as often as it does
    places: torch.Tensor  # own rows to which something comes
    send: Callable[[torch.Tensor], torch.Tensor]  # from a row for each of `origins` to one for each of `places`


class Shards:
    """All Gaussians are in this process. distributed/shards.py has what holds if there are several.

    The Gaussians have the order of a training in one process; each process has a run of it.
    """

    def total(self, count: int) -> int:
        """How many Gaussians all processes have together, if this one has `count` and they are settled."""
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

    def settle(self, kinds: torch.Tensor) -> None:
        """Sorts the Gaussians by kind, stably, after some were added or removed, and divides them evenly.

        kinds: [N] int64, rising.
        """
