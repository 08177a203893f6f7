"""Files that are whole or absent, written beside their place, flushed and renamed; and whether one is there."""
from __future__ import annotations

import contextlib
import glob
import json
import math
import os
import secrets
import stat
import time
from typing import Any, BinaryIO, Callable, Iterator, Optional

from ..errors import TrainerError

PART = ".dsmoe_part-"  # begins the name of a file that is not whole yet; a random number and its name follow
ABANDONED = 6 * 3600  # seconds in which no process, of this host or another, leaves a file untouched that it writes


def is_file(path: str) -> bool:
    """Whether a file is there. Raises TrainerError if that cannot be seen, as in a folder that must not be read."""
    return stat.S_ISREG(_mode(path))


def is_folder(path: str) -> bool:
    """Whether a folder is there. Raises TrainerError if that cannot be seen."""
    return stat.S_ISDIR(_mode(path))


def _mode(path: str) -> int:
    try:
        return os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return 0
    except (OSError, ValueError) as error:
        raise TrainerError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error


class _PatientFile:
    """A file that notes its first error instead of raising: torch 1.13 ends the process if a write raises."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.error: Optional[OSError] = None

    def write(self, data: Any) -> int:
        try:
            if self.error is None:
                self.file.write(data)
        except OSError as error:
            self.error = error
        return memoryview(data).nbytes

    def flush(self) -> None:
        """Nothing: the file is flushed when it is whole."""


def check_output(path: str, overwrite: bool = True) -> None:
    """The rule for every file that a command writes: `path` is free, or a regular file that may be replaced.

    overwrite: whether it may. Links, pipes and devices never are. Raises TrainerError.
    """
    try:
        mode = os.lstat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    except (OSError, ValueError) as error:
        raise TrainerError(f"{path}: cannot be written ({getattr(error, 'strerror', error)})") from error
    if not stat.S_ISREG(mode):
        what = "a link" if stat.S_ISLNK(mode) else "a folder" if stat.S_ISDIR(mode) else "not a regular file"
        raise TrainerError(f"{path} is {what}, which is never replaced; move it, or choose another name with -o")
    if not overwrite:
        raise TrainerError(f"{path} is there already; --overwrite replaces it, or choose another name with -o")


def check_place(path: str, is_one_file: bool) -> None:
    """Raises TrainerError if the folder `path`, or the file, cannot be made: a command says so before it works for it.

    Of a file only its folder is looked at: `check_output` has the rest.
    """
    place = os.path.dirname(os.path.abspath(path)) if is_one_file else os.path.abspath(path)
    while not os.path.lexists(place):
        place = os.path.dirname(place)
    if not os.path.isdir(place):
        raise TrainerError(f"{path}: nothing can be written there: {place} is no folder; choose another name with -o")
    if not os.access(place, os.W_OK | os.X_OK):
        raise TrainerError(f"{path}: nothing can be written there: you may not write in {place}; choose another name "
                           "with -o")


@contextlib.contextmanager
def new_file(path: str, overwrite: bool = True) -> Iterator[str]:
    """Gives the name of a file to write beside `path`, with its ending; without an error it becomes `path`.

    No two processes get the same name. What one left that was killed long ago is removed. Raises OSError, which names
    `path`, and TrainerError as `check_output`, also if the file has come meanwhile.
    """
    check_output(path, overwrite)
    folder, name = os.path.split(os.path.abspath(path))
    os.makedirs(folder, exist_ok=True)
    remove_unfinished(folder, name)
    temporary = os.path.join(folder, f"{PART}{secrets.token_hex(8)}-{name}")
    try:
        yield temporary
        check_output(path, overwrite)
        os.replace(temporary, path)
    except OSError as error:
        named = error.filename is not None
        if error.errno is not None and (not named or os.fsdecode(error.filename) == temporary):
            raise OSError(error.errno, error.strerror, path) from error
        raise
    finally:
        _remove(temporary)


def remove_unfinished(folder: str, name: Optional[str] = None) -> None:
    """Removes what killed processes left in a folder: all files, or those with one name."""
    for left in glob.glob(os.path.join(glob.escape(folder), f"{PART}*-{glob.escape(name) if name else '*'}")):
        with contextlib.suppress(OSError):  # it may be gone by now
            if time.time() - os.lstat(left).st_mtime > ABANDONED:
                _remove(left)


def _remove(path: str) -> None:
    with contextlib.suppress(OSError):
        os.remove(path)


def write_atomically(path: str, write: Callable[[Any], None], overwrite: bool = True) -> None:
    """Calls `write` with an object that has `write` and `flush`; what it is given becomes `path` once it is complete.

    If that fails, an earlier `path` stays as it was. Raises OSError, which names `path`, and TrainerError as
    `check_output`.
    """
    try:
        with new_file(path, overwrite) as temporary, open(temporary, "xb") as file:  # a new file: "x" follows no link
            patient = _PatientFile(file)
            write(patient)
            if patient.error:
                raise patient.error
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), path) from error


def write_text_atomically(path: str, text: str) -> None:
    """Writes `text` as UTF-8."""
    write_atomically(path, lambda file: file.write(text.encode("utf-8")) and None)


def write_json_atomically(path: str, value: Any) -> None:
    """Writes `value` as indented json; what json has no number for, as the PSNR of equal images, becomes null."""
    write_text_atomically(path, json.dumps(_finite_or_null(value), indent=2, allow_nan=False) + "\n")


def _finite_or_null(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite_or_null(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite_or_null(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
