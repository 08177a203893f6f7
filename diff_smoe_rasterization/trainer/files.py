"""Files that are whole or absent, written beside their place, flushed and renamed; and whether one is there."""
from __future__ import annotations

import json
import math
import os
import stat
from typing import Any, BinaryIO, Callable

from .errors import TrainerError


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


def write_atomically(path: str, write: Callable[[BinaryIO], None]) -> None:
    """Calls `write` with an open binary file that becomes `path` only once it is complete."""
    folder = os.path.dirname(os.path.abspath(path))
    os.makedirs(folder, exist_ok=True)
    temporary = path + ".part"
    with open(temporary, "wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


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
