"""Tests that only a GPU can run; they are skipped, saying so, if there is none."""
from __future__ import annotations

import pytest
import torch
from devices import without_cuda_because


@pytest.fixture
def gpu(request):
    """The device under test. Unlike `device` it is not the default: these tests hold tensors on several devices."""
    reason = without_cuda_because()
    if reason or request.config.getoption("--device") == "cpu":
        pytest.skip(f"without CUDA: {reason or '--device cpu'}")
    return torch.device("cuda")
