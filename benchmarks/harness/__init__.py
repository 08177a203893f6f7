"""`dsmoe bench`: a suite is expanded to cells, a cell is trained and measured to a row, rows become a report."""
from __future__ import annotations

import importlib.util

# The extra `bench` of pyproject.toml.
PACKAGES = ("'snakemake>=8'", "pyyaml", "'pydantic>=2'", "torchmetrics", "matplotlib", "jinja2")


def require(*libraries: str) -> None:
    """Raises ImportError, which says what to type, if one of these libraries is not installed."""
    missing = [name for name in libraries if importlib.util.find_spec(name) is None]
    if missing:
        from ..system.process import pip_install  # it loads torch

        raise ImportError(f"dsmoe bench needs {', '.join(missing)}: {pip_install(*PACKAGES)}"
                          + (" (Snakemake needs Python 3.11 or later)" if "snakemake" in missing else ""))
