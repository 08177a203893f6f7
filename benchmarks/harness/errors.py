"""The errors that a suite or a cell may raise; the command prints their text and no traceback."""
from __future__ import annotations

from ..errors import TrainerError


class BenchError(TrainerError):
    """A suite cannot be run, or a cell cannot be measured; the text says what and why."""
