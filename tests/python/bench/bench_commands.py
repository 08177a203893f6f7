"""`dsmoe bench` as commands, and what they leave."""
from __future__ import annotations

import json
import sys
import time
from pathlib import Path


def command(*words):
    return [sys.executable, "-m", "diff_smoe_rasterization", *words]


def rows_of(results):
    """{cell: row} of RESULTS/rows.jsonl."""
    lines = (Path(results) / "rows.jsonl").read_text().splitlines()
    return {row["cell"]: row for row in map(json.loads, lines)}


def wait_for(condition, seconds):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "waited too long"
        time.sleep(0.05)
