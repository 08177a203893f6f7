"""The errors a user can cause; the command prints their text and no traceback."""
from __future__ import annotations

import io
import os
import re
import sys
from typing import Optional


def printable(text: str) -> str:
    """The text on one line; what a terminal would obey or hide is written as its escape, such as \\x1b or \\n."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def print_any_name() -> None:
    """Lets this process print what its streams cannot encode, such as file names that are not UTF-8."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            is_utf = stream.encoding.lower().startswith("utf")
            stream.reconfigure(errors="surrogateescape" if is_utf else "backslashreplace")


class TrainerError(ValueError):
    """Something asked of the trainer cannot be done; the text says what and why, and is printable."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


class SceneError(TrainerError):
    """A scene folder cannot be used; the text names the file and the reason."""


class ConfigError(TrainerError):
    """An option, or a file of options, has a value that it must not have."""


def said_of(error: BaseException) -> str:
    """What an error of reading a file says, without the number that an OSError's text begins with."""
    return in_one_line(error) or str(error)


def in_one_line(error: BaseException) -> Optional[str]:
    """What a command prints of an error in place of a traceback; None if the error is not a user's."""
    if isinstance(error, OSError) and error.strerror:  # whose text begins with a number
        return printable(f"{os.fsdecode(error.filename)}: {error.strerror}" if error.filename else error.strerror)
    if isinstance(error, (TrainerError, ImportError, OSError)):
        return str(error)
    return out_of_memory(error)


def report(program: str, error: Exception, text: Optional[str]) -> int:
    """Prints what a program says of an error in place of a traceback; returns its exit status.

    Raises the error if the text is None, as of `in_one_line`.
    """
    if text is None:
        raise error
    print(f"{program}: error: {text}", file=sys.stderr)
    return 1


def out_of_memory(error: BaseException) -> Optional[str]:
    """Whose memory did not suffice, and for how much; None if the error is another one."""
    text = str(error)
    if not isinstance(error, MemoryError) and not (
            isinstance(error, RuntimeError) and re.search("out of memory|can't allocate memory|bad_alloc", text)):
        return None
    size = re.search(r"(?:tried to|unable to) allocate ([\d.]+ ?\w+)", text, re.IGNORECASE)
    return (f"the {'GPU' if 'CUDA' in text else 'machine'} is out of memory"
            f"{f', {size.group(1)} more were asked for' if size else ''}; "
            "take smaller images (--resolution) or fewer Gaussians (a higher --densify-grad-threshold)")


def is_lost(error: BaseException) -> bool:
    """Whether a collective failed because another process of the training has ended."""
    return isinstance(error, RuntimeError) and bool(re.search(
        "Connection closed by peer|Connection reset|Broken pipe|NCCL|gloo", str(error)))
