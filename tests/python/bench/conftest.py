"""A tiny ray-traced scene, and a suite over it that finishes in seconds."""
from __future__ import annotations

import pytest
import torch

from diff_smoe_rasterization.trainer.synthetic import write_synthetic_scene


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Tensors are so small here that torch's threads would only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory):
    """A COLMAP folder: 9 views of 32x24 pixels (7 to train, 2 to test), about 150 points."""
    folder = tmp_path_factory.mktemp("scene")
    write_synthetic_scene(str(folder), views=9, width=32, height=24, points=150, supersampling=1)
    return str(folder)


@pytest.fixture
def content(tiny_scene):
    """What a suite file says: two cells of twelve steps."""
    return {"name": "tiny", "protocol": {"iterations": 12, "device": "cpu", "principal_point": "scene", "lpips": [],
                                         "checkpoint_every": 4, "evaluate_every": 6,
                                         "options": {"densify_from_iter": 2, "densify_until_iter": 10,
                                                     "densification_interval": 4}},
            "scenes": [{"name": "tiny", "path": tiny_scene}], "methods": [{"name": "native"}],
            "blend_modes": ["alpha", "smoe"], "densify_grad_thresholds": [0.005]}
