"""`dsmoe bench` as commands, and what they leave; the small trainer of the patches' tests."""
from __future__ import annotations

import importlib
import json
import os
import sys
import time
from pathlib import Path

import pytest

import diff_smoe_rasterization

ABOVE = str(Path(diff_smoe_rasterization.__file__).resolve().parents[1])  # of the package under test, installed or not
PATCHES = Path(__file__).resolve().parents[1] / "patches"


def command(*words):
    return [sys.executable, "-m", "diff_smoe_rasterization", *words]


def environment(**more):
    """Of processes that find that package from any folder."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [ABOVE, os.environ.get("PYTHONPATH", "")])),
            "OMP_NUM_THREADS": "1", **more}


def rows_of(results):
    """{cell: row} of RESULTS/rows.jsonl."""
    lines = (Path(results) / "rows.jsonl").read_text().splitlines()
    return {row["cell"]: row for row in map(json.loads, lines)}


def wait_for(condition, seconds):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "waited too long"
        time.sleep(0.05)


def small_trainers():
    """The module that makes checkouts of it."""
    pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")
    sys.path.insert(0, str(PATCHES))
    try:
        return importlib.import_module("checkouts")
    finally:
        sys.path.remove(str(PATCHES))
