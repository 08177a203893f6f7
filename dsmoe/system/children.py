"""Child processes that end with the process that has started them. It loads no torch."""
from __future__ import annotations

import contextlib
import ctypes
import signal

PR_SET_PDEATHSIG = 1  # of prctl(2)


def die_with_parent(end: int = signal.SIGTERM) -> None:
    """Sends this process the signal `end` when the one that started it has ended, in whatever way (Linux).

    For the new process itself: as the preexec_fn of subprocess, or first thing in its main. If `end` has a handler,
    that handles it.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(end), 0, 0, 0)
