"""What holds for the whole process of a training: commands set it, the library does not."""
from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch  # which takes seconds to load: the command line takes names from here

# glibc's parameters of mallopt(3) and the largest values that make sense here.
M_TRIM_THRESHOLD, TRIM_BYTES = -1, 1 << 30
M_MMAP_THRESHOLD, MMAP_BYTES = -3, 1 << 25  # glibc accepts no more

SPARE_BYTES = 4 << 30  # GPU memory that torch may keep beyond twice what the run has needed


def set_up_process(device: str) -> None:
    """Readies the process for a training on the device, "cpu" or "cuda": its memory, and how many threads torch has.

    On a GPU that is one: the host only launches kernels, and several runs may share its cores.
    """
    keep_freed_memory()
    if device == "cuda":
        import torch

        torch.set_num_threads(1)


def command() -> str:
    """What to type for `dsmoe`, of the environment that this process runs in."""
    script = os.path.join(os.path.dirname(sys.executable), "dsmoe")
    if not os.path.isfile(script):
        return f"{shlex.quote(sys.executable)} -m {__name__.partition('.')[0]}"
    return _shortest(script)


def typed(path: str) -> str:
    """How a path is typed in a shell, where it is to be no option."""
    return shlex.quote(os.path.join(os.curdir, path) if path.startswith("-") else path)


def pip_install(*packages: str) -> str:
    """What to type to bring packages into the environment that this process runs in."""
    pip = os.path.join(os.path.dirname(sys.executable), "pip")
    program = _shortest(pip) if os.path.isfile(pip) else f"{shlex.quote(sys.executable)} -m pip"
    return f"{program} install {' '.join(packages)}"


def _shortest(script: str) -> str:
    """The shortest that a shell finds it by: its name, its path from the current folder, or its whole path."""
    if shutil.which(os.path.basename(script)) == script:
        return os.path.basename(script)
    return shlex.quote(min(script, os.path.relpath(script), key=len))


def return_spare_memory(device: torch.device) -> None:
    """Returns the GPU memory that torch keeps for later to the driver, if that is much.

    To be called when all arrays have changed their sizes: blocks of the sizes before seldom fit again, and torch would
    keep them until the card is full. It costs time, so it waits until much has gathered.
    """
    if device.type != "cuda":
        return
    import torch

    stats = torch.cuda.memory_stats(device)
    if stats["reserved_bytes.all.current"] > 2 * stats["allocated_bytes.all.peak"] + SPARE_BYTES:
        torch.cuda.empty_cache()


def keep_freed_memory() -> None:
    """Tells glibc to reuse freed memory instead of returning it to the system after every operation.

    A step frees and allocates the same tensors again, and fresh pages cost time. Does nothing if the C library is
    another one.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    mallopt(M_MMAP_THRESHOLD, MMAP_BYTES)
    mallopt(M_TRIM_THRESHOLD, TRIM_BYTES)
