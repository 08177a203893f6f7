"""The Gaussians divided over the processes: each has a run of their one order, and all runs are equally long.

The order is that of a training by one process. So random numbers by index, ties of depth and checkpoints do not depend
on the number of processes.
"""
from __future__ import annotations

from typing import Any, Callable, Dict, List, Tuple

import torch

from ..model import GaussianModel
from ..optimizer import GaussianOptimizer
from ..system.group import Group
from ..training.shards import Route, Shards

KINDS = 4  # of Gaussians, at most, that a densification leaves


def run_of(rank: int, size: int, total: int) -> Tuple[int, int]:
    """The first Gaussian that a process has, and the one behind its last."""
    return total * rank // size, total * (rank + 1) // size


class DividedShards(Shards):
    """The runs of a group's processes."""

    def __init__(self, group: Group, model: GaussianModel, optimizer: GaussianOptimizer) -> None:
        """Leaves the model with this process's run of its Gaussians. It has all of them, without Adam's state."""
        self.group, self.model, self.optimizer = group, model, optimizer
        self.take({name: tensor.detach() for name, tensor in model.raw.items()})

    def take(self, raw: Dict[str, torch.Tensor]) -> None:
        """Takes this process's run of raw parameters of all Gaussians."""
        self.divide(len(raw["means3D"]))
        self.optimizer.replace_all({name: self.own_rows(tensor) for name, tensor in raw.items()})

    def divide(self, total: int) -> None:
        """From here on there are so many Gaussians; the caller sees to it that the model has its run of them."""
        self.counts = self._even_counts(total)

    def _even_counts(self, total: int) -> List[int]:
        runs = (run_of(rank, self.group.size, total) for rank in range(self.group.size))
        return [end - begin for begin, end in runs]

    def own_rows(self, rows: torch.Tensor) -> torch.Tensor:
        """This process's run of rows of all Gaussians, on the model's device."""
        own = rows[self.begin:self.begin + self.counts[self.group.rank]]
        return own.to(self.model.raw["means3D"].device, copy=True)  # a copy, so that the others' rows can go

    def whole(self, rows: torch.Tensor) -> Any:
        """The rows of all Gaussians in the first process; None elsewhere."""
        return self.group.rows_on_first(rows.detach(), self.counts)

    @property
    def num_gaussians(self) -> int:
        return sum(self.counts)

    @property
    def begin(self) -> int:
        """The first of this process's Gaussians."""
        return sum(self.counts[:self.group.rank])

    def total(self, count: int) -> int:
        return self.num_gaussians

    def _counts_of(self, count: int) -> List[int]:
        device = str(self.model.raw["means3D"].device)
        return [numbers[0] for numbers in self.group.gather_numbers([count], device)]

    def every(self, rows: torch.Tensor) -> torch.Tensor:
        return self.group.all_rows(rows, self.counts)

    def decide(self, function: Callable[..., torch.Tensor], *values: torch.Tensor) -> torch.Tensor:
        # All take the first process's result: on a GPU each may round a sum otherwise.
        return self.group.of_first(function(*map(self.every, values)))

    def route(self, origins: torch.Tensor, places: torch.Tensor) -> Route:
        rank, size = self.group.rank, self.group.size
        senders, receivers = self._owners(origins), self._owners(places)
        leaving, arriving = (senders == rank).nonzero().squeeze(1), (receivers == rank).nonzero().squeeze(1)
        leaving = leaving[receivers[leaving].sort(stable=True).indices]
        arriving = arriving[senders[arriving].sort(stable=True).indices]
        sent = torch.bincount(receivers[leaving], minlength=size).tolist()
        received = torch.bincount(senders[arriving], minlength=size).tolist()
        return Route(origins[leaving] - self.begin, places[arriving] - self.begin,
                     lambda rows: self.group.exchange(rows, sent, received))

    def _owners(self, rows: torch.Tensor) -> torch.Tensor:
        """The processes that have these rows of all Gaussians."""
        ends = torch.tensor(self.counts, device=rows.device).cumsum(0)
        return torch.bucketize(rows.contiguous(), ends, right=True)

    def draw(self, function: Callable[[int], torch.Tensor], count: int) -> torch.Tensor:
        counts = self._counts_of(count)
        begin = sum(counts[:self.group.rank])
        return function(sum(counts))[:, begin:begin + count]

    def settle(self, kinds: torch.Tensor) -> None:
        own = torch.bincount(kinds, minlength=KINDS)
        of_rank = torch.tensor(self.group.gather_numbers(own.tolist(), str(kinds.device)), device=kinds.device)
        # Where the Gaussians of each process and kind begin: the kinds one behind the other, in each the processes.
        by_kind = of_rank.t().reshape(-1)
        begins = (by_kind.cumsum(0) - by_kind).view(KINDS, -1)[:, self.group.rank]
        places = begins[kinds] + torch.arange(len(kinds), device=kinds.device) - (own.cumsum(0) - own)[kinds]
        self.counts = self._even_counts(int(of_rank.sum()))
        owners = self._owners(places)
        order = owners.sort(stable=True).indices
        sent = torch.bincount(owners, minlength=self.group.size).tolist()
        sent_by = self.group.gather_numbers(sent, str(kinds.device))
        received = [numbers[self.group.rank] for numbers in sent_by]
        arrived = self.group.exchange(places[order], sent, received).argsort()
        self.optimizer.rearrange(
            lambda rows: self.group.exchange(rows.index_select(0, order), sent, received).index_select(0, arrived))
