"""Progress bars: drawn in place on a terminal; in a file, such as a job's log, a line a minute at most."""
from __future__ import annotations

import sys
import time
from typing import Any, TextIO

from tqdm import tqdm

SECONDS = 60.0  # between two lines


class _Lines:
    """Stands for a stream that is not a terminal: a line a minute of what a bar draws, the first after a minute.

    What takes less than a minute leaves nothing.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream, self.written = stream, time.monotonic()

    def write(self, text: str) -> None:
        if text.strip() and time.monotonic() - self.written >= SECONDS:
            self.written = time.monotonic()
            self.stream.write(text.strip() + "\n")

    def flush(self) -> None:
        self.stream.flush()


def progress_bar(*arguments: Any, **options: Any) -> tqdm[Any]:
    """A tqdm with these arguments, on stderr."""
    return tqdm(*arguments, file=sys.stderr if sys.stderr.isatty() else _Lines(sys.stderr), **options)
