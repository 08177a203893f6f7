"""What a command sets for the whole process of a training, and what its log gets of progress."""
from __future__ import annotations

import io
import threading
import time

import torch

from dsmoe.system import process, progress
from dsmoe.system.heartbeat import Heartbeat


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


def test_a_path_is_typed_so_that_a_shell_takes_it_for_one_and_the_command_for_no_option():
    assert [process.typed(path) for path in ("run", "-run", "a b", "-a b", "/-x")] == [
        "run", "./-run", "'a b'", "'./-a b'", "/-x"]


def test_a_bar_in_a_file_is_a_line_a_minute(monkeypatch):
    log, now = io.StringIO(), [0.0]
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    for leave in (False, True):
        for _ in progress.progress_bar(range(150), desc="images", mininterval=0, leave=leave):
            now[0] += 1
    lines = log.getvalue().splitlines()
    assert len(lines) == 4 and all(line.startswith("images: ") and "/150" in line for line in lines)


class Store:
    """Stands for torch.distributed's store: numbers by name. A process that is stopped adds nothing."""

    def __init__(self):
        self.numbers, self.lock, self.stopped = {}, threading.Lock(), ()

    def add(self, key, number):
        with self.lock:
            if not (number and key.endswith(self.stopped)):
                self.numbers[key] = self.numbers.get(key, 0) + number
            return self.numbers.get(key, 0)


def test_a_process_that_does_not_answer_is_named_and_one_that_answers_again(capsys):
    """By the first one that answers, which a stopped first process is not."""
    store, said = Store(), ""

    def wait_for(words):
        nonlocal said
        for _ in range(1000):
            said += capsys.readouterr().err
            if words in said:
                return
            time.sleep(0.01)
        raise AssertionError(f"{words} is not in {said}")

    with Heartbeat(store, 1, 3, 0.01, 0.5), Heartbeat(store, 2, 3, 0.01, 0.5):  # process 0 is stopped
        wait_for("process 0 of 3 has not answered for 0.5 s: stopped, or without a connection; the others wait\n")
        store.stopped = "2"
        wait_for("processes 0, 2 of 3 have not answered")
        store.stopped = ()
        with Heartbeat(store, 0, 3, 0.01, 0.5):
            wait_for("all processes answer again")
    assert said.count("\n") in (3, 4), "a line for each change; 0 and 2 need not answer again at once"
