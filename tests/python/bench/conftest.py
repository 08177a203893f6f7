"""A suite that finishes in seconds."""
from __future__ import annotations

import pytest
from tiny_scene import one_thread, tiny_scene  # noqa: F401


@pytest.fixture
def content(tiny_scene):
    """What a suite file says: two cells of twelve steps."""
    return {"name": "tiny", "protocol": {"iterations": 12, "device": "cpu", "principal_point": "scene", "lpips": [],
                                         "checkpoint_every": 4, "evaluate_every": 6,
                                         "options": {"densify_from_iter": 2, "densify_until_iter": 10,
                                                     "densification_interval": 4}},
            "scenes": [{"name": "tiny", "path": tiny_scene}], "methods": [{"name": "native"}],
            "blend_modes": ["alpha", "smoe"], "densify_grad_thresholds": [0.005]}
