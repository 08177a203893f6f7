"""A process that ends with the one that started it."""
from __future__ import annotations

import signal


def die_with_parent(end: int = signal.SIGTERM) -> None:
    """Sends this process the signal `end` when the one that started it has ended, in whatever way (Linux)."""
    import ctypes

    try:
        ctypes.CDLL(None).prctl(1, int(end), 0, 0, 0)  # 1 is PR_SET_PDEATHSIG
    except (AttributeError, OSError):
        pass
