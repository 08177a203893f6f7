"""Results do not depend on the number of threads, nor on the run: bit for bit, forward and backward."""
from __future__ import annotations

import pytest
import torch
from scenes import gradients, random_scene, with_gate

from diff_smoe_rasterization import rasterize
from diff_smoe_rasterization.settings import OUTPUTS


@pytest.fixture(autouse=True)
def restore_threads():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [700, 5000])
def test_threads_and_repetition_change_no_bit(mode, dtype, count):
    # Many small and some large splats over many tiles: every thread gets several tiles, every splat several threads.
    scene = random_scene(mode, count, 131, 83, scale=0.1, degree=1, dtype=dtype)
    results = []
    for threads in (1, 2, 3, 2, 1):
        torch.set_num_threads(threads)
        rendering, gradient = gradients(rasterize, scene, OUTPUTS)
        results.append([tensor.detach() for tensor in rendering] + list(gradient.values()))
    assert (results[0][1] > 0).sum() > count / 3
    for other in results[1:]:
        for first, second in zip(results[0], other):
            assert torch.equal(first, second)
