"""What a command sets for the whole process of a training."""
from __future__ import annotations

import torch

from diff_smoe_rasterization.trainer import process


def test_a_training_on_a_gpu_has_one_thread_of_the_host_and_one_on_the_cpu_has_all(monkeypatch):
    called = []
    monkeypatch.setattr(process, "keep_freed_memory", lambda: called.append(True))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        process.set_up_process("cpu")
        assert torch.get_num_threads() == 2
        process.set_up_process("cuda")
        assert torch.get_num_threads() == 1
        assert len(called) == 2
    finally:
        torch.set_num_threads(before)
