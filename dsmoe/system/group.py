"""The processes of one training, and what they send each other. All of it is torch.distributed: NCCL or gloo."""
from __future__ import annotations

import contextlib
import datetime
import os
import re
import socket
import sys
import threading
import time
from typing import Callable, List, Optional, Sequence, Union

import torch
import torch.distributed

from ..errors import TrainerError
from .children import die_with_parent
from .heartbeat import Heartbeat

# Longer than a checkpoint of any size takes to write: the others wait meanwhile. A process that has died is noticed by
# torchrun, one that is stopped by Heartbeat.
TIMEOUT = datetime.timedelta(hours=2)
PATIENCE = 20.0  # seconds that the processes may take to meet without a word
OF_A_PROCESS = ("RANK", "WORLD_SIZE", "LOCAL_RANK")  # variables that torchrun sets for each
MOST_PROCESSES = 10**6


class Group:
    """Process `rank` of `size`. Every method is called by all processes, in the same order. Here: one process."""

    rank = 0
    size = 1

    @property
    def leads(self) -> bool:
        """Whether this process prints, evaluates and writes."""
        return self.rank == 0

    def gather_numbers(self, numbers: Union[Sequence[int], torch.Tensor], device: str) -> List[List[int]]:
        """The numbers, equally many, of every process. The host waits for its device.

        A tensor is int64, and on the device.
        """
        return [numbers.tolist() if isinstance(numbers, torch.Tensor) else list(numbers)]

    def exchange(self, rows: torch.Tensor, sent: Sequence[int], received: Sequence[int]) -> torch.Tensor:
        """Sends rows [sum(sent), ...] to the processes in rank order; returns the rows received, in the same order."""
        return self.begin_exchange(rows, sent, received)()

    def begin_exchange(self, rows: torch.Tensor, sent: Sequence[int], received: Sequence[int]
                       ) -> Callable[[], torch.Tensor]:
        """Begins an exchange, beside what the device does meanwhile. Returns what ends it, to be called once."""
        return lambda: rows

    def all_rows(self, rows: torch.Tensor, counts: Sequence[int]) -> torch.Tensor:
        """The rows of all processes, in their order. counts: how many each has."""
        return rows

    def of_first(self, rows: torch.Tensor) -> torch.Tensor:
        """The rows of the first process, in all; elsewhere their number may differ."""
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

    def gather_numbers(self, numbers: Union[Sequence[int], torch.Tensor], device: str) -> List[List[int]]:
        own = numbers if isinstance(numbers, torch.Tensor) else torch.tensor(
            list(numbers), dtype=torch.int64, device=device)
        every = own.new_empty((self.size, len(own)))
        torch.distributed.all_gather(list(every.unbind()), own)
        return every.tolist()

    def begin_exchange(self, rows: torch.Tensor, sent: Sequence[int], received: Sequence[int]
                       ) -> Callable[[], torch.Tensor]:
        if self.size == 1:
            return super().begin_exchange(rows, sent, received)
        out, dense = rows.new_empty((sum(received), *rows.shape[1:])), rows.contiguous()
        work = torch.distributed.all_to_all_single(out, dense, list(received), list(sent), async_op=True)

        def end(dense: torch.Tensor = dense) -> torch.Tensor:  # which must live until then
            work.wait()
            return out

        return end

    def all_rows(self, rows: torch.Tensor, counts: Sequence[int]) -> torch.Tensor:
        out = rows.new_empty((sum(counts), *rows.shape[1:]))
        parts = out.split(list(counts))
        parts[self.rank].copy_(rows)
        for rank, part in enumerate(parts):
            if len(part) > 0:
                torch.distributed.broadcast(part, rank)
        return out

    def of_first(self, rows: torch.Tensor) -> torch.Tensor:
        (count,) = self.gather_numbers([len(rows)], str(rows.device))[0]
        out = rows.contiguous() if self.leads else rows.new_empty((count, *rows.shape[1:]))
        if count > 0:
            torch.distributed.broadcast(out, 0)
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
    """Whether torchrun started this process, even if it is the only one.

    Raises TrainerError if its variables are there in part, or say what cannot be.
    """
    there = [name for name in OF_A_PROCESS if name in os.environ]
    if not there:  # MASTER_ADDR and MASTER_PORT may be set for all programs of a machine
        return False
    missing = [name for name in (*OF_A_PROCESS, "MASTER_ADDR", "MASTER_PORT") if name not in os.environ]
    if missing:
        raise TrainerError(f"{', '.join(there)} {'is' if len(there) == 1 else 'are'} set and {', '.join(missing)} not; "
                           f"torchrun sets all of them: start with it, or unset {', '.join(there)}")
    size = _number("WORLD_SIZE", 1, MOST_PROCESSES)
    _number("RANK", 0, size - 1, f": WORLD_SIZE is {size}")
    _number("LOCAL_RANK", 0, size - 1, f": WORLD_SIZE is {size}")
    _number("MASTER_PORT", 1, 2**16 - 1)
    return True


def _number(name: str, least: int, most: int, why: str = "") -> int:
    """What a variable of torchrun says. Raises TrainerError."""
    text = os.environ[name]
    number = int(text) if re.fullmatch(r"\d{1,9}", text, re.ASCII) else -1
    if not least <= number <= most:
        raise TrainerError(f"{name} is {text!r}; it must be a whole number from {least} to {most}{why}, as torchrun "
                           "sets it")
    return number


def join_group(device: str) -> Group:
    """The group of this process, which torchrun has started or nobody; on CUDA each takes the GPU of its local rank.

    Raises TrainerError if the host has fewer GPUs than torchrun has started processes there, and if the
    processes do not meet.
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
    where = f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
    do_not_meet = f"the processes of the training do not meet at {where} (MASTER_ADDR and MASTER_PORT): "
    _wait_for_name(os.environ["MASTER_ADDR"], do_not_meet)
    said = threading.Timer(PATIENCE, lambda: print(
        f"note: process {os.environ['RANK']} of {os.environ['WORLD_SIZE']} waits for the others at {where}",
        file=sys.stderr, flush=True))
    said.daemon = True
    said.start()
    try:
        torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo", timeout=TIMEOUT)
    except (RuntimeError, ValueError, OSError) as error:
        first = str(error).strip().partition("\n")[0]
        raise TrainerError(do_not_meet + first) from error
    finally:
        said.cancel()
    return DistributedGroup()


def _wait_for_name(name: str, do_not_meet: str) -> None:
    """Waits until the name of a host is known, as of a host that starts; torch would try for TIMEOUT.

    Raises TrainerError if it is not within PATIENCE. do_not_meet: the beginning of that error.
    """
    end = time.monotonic() + PATIENCE
    while True:
        try:
            socket.getaddrinfo(name, None)
            return
        except (OSError, UnicodeError) as error:
            if time.monotonic() > end:
                raise TrainerError(f"{do_not_meet}no host of the name {name!r} is known ({error})") from error
            time.sleep(min(1.0, PATIENCE))


def leave_group(group: Group) -> None:
    """Ends what `join_group` began."""
    if isinstance(group, DistributedGroup):
        group.closing.close()
        # gloo's threads need Python's lock to let go of the last tensors. In torch 2.4 destroy_process_group holds
        # that lock while it waits for these threads: for ever, but for this moment without it.
        time.sleep(0.2)
        torch.distributed.destroy_process_group()
