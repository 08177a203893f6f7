"""The compiled core `_core`, or why it does not load: files, constants and the facts of the blend modes; no torch."""
from __future__ import annotations

import importlib
import os
from typing import Any

from .build_record import BUILD, fail


def _load() -> Any:
    try:
        return importlib.import_module("._core", __package__)
    except ModuleNotFoundError as error:
        if error.name != f"{__package__}._core":
            raise
        folder = os.path.dirname(os.path.abspath(__file__))
        fail(f"its extension _core is not built for this Python in {folder}; if that is the source of one that is "
             f"installed, go to another folder; to build it there, {BUILD}", error)
    except ImportError as error:
        fail(f"its extension _core does not load ({error}); build it again, {BUILD}", error)


_core = _load()
