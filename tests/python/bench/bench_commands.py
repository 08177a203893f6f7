"""`dsmoe bench` as commands, and what they leave."""
from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import diff_smoe_rasterization

ABOVE = str(Path(diff_smoe_rasterization.__file__).resolve().parents[1])  # of the package under test, installed or not


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
