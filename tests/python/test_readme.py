"""The program of README.md runs as it stands."""
from __future__ import annotations

import re
from pathlib import Path

import torch

README = Path(__file__).resolve().parents[2] / "README.md"


def test_the_program_runs():
    program, = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    torch.manual_seed(0)
    variables = {}
    exec(program, variables)
    assert variables["color"].shape == (3, 240, 320) and variables["color"].max() > 0.1
    assert (variables["radii"] > 0).any() and variables["radii"].shape == (1000,)
    assert variables["means3D"].grad.any() and variables["means2D"].grad.any()
