"""A small suite, `dsmoe bench` as commands, and what they leave."""
import json
import sys
import time
from pathlib import Path

COMMAND = [sys.executable, "-m", "dsmoe", "bench"]


def tiny_suite(scene):
    """What a suite file says: two cells of twelve steps, done in seconds."""
    return {"name": "tiny", "protocol": {"iterations": 12, "device": "cpu", "principal_point": "scene", "lpips": [],
                                         "checkpoint_every": 4, "evaluate_every": 6,
                                         "options": {"densify_from_iter": 2, "densify_until_iter": 10,
                                                     "densification_interval": 4}},
            "scenes": [{"name": "tiny", "path": scene}], "methods": [{"name": "native"}],
            "blend_modes": ["alpha", "smoe"], "densify_grad_thresholds": [0.005]}


def python_that(says, folder):
    """A shell script that stands for Python; returns its path."""
    script = Path(folder) / "python"
    script.write_text("#!/bin/sh\n" + says)
    script.chmod(0o755)
    return str(script)


def rows_of(results):
    """{cell: row} of RESULTS/rows.jsonl."""
    lines = (Path(results) / "rows.jsonl").read_text().splitlines()
    return {row["cell"]: row for row in map(json.loads, lines)}


def wait_for(condition, seconds):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "waited too long"
        time.sleep(0.05)
