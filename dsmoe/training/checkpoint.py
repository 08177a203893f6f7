"""Checkpoints: everything that the rest of a run depends on, in one file that is whole or absent."""
from __future__ import annotations

import contextlib
import json
import os
import zipfile
from typing import Any, Dict, Iterator, NamedTuple

import torch

from ..errors import TrainerError, out_of_memory
from ..model import GaussianModel
from ..options.config import CHECKPOINT_NAME, TrainConfig
from ..system.files import write_atomically
from .gate import LearnedGate
from .state_check import Misfit, check_model, check_numbers

TENSOR = "__tensor__"  # stands for a tensor
# Before torch 2.6 a file can get around weights_only=True (CVE-2025-32434).
SAFE_LOAD = tuple(int(part) for part in torch.__version__.split(".")[:2]) >= (2, 6)
FORMAT = 7  # raised when the content changes so that older files cannot be resumed


class SoFar(NamedTuple):
    """What a training has made until its checkpoint."""

    path: str
    model: GaussianModel
    background_gate: float
    iteration: int
    seconds: float  # of training


def made_so_far(config: TrainConfig, device: str) -> SoFar:
    """Reads the checkpoint of the run that config is of. Raises TrainerError, also if it is another run's."""
    path = os.path.join(config.output, CHECKPOINT_NAME)
    state = load_checkpoint(path, device)
    with damage_named(path):
        there = TrainConfig.of_record(state["config"])
        for name in ("blend_mode", "background_gate", "sh_degree"):
            mine, theirs = getattr(config, name), getattr(there, name)
            if mine != theirs:
                raise Misfit(f"its `{name}` is {theirs!r}; it must be {mine!r}")
        check_model(state, config)
        check_numbers(state)
        average = state["average"]
        model = GaussianModel(average or state["raw"], config.sh_degree)
        model.active_sh_degree = state["active_sh_degree"]
        if "background_gate" in average:
            gate = float(average["background_gate"])
        elif state["gate"] is None:
            gate = float(config.background_gate)
        else:
            learned = LearnedGate(config.gate, config.batch, device)
            learned.load_state_dict(state["gate"])
            gate = float(learned.value)
        return SoFar(path, model, gate, int(state["iteration"]), float(state["train_seconds"]))


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
    with damage_named(path):
        with zipfile.ZipFile(path) as archive:
            if archive.testzip():  # torch compares no checksum: a flipped bit would be another number
                raise zipfile.BadZipFile
        content = torch.load(path, map_location=device, weights_only=True)
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise TrainerError(f"{path}: a checkpoint of another version; finish the run with that version, or "
                               "begin anew with --overwrite")
        return _with_tensors(json.loads(content["plain"]), content["tensors"])


@contextlib.contextmanager
def damage_named(path: str) -> Iterator[None]:
    """Makes a TrainerError of whatever a damaged checkpoint causes while it is read and taken over.

    Its text is not torch's, which advises to read such a file with weights_only=False, and so to run code from it.
    Errors that say nothing of the file stay as they are: no memory, a GPU that fails, a module that this machine lacks.
    """
    try:
        yield
    except (TrainerError, ImportError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise TrainerError(f"{path}: cannot be read: {error.strerror}") from error
        if out_of_memory(error) or (isinstance(error, RuntimeError) and "CUDA" in str(error)):
            raise
        text = f"{path}: not a readable checkpoint; remove it, and --resume starts the run anew"
        if isinstance(error, Misfit):
            text = f"{path}: no state of this run: {error}. Remove the file, and --resume starts the run anew"
        if not SAFE_LOAD:
            text += (f" (load no stranger's: torch {torch.__version__} may run code from a file that was made for it, "
                     "2.6 and later do not)")
        raise TrainerError(text) from error


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
