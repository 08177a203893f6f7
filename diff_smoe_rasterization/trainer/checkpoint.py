"""Checkpoints: everything that the rest of a run depends on, in one file that is whole or absent."""
from __future__ import annotations

import os
import pickle
import zipfile
from typing import Any, Dict

import torch

from .errors import TrainerError
from .files import write_atomically

CHECKPOINT_NAME = "checkpoint.pt"
FORMAT = 1  # raised when the content changes so that older files cannot be resumed


def save_checkpoint(path: str, state: Dict[str, Any]) -> None:
    """Writes a state of tensors and plain values."""
    write_atomically(path, lambda file: torch.save({"format": FORMAT, **state}, file))


def load_checkpoint(path: str, device: str) -> Dict[str, Any]:
    """Reads what `save_checkpoint` wrote, without running code from the file. Raises TrainerError."""
    if not os.path.isfile(path):
        raise TrainerError(f"{path}: no such checkpoint")
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except (RuntimeError, OSError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        raise TrainerError(f"{path}: not a readable checkpoint ({error})") from error
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise TrainerError(f"{path}: a checkpoint of another version; it cannot be resumed")
    return state
