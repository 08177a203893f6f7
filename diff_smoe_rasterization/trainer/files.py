"""Files that are whole or absent: written beside their place, flushed to disk, then renamed."""
from __future__ import annotations

import contextlib
import errno
import json
import math
import os
from typing import Any, BinaryIO, Callable, Optional


def write_atomically(path: str, write: Callable[[BinaryIO], None]) -> None:
    """Calls `write` with an open binary file that becomes `path` only once it is complete.

    Where that fails, an earlier `path` stays as it was. Raises OSError, which names `path`.
    """
    folder = os.path.dirname(os.path.abspath(path))
    os.makedirs(folder, exist_ok=True)
    temporary = path + ".part"
    if os.path.lexists(temporary):  # of a killed run, or a link to another file, which stays
        os.remove(temporary)
    try:
        with open(temporary, "xb") as file:  # a new file: "x" follows no link
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        if not isinstance(error, FileExistsError):
            with contextlib.suppress(OSError):
                os.remove(temporary)
        failed = _system_error(error)
        if failed is None:
            raise
        raise OSError(failed.errno, failed.strerror or str(failed), path) from error


def _system_error(error: BaseException) -> Optional[OSError]:
    """The OSError that was the reason: torch.save raises RuntimeError where the disk is full."""
    if isinstance(error, OSError):
        return error
    if not isinstance(error, RuntimeError):
        return None
    if error.__context__ is not None:
        return _system_error(error.__context__)
    return OSError(errno.EIO, "could not be written whole") if "inline_container" in str(error) else None


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
