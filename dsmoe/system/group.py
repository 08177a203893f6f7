"""The processes of one training, and what they send each other. All of it is torch.distributed: NCCL or gloo."""
from __future__ import annotations

import contextlib
import datetime
import os
import time
from typing import List, Optional, Sequence

import torch
import torch.distributed

from ..errors import TrainerError
from .children import die_with_parent
from .heartbeat import Heartbeat

# Longer than a checkpoint of any size takes to write: the others wait meanwhile. A process that has died is noticed by
# torchrun, one that is stopped by Heartbeat.
TIMEOUT = datetime.timedelta(hours=2)


class Group:
    """Process `rank` of `size`. Every method is called by all processes, in the same order. Here: one process."""

    rank = 0
    size = 1

    @property
    def leads(self) -> bool:
        """Whether this process prints, evaluates and writes."""
        return self.rank == 0

    def gather_numbers(self, numbers: Sequence[int], device: str) -> List[List[int]]:
        """The numbers, equally many, of every process. The host waits for its device."""
        return [list(numbers)]

    def exchange(self, rows: torch.Tensor, sent: Sequence[int], received: Sequence[int]) -> torch.Tensor:
        """Sends rows [sum(sent), ...] to the processes in rank order; returns the rows received, in the same order."""
        return rows

    def all_rows(self, rows: torch.Tensor, counts: Sequence[int]) -> torch.Tensor:
        """The rows of all processes, in their order. counts: how many each has."""
        return rows

    def rows_on_first(self, rows: torch.Tensor, counts: Sequence[int]) -> Optional[torch.Tensor]:
        """The rows of all processes in the memory of the first one's host; None elsewhere."""
        return rows

    def add_up(self, numbers: torch.Tensor) -> None:
        """Makes sums over the processes of the numbers, in place."""

    def gather_objects(self, value: object) -> List[object]:
        """The value of every process, in all of them."""
        return [value]


ALONE = Group()


class DistributedGroup(Group):
    """The processes of torch.distributed, which has been initialised."""

    def __init__(self) -> None:
        self.rank = torch.distributed.get_rank()
        self.size = torch.distributed.get_world_size()
        self.closing = contextlib.ExitStack()
        # Connections may be refused, as by a firewall: then nobody says who does not answer.
        with contextlib.suppress(RuntimeError, OSError, ValueError):
            store = torch.distributed.TCPStore(
                os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"]), is_master=False, wait_for_workers=False,
                timeout=datetime.timedelta(seconds=30))
            self.closing.enter_context(Heartbeat(store, self.rank, self.size))

    def gather_numbers(self, numbers: Sequence[int], device: str) -> List[List[int]]:
        own = torch.tensor(list(numbers), dtype=torch.int64, device=device)
        every = own.new_empty((self.size, len(own)))
        torch.distributed.all_gather(list(every.unbind()), own)
        return every.tolist()

    def exchange(self, rows: torch.Tensor, sent: Sequence[int], received: Sequence[int]) -> torch.Tensor:
        out = rows.new_empty((sum(received), *rows.shape[1:]))
        torch.distributed.all_to_all_single(out, rows.contiguous(), list(received), list(sent))
        return out

    def all_rows(self, rows: torch.Tensor, counts: Sequence[int]) -> torch.Tensor:
        out = rows.new_empty((sum(counts), *rows.shape[1:]))
        parts = out.split(list(counts))
        parts[self.rank].copy_(rows)
        for rank, part in enumerate(parts):
            if len(part) > 0:
                torch.distributed.broadcast(part, rank)
        return out

    def rows_on_first(self, rows: torch.Tensor, counts: Sequence[int]) -> Optional[torch.Tensor]:
        out = torch.empty((sum(counts) if self.leads else 0, *rows.shape[1:]), dtype=rows.dtype)
        parts = out.split(list(counts)) if self.leads else []
        for rank, count in enumerate(counts):  # one by one, so that the first process's device has one part at a time
            sent = [count if self.rank == rank and receiver == 0 else 0 for receiver in range(self.size)]
            received = [count if self.leads and sender == rank else 0 for sender in range(self.size)]
            arrived = self.exchange(rows if self.rank == rank else rows[:0], sent, received)
            if self.leads:
                parts[rank].copy_(arrived)
        return out if self.leads else None

    def add_up(self, numbers: torch.Tensor) -> None:
        torch.distributed.all_reduce(numbers)

    def gather_objects(self, value: object) -> List[object]:
        values: List[object] = [None] * self.size
        torch.distributed.all_gather_object(values, value)
        return values


def launched_by_torchrun() -> bool:
    """Whether torchrun started this process, even if it is the only one."""
    return {"RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR"} <= set(os.environ)


def join_group(device: str) -> Group:
    """The group of this process, which torchrun has started or nobody; on CUDA each takes the GPU of its local rank.

    Raises TrainerError where the host has fewer GPUs than torchrun has started processes there.
    """
    if not launched_by_torchrun():
        return ALONE
    if "TORCHELASTIC_RUN_ID" in os.environ:  # a torchrun that is killed ends nobody
        die_with_parent()
    if device == "cuda":
        place, gpus = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if place >= gpus:
            raise TrainerError(f"torchrun has started process {place} of this host, which has {gpus} GPUs; each "
                               "process needs one: --nproc-per-node must be at most that")
        torch.cuda.set_device(place)
    torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo", timeout=TIMEOUT)
    return DistributedGroup()


def leave_group(group: Group) -> None:
    """Ends what `join_group` began."""
    if isinstance(group, DistributedGroup):
        group.closing.close()
        # gloo's threads need Python's lock to let go of the last tensors. In torch 2.4 destroy_process_group holds
        # that lock while it waits for these threads: for ever, but for this moment without it.
        time.sleep(0.2)
        torch.distributed.destroy_process_group()
