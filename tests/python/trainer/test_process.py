"""What a command sets for the whole process of a training, and what its log gets of progress."""
from __future__ import annotations

import io

import torch

from diff_smoe_rasterization.trainer.system import process, progress


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


def test_a_bar_in_a_file_is_a_line_a_minute(monkeypatch):
    log, now = io.StringIO(), [0.0]
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    for leave in (False, True):
        for _ in progress.progress_bar(range(150), desc="images", mininterval=0, leave=leave):
            now[0] += 1
    lines = log.getvalue().splitlines()
    assert len(lines) == 4 and all(line.startswith("images: ") and "/150" in line for line in lines)
