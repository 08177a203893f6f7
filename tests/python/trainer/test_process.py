"""What a command sets for the whole process of a training."""
from __future__ import annotations

import torch

from diff_smoe_rasterization.trainer.process import set_up_process


def test_a_training_on_a_gpu_has_one_thread_of_the_host_and_one_on_the_cpu_has_all():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        set_up_process("cpu")
        assert torch.get_num_threads() == 2
        set_up_process("cuda")
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)
