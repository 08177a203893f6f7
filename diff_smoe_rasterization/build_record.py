"""What the build wrote down, and the error if what it made does not load."""
from __future__ import annotations

import importlib
from typing import NoReturn, Optional

BUILD = "in the source folder type: pip install --no-build-isolation -e ."


def recorded(name: str) -> Optional[str]:
    """Returns what the build wrote down under this name, readable even if the extension cannot be loaded."""
    try:
        return getattr(importlib.import_module("._build_info", __package__), name, None)
    except ImportError:
        return None


def fail(reason: str, cause: Optional[BaseException] = None) -> NoReturn:
    """Raises the ImportError that says why this package does not work."""
    raise ImportError(f"diff_smoe_rasterization: {reason}") from cause
