"""Fixtures of all tests: the five blend modes, the devices, and an environment that selects no mode.

A test that uses the fixture `device` runs once on the CPU and, if there is a GPU and a build for it, once there.
"""
from __future__ import annotations

import os

import pytest
import torch
from devices import without_cuda_because

from diff_smoe_rasterization.settings import BLEND_MODES
from dsmoe.results import scalars


def pytest_addoption(parser):
    parser.addoption("--device", choices=("all", "cpu", "cuda"), default="all",
                     help="where the tests of the rasterizer run; all: on the CPU, and on a GPU where there is one")


def pytest_configure(config):
    os.environ["DSMOE_DEVICE"] = "cpu"  # what commands take by themselves, also on a machine with a GPU
    if config.getoption("--device") == "cuda" and without_cuda_because():
        raise pytest.UsageError(f"--device cuda: {without_cuda_because()}")


def chosen_devices(config):
    choice, reason = config.getoption("--device"), without_cuda_because()
    if choice == "all":
        return ["cpu"] if reason else ["cpu", "cuda"]
    return [choice]


def pytest_terminal_summary(terminalreporter, config):
    """Says on which devices the rasterizer was tested; under -q too, which hides headers."""
    devices, reason = chosen_devices(config), without_cuda_because()
    line = "rasterizer tested on: " + ", ".join(
        device if device == "cpu" else f"cuda ({torch.cuda.get_device_name()})" for device in devices)
    if "cuda" not in devices:
        line += f"; CUDA IS LEFT OUT: {reason or '--device cpu'}"
    terminalreporter.write_line(line)


def pytest_generate_tests(metafunc):
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", chosen_devices(metafunc.config), indirect=True)


@pytest.fixture
def device(request):
    """The device under test, which is torch's default device meanwhile: what a test makes lies there."""
    if request.param == "cpu":
        yield torch.device("cpu")
        return
    torch.set_default_device(request.param)
    yield torch.device(request.param)
    torch.set_default_device(None)


@pytest.fixture(params=BLEND_MODES)
def mode(request):
    return request.param


@pytest.fixture(autouse=True)
def no_blend_mode_in_the_environment(monkeypatch):
    for name in ("DSMOE_BLEND_MODE", "DSMOE_BACKGROUND_GATE"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(autouse=True)
def no_tensorboard(monkeypatch):
    """Trainings leave the same files whether tensorboard is installed or not, and need no seconds to load it."""
    monkeypatch.setattr(scalars, "is_installed", lambda: False)
