"""A suite that finishes in seconds."""
from __future__ import annotations

import importlib.util

import pytest
from tiny_scene import one_thread, tiny_scene  # noqa: F401

# Of modules that import what `pip install '.[bench]'` brings; ./check says where that cannot be had.
if not all(map(importlib.util.find_spec, ("yaml", "pydantic", "jinja2", "matplotlib"))):
    collect_ignore = [f"test_{name}.py" for name in ("cell", "checkout", "engine", "preparation", "report",
                                                     "report_curves", "report_page", "smoke", "suite")]


@pytest.fixture
def content(tiny_scene):
    """What a suite file says: two cells of twelve steps."""
    return {"name": "tiny", "protocol": {"iterations": 12, "device": "cpu", "principal_point": "scene", "lpips": [],
                                         "checkpoint_every": 4, "evaluate_every": 6,
                                         "options": {"densify_from_iter": 2, "densify_until_iter": 10,
                                                     "densification_interval": 4}},
            "scenes": [{"name": "tiny", "path": tiny_scene}], "methods": [{"name": "native"}],
            "blend_modes": ["alpha", "smoe"], "densify_grad_thresholds": [0.005]}
