"""Which of the Gaussians a process has, and what it must ask of the others. Alone, it has all."""
from __future__ import annotations

from typing import Callable

import torch


class Shards:
    """All Gaussians are in this process. distributed/shards.py has what holds where there are several.

    The Gaussians have one order, that of one process; each has a run of it.
    """

    def total(self, count: int) -> int:
        """How many things all processes have together."""
        return count

    def over_all(self, function: Callable[[torch.Tensor], torch.Tensor], values: torch.Tensor) -> torch.Tensor:
        """This process's rows of function(values of all processes), which keeps their number. values: [N, ...]."""
        return function(values)

    def draw(self, function: Callable[[int], torch.Tensor], count: int) -> torch.Tensor:
        """This process's part of what function(total) draws for all things: [K, total, ...] -> [K, count, ...]."""
        return function(count)

    def settle(self, kinds: torch.Tensor) -> None:
        """Puts the Gaussians in order once some were added or removed: by kind, within a kind as they lie.

        kinds: [N] int64, rising; and divides them evenly.
        """
