"""The small trainer of the patches' tests."""
from __future__ import annotations

import importlib
import sys
from pathlib import Path

PATCHES = Path(__file__).resolve().parents[1] / "patches"


def small_trainers():
    """The module that makes checkouts of it."""
    sys.path.insert(0, str(PATCHES))
    try:
        return importlib.import_module("checkouts")
    finally:
        sys.path.remove(str(PATCHES))
