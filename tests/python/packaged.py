"""What pyproject.toml installs."""
from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def packages_and_data():
    """Returns the names of the packages, and {package: [pattern, ...]} of their files that are not modules."""
    toml = pytest.importorskip("setuptools.config.pyprojecttoml")
    settings = toml.read_configuration(str(ROOT / "pyproject.toml"))["tool"]["setuptools"]
    return settings["packages"], settings["package-data"]
