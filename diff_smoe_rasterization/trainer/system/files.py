"""Files that are whole or absent, written beside their place, flushed and renamed; and whether one is there."""
from __future__ import annotations

import contextlib
import json
import math
import os
import stat
from typing import Any, BinaryIO, Callable, Optional

from ..errors import TrainerError


def is_file(path: str) -> bool:
    """Whether a file is there. Raises TrainerError where that cannot be seen, as in a folder that must not be read."""
    return stat.S_ISREG(_mode(path))


def is_folder(path: str) -> bool:
    """Whether a folder is there. Raises TrainerError where that cannot be seen."""
    return stat.S_ISDIR(_mode(path))


def _mode(path: str) -> int:
    try:
        return os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return 0
    except (OSError, ValueError) as error:
        raise TrainerError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error


class _PatientFile:
    """A file that notes its first error instead of raising: torch 1.13 ends the process where a write raises."""

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


def write_atomically(path: str, write: Callable[[Any], None]) -> None:
    """Calls `write` with an object that has `write` and `flush`; what it is given becomes `path` once it is complete.

    Where that fails, an earlier `path` stays as it was. Raises OSError, which names `path`.
    """
    folder = os.path.dirname(os.path.abspath(path))
    os.makedirs(folder, exist_ok=True)
    temporary = path + ".part"
    if os.path.lexists(temporary):  # of a killed run, or a link to another file, which stays
        os.remove(temporary)
    try:
        with open(temporary, "xb") as file:  # a new file: "x" follows no link
            patient = _PatientFile(file)
            write(patient)
            if patient.error:
                raise patient.error
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        if not isinstance(error, FileExistsError):
            with contextlib.suppress(OSError):
                os.remove(temporary)
        if not isinstance(error, OSError):
            raise
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
