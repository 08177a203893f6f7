"""`dsmoe bench`: a suite is expanded to cells, a cell is trained and measured to a row, rows become a report."""
from __future__ import annotations

import importlib.util


def require(*libraries: str) -> None:
    """Raises ImportError, which says what to type, where one of these libraries is not installed."""
    for name in libraries:
        if importlib.util.find_spec(name) is None:
            raise ImportError(f"{name} is not installed; pip install '.[bench]' in the source folder brings it"
                              + (" (it needs Python 3.11 or later)" if name == "snakemake" else ""))
