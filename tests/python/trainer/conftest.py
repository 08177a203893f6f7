"""A tiny ray-traced scene on disk, once per test run, and what small tests are built from."""
from __future__ import annotations

import pytest
import torch

from diff_smoe_rasterization.trainer.config import TrainConfig
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
def tiny_config(tiny_scene, tmp_path):
    """40 steps in which everything happens: densification, both prunes, opacity resets, every SH degree."""
    return TrainConfig(
        scene=tiny_scene, output=str(tmp_path / "out"), blend_mode="smoe", iterations=40, sh_degree_interval=10,
        densify_from_iter=4, densify_until_iter=30, densification_interval=8, opacity_reset_interval=12,
        densify_grad_threshold=0.002, checkpoint_every=10,
    )
