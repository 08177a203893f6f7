"""The errors of a suite or a cell, and what a process that was watched said last."""
from __future__ import annotations

import re
from pathlib import Path

from ..errors import TrainerError

PROGRESS_BAR = re.compile(r"\|.*\| \d+/\d+ \[")  # tqdm's
LONGEST = 300  # characters of a log's last line


class BenchError(TrainerError):
    """A suite cannot be run, or a cell cannot be measured; the text says what and why, and is printed alone."""


def last_line(path: str) -> str:
    """The last line of a log that says something, which a progress bar does not; empty if nothing was printed."""
    text = Path(path).read_text(encoding="utf-8", errors="replace").replace("\r", "\n")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    lines = [line for line in lines if not PROGRESS_BAR.search(line)] or lines
    return lines[-1][:LONGEST] if lines else ""
