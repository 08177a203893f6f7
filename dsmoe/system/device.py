"""The device that a command computes on: the one that is asked for, or by itself the GPU if it can be used."""
from __future__ import annotations

from typing import Optional

import torch

from ..errors import TrainerError
from ..options.choices import asked_device
from .environment import extension_info, machine


def check_device(device: str) -> None:
    """Raises TrainerError if this machine or this build cannot train on the device."""
    if device == "cpu":
        return
    reason = why_no_gpu()
    if reason:
        raise TrainerError(f"--device cuda: {reason}; use --device cpu")


def why_no_gpu() -> Optional[str]:
    """Why this machine or this build cannot compute on a GPU; None if it can."""
    if not torch.cuda.is_available():
        return "torch finds no CUDA device on this machine"
    info = extension_info()
    if not info.get("cuda_built"):
        reason = info.get("without_cuda_because") or "it was built without CUDA"
        return f"this diff_smoe_rasterization has no CUDA backend ({reason})"
    return None


def chosen_device(asked: Optional[str] = None) -> str:
    """The device for --device: `auto`, which None is too, is $DSMOE_DEVICE, else the GPU if it can be used.

    Raises TrainerError if the device that is asked for is none, or cannot be used.
    """
    device, _ = asked_device(asked)
    if device == "auto":
        return "cpu" if why_no_gpu() else "cuda"
    check_device(device)
    return device


def device_to_train_on() -> str:
    """`chosen_device()`, also if nothing is compiled yet: a build for the GPU that torch sees is then to come."""
    try:
        return chosen_device()
    except ImportError:
        return "cuda" if torch.cuda.is_available() else "cpu"


def device_line(device: str) -> str:
    """What a command says first: where it computes, and why a GPU that torch sees is not used."""
    line = f"device: {device} ({machine(device)})"
    if device == "cpu" and torch.cuda.is_available():
        line += f"; the GPU is not used: {why_no_gpu() or 'the CPU was asked for'}"
    return line
