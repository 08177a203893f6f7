"""Which device a command takes by itself, and that it says so first."""
from __future__ import annotations

import json
import os
import re

import pytest
import torch

from dsmoe.cli import main
from dsmoe.errors import TrainerError
from dsmoe.options.short_run import short_flags, train_command
from dsmoe.system import device, environment
from dsmoe.system.device import chosen_device, device_line, device_to_train_on


@pytest.fixture
def machine(monkeypatch):
    """Sets whether torch sees a GPU and what it is built with; the environment names no device."""
    monkeypatch.delenv("DSMOE_DEVICE")

    def has(gpu, built=True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
        monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a card")
        monkeypatch.setattr(device, "extension_info", lambda: {"cuda_built": built, "without_cuda_because": "no nvcc"})

    return has


def test_auto_is_the_gpu_where_it_can_be_used(machine, monkeypatch):
    machine(gpu=True)
    assert chosen_device() == chosen_device("auto") == "cuda" and device_line("cuda") == "device: cuda (a card)"
    assert chosen_device("cpu") == "cpu" and "the GPU is not used: the CPU was asked for" in device_line("cpu")
    monkeypatch.setenv("DSMOE_DEVICE", "cpu")
    assert chosen_device() == "cpu" and chosen_device("cuda") == "cuda"
    monkeypatch.setenv("DSMOE_DEVICE", "tpu")
    with pytest.raises(TrainerError, match="DSMOE_DEVICE is 'tpu'; it must be one of auto, cpu, cuda"):
        chosen_device()


def test_auto_is_the_cpu_elsewhere(machine):
    machine(gpu=True, built=False)
    assert chosen_device() == "cpu" and "the GPU is not used: this diff_smoe" in device_line("cpu")
    with pytest.raises(TrainerError, match="has no CUDA backend .no nvcc.; use --device cpu"):
        chosen_device("cuda")
    machine(gpu=False)
    assert chosen_device() == "cpu" and "GPU" not in device_line("cpu")
    with pytest.raises(TrainerError, match="torch finds no CUDA device"):
        chosen_device("cuda")


def test_a_build_that_is_to_come_counts_as_one_for_the_gpu_that_torch_sees(machine, monkeypatch):
    def not_built():
        raise ImportError

    for gpu, expected in ((True, "cuda"), (False, "cpu")):
        machine(gpu=gpu)
        monkeypatch.setattr(device, "extension_info", not_built)
        assert device_to_train_on() == expected


def test_what_to_type_has_the_short_options_on_a_processor():
    assert short_flags() == "--fast --resolution 4"
    for size, divisor in (((600, 400), ""), ((601, 400), " --resolution 2"), ((1600, 1200), " --resolution 4"),
                          ((4000, 3000), " --resolution 8"), ((9000, 6000), " --resolution 8")):
        assert short_flags(*size) == "--fast" + divisor
    assert train_command("my scene", "OUT", "cpu", 320, 240).endswith(" train 'my scene' -o OUT --fast")
    assert train_command("scene", "OUT", "cuda", 320, 240).endswith(" train scene -o OUT")


def test_commands_say_their_device_first(tiny_scene, tmp_path, capsys, monkeypatch):
    run, short = str(tmp_path / "run"), ["--iterations", "3", "--quiet"]
    for words in (["train", tiny_scene, "-o", run, *short], ["eval", run], ["render", run, "-o", str(tmp_path / "a")]):
        assert main(words) == 0
        assert capsys.readouterr().out.startswith(f"{device_line('cpu')}\n")
    with open(os.path.join(run, "config.json"), encoding="utf-8") as file:
        assert json.load(file)["device"] == "cpu", "the one that it was trained on"
    monkeypatch.setenv("DSMOE_DEVICE", "tpu")  # is not asked for if a run has its own
    assert main(["train", tiny_scene, "--resume", "-o", run, *short]) == 0
    assert main(["train", "--resume", "-o", run, "--device", "auto", "--quiet"]) == 0


@pytest.mark.parametrize("built, cards, words", [
    (False, ["a card"], "a card; NOT USED: this build has no kernels for it. DSMOE_BUILD_CUDA=1 pip install"),
    (True, ["a card"], "a card$"), (False, [], "none that torch can use$")])
def test_info_says_which_gpu_is_not_used(built, cards, words, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: len(cards))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: cards[index])
    monkeypatch.setattr(environment, "extension_info", lambda: {"cuda_built": built, "without_cuda_because": "no nvcc"})
    text = environment.describe()
    assert re.search(f"(?m)^GPU +{words}", text) and ("cpu; no cuda (no nvcc)" in text) != built
