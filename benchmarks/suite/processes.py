"""Processes: one that ends with the one that started it, and what is quoted of the log of one that ended."""
from __future__ import annotations

import re
import signal

PROGRESS_BAR = re.compile(r"\|.*\| \d+/\d+ \[")  # tqdm's
LONGEST = 300  # characters


def die_with_parent(end: int = signal.SIGTERM) -> None:
    """Sends this process the signal `end` when the one that started it has ended, in whatever way (Linux)."""
    import ctypes

    try:
        ctypes.CDLL(None).prctl(1, int(end), 0, 0, 0)  # 1 is PR_SET_PDEATHSIG
    except (AttributeError, OSError):
        pass


def last_line(path: str) -> str:
    """The last line of a log that says something, which a progress bar does not; empty where nothing was printed."""
    with open(path, encoding="utf-8", errors="replace") as file:
        lines = [line.strip() for line in file.read().replace("\r", "\n").splitlines() if line.strip()]
    lines = [line for line in lines if not PROGRESS_BAR.search(line)] or lines
    return lines[-1][:LONGEST] if lines else ""
