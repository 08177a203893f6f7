"""Time that can be paused, synchronised with the device."""
from __future__ import annotations

import time

import torch


def synchronised_time(device: str) -> float:
    """Seconds, after all work queued on the device is done."""
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter()


class Stopwatch:
    """Sums the seconds between `start` and `stop`."""

    def __init__(self, device: str, seconds: float = 0.0) -> None:
        self.device = device
        self.seconds = seconds
        self._started = 0.0

    def start(self) -> None:
        self._started = synchronised_time(self.device)

    def stop(self) -> None:
        self.seconds += synchronised_time(self.device) - self._started
