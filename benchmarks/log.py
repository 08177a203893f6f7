"""What is quoted of the log of a process that ended."""
from __future__ import annotations

import re

PROGRESS_BAR = re.compile(r"\|.*\| \d+/\d+ \[")  # tqdm's
LONGEST = 300  # characters


def last_line(path: str) -> str:
    """The last line of a log that says something; a progress bar, drawn once more at the end, does not.

    Empty where nothing was printed.
    """
    with open(path, encoding="utf-8", errors="replace") as file:
        lines = [line.strip() for line in file.read().replace("\r", "\n").splitlines() if line.strip()]
    lines = [line for line in lines if not PROGRESS_BAR.search(line)] or lines
    return lines[-1][:LONGEST] if lines else ""
