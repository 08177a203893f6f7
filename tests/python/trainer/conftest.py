"""What small tests of the trainer are built from."""
from __future__ import annotations

import pytest
from tiny_scene import one_thread, tiny_scene  # noqa: F401

from dsmoe.options.config import TrainConfig


@pytest.fixture
def tiny_config(tiny_scene, tmp_path):
    """40 steps in which everything happens: densification, both prunes, opacity resets, every SH degree."""
    return TrainConfig(
        scene=tiny_scene, output=str(tmp_path / "out"), blend_mode="smoe", iterations=40, sh_degree_interval=10,
        densify_from_iter=4, densify_until_iter=30, densification_interval=8, opacity_reset_interval=12,
        densify_grad_threshold=0.002, checkpoint_every=10,
    )
