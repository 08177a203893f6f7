"""A tiny ray-traced scene on disk, once per test run: fixtures of the trainer's and the benchmark's tests."""
from __future__ import annotations

import pytest
import torch

from dsmoe.scenes.synthetic import write_synthetic_scene


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
