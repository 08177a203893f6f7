"""Files that are whole or absent: written beside their place, flushed to disk, then renamed."""
from __future__ import annotations

import json
import os
from typing import Any, BinaryIO, Callable


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
    """Writes `value` as indented json."""
    write_text_atomically(path, json.dumps(value, indent=2) + "\n")
