"""Large tensors of every step in memory that stays with the process."""
from __future__ import annotations

import ctypes

# glibc's parameters of mallopt(3) and the largest values that make sense here.
M_TRIM_THRESHOLD, TRIM_BYTES = -1, 1 << 30
M_MMAP_THRESHOLD, MMAP_BYTES = -3, 1 << 25  # glibc accepts no more


def keep_freed_memory() -> None:
    """Tells glibc to reuse freed memory instead of returning it to the system after every operation.

    A step frees and allocates the same tensors again, and fresh pages cost time. It holds for the whole process, so
    that commands call it and the library does not. Does nothing where the C library is another one.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    mallopt(M_MMAP_THRESHOLD, MMAP_BYTES)
    mallopt(M_TRIM_THRESHOLD, TRIM_BYTES)
