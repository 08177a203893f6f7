"""The folder of the captures."""
from __future__ import annotations

import os

import pytest


def folder(name):
    """Path of a data set, or of a file beside them; skips the test if it is absent."""
    root = os.path.join(os.path.dirname(__file__), "..", "..")
    data = os.environ.get("DSMOE_DATA") or os.path.join(root, "..", "shared", "data")
    path = os.path.abspath(os.path.join(data, name))
    if not os.path.exists(path):
        pytest.skip(f"{path} is not there (set DSMOE_DATA to the folder of data sets)")
    return path
