"""Checkpoints: everything that the rest of a run depends on, in one file that is whole or absent."""
from __future__ import annotations

import json
import os
import pickle
import zipfile
from typing import Any, Dict

import torch

from .errors import TrainerError
from .files import write_atomically

CHECKPOINT_NAME = "checkpoint.pt"
TENSOR = "__tensor__"  # marks where a tensor was
FORMAT = 2  # raised when the content changes so that older files cannot be resumed


def save_checkpoint(path: str, state: Dict[str, Any]) -> None:
    """Writes a state: tensors and plain values (those of json) in dictionaries and lists."""
    tensors: Dict[str, torch.Tensor] = {}
    # Plain values go as json text: torch 1.13 reads no float from a file without running code from it.
    text = json.dumps(_without_tensors(state, "", tensors))
    write_atomically(path, lambda file: torch.save({"format": FORMAT, "plain": text, "tensors": tensors}, file))


def load_checkpoint(path: str, device: str) -> Dict[str, Any]:
    """Reads what `save_checkpoint` wrote, tuples as lists, without running code from the file. Raises TrainerError."""
    if not os.path.isfile(path):
        raise TrainerError(f"{path}: no such checkpoint")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except (RuntimeError, OSError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        raise TrainerError(f"{path}: not a readable checkpoint ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise TrainerError(f"{path}: a checkpoint of another version; it cannot be resumed")
    return _with_tensors(json.loads(content["plain"]), content["tensors"])


def _without_tensors(value: Any, name: str, tensors: Dict[str, torch.Tensor]) -> Any:
    """The value with {TENSOR: name} in place of each tensor, which goes into `tensors`."""
    if isinstance(value, torch.Tensor):
        tensors[name] = value
        return {TENSOR: name}
    if isinstance(value, dict):
        return {key: _without_tensors(item, f"{name}/{key}", tensors) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_tensors(item, f"{name}/{index}", tensors) for index, item in enumerate(value)]
    return value


def _with_tensors(value: Any, tensors: Dict[str, torch.Tensor]) -> Any:
    """The inverse of `_without_tensors`."""
    if isinstance(value, dict):
        if TENSOR in value:
            return tensors[value[TENSOR]]
        return {key: _with_tensors(item, tensors) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_tensors(item, tensors) for item in value]
    return value
