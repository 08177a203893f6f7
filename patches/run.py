"""`dsmoe run`: a command of an unmodified trainer, with this package's rasterizer in front of its own.

PYTHONPATH names shims/, in which `diff_gaussian_rasterization` is the module of integrations whose API the trainer
calls. DSMOE_BLEND_MODE is the mode, and in GATED_MODES DSMOE_BACKGROUND_GATE the background's gate. Whatever the
command starts has them. That nothing was rendered is an error.
"""
from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Dict, List, NoReturn, Optional, Sequence, Tuple

from diff_smoe_rasterization.integrations.contracts import CONTRACTS, contract_of
from diff_smoe_rasterization.settings import BACKGROUND_GATE_VARIABLE, BLEND_MODE_VARIABLE, training_background_gate

from . import facts
from .runtime import RASTERIZER_VARIABLE, SHIMS, STAND_INS, USED_VARIABLE, WITHOUT_VARIABLE
from .source import PatchError
from .trainers import GR, RASTERIZER, TRAINER_NAMES, TRAINERS

FLAVOURS = tuple(sorted(contract.name for contract in CONTRACTS))
SPARSE_ADAM = "SparseGaussianAdam"


def run(words: Sequence[str], blend_mode: str, trainer: Optional[str] = None,
        background_gate: Optional[float] = None) -> NoReturn:
    """Runs the command, and ends with its exit status, or 128 + N where signal N ended it.

    Raises PatchError where the command would not run, or did not, with this rasterizer.
    """
    environment, lines = prepare(words, blend_mode, trainer, dict(os.environ), background_gate)
    for line in lines:
        print("dsmoe run: " + line, file=sys.stderr)
    with tempfile.TemporaryDirectory(prefix="dsmoe_run_") as folder:
        used = Path(folder, "used")
        try:
            child = subprocess.Popen(list(words), env={**environment, USED_VARIABLE: str(used)})
        except OSError as error:
            raise PatchError(f"{words[0]}: {error.strerror}") from None
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to the command too
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2):
            if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup, which the command inherits
                signal.signal(number, lambda received, _: child.send_signal(received))
        status, is_used = child.wait(), used.exists()
    if status == 0 and not is_used:
        raise PatchError("the command ended without an error, but this package's rasterizer rendered nothing: what was "
                         f"trained or rendered was not {blend_mode}. A command that renders nothing needs no dsmoe run")
    sys.exit(status if status >= 0 else 128 - status)


def prepare(words: Sequence[str], blend_mode: str, trainer: Optional[str],
            environment: Dict[str, str], background_gate: Optional[float] = None) -> Tuple[Dict[str, str], List[str]]:
    """Returns the environment of the command, and what the user is told about it."""
    try:
        gate = training_background_gate(blend_mode, background_gate)
    except ValueError as error:
        raise PatchError(str(error)) from None
    if not words:
        raise PatchError("there is no command; type: dsmoe run --blend-mode MODE -- python train.py ...")
    folders = _folders(words)
    files = {folder: _read(folder, everywhere=folder == folders[0]) for folder in folders}
    flavour, found, warnings = _flavour(files, trainer)
    module = contract_of(flavour).module
    named = flavour if module == RASTERIZER else "inria"  # beside another, such as gsplat's wrapper, stands Inria's
    path = [str(SHIMS), str(STAND_INS), *filter(None, [environment.get("PYTHONPATH")])]
    environment = {**environment, BLEND_MODE_VARIABLE: blend_mode, RASTERIZER_VARIABLE: named,
                   BACKGROUND_GATE_VARIABLE: "" if gate is None else str(gate), "PYTHONPATH": os.pathsep.join(path),
                   "PYTHONDONTWRITEBYTECODE": "1"}  # else Python leaves __pycache__ in the checkout
    warnings += facts.of_one_name(folders[0])
    if _cannot_use_sparse_adam(files):
        environment[WITHOUT_VARIABLE] = SPARSE_ADAM
        warnings += [f"{SPARSE_ADAM} is not offered: where it is found, the trainer reads get_features_dc of its model,"
                     " which has none"]
    blend = blend_mode if gate is None else f"{blend_mode}, background gate {gate}"
    return environment, [f"{found}: {module} will be {flavour} of this package, blend mode {blend}; each process that "
                         "imports it says so", *(f"warning: {warning}" for warning in warnings)]


def _flavour(files: Dict[Path, Dict[str, bytes]], trainer: Optional[str]) -> Tuple[str, str, List[str]]:
    """Returns the flavour, for which trainer it was chosen, and what speaks against it."""
    by_name = {"": "", **{name: name for name in FLAVOURS}, **{known.name: known.flavour for known in TRAINERS}}
    if (trainer or "") not in by_name:
        raise PatchError(f"there is no trainer {trainer!r}; it must be one of {', '.join(TRAINER_NAMES)}, or for "
                         f"another trainer the rasterizer whose API it calls: {', '.join(FLAVOURS)}")
    reasons, seen = [], False
    for path in (next(iter(files)) / name for name in (RASTERIZER, f"{RASTERIZER}.py")):
        if path.exists():  # where Python looks first
            raise PatchError(f"{path} would be imported before this package's; move it away")
    for folder, texts in files.items():
        found = facts.of_checkout(texts) if GR in texts else facts.of_files(texts)
        seen = seen or bool(found)
        if facts.PATCHED in found:
            raise PatchError(f"{folder} is patched already: run the command itself, with --blend_mode (train.py) or "
                             "without (render.py, which reads it from cfg_args)")
        known, reason = facts.recognise(found)
        if known and not trainer:
            return known.flavour, f"{known.name if GR in texts else 'the trainer'} in {folder}", []
        if trainer and (facts.those(found, "uses ") or found and not facts.those(found, "from ")):
            raise PatchError(f"{folder}: {reason}; --trainer {trainer} cannot help")
        if known and known.flavour != by_name[trainer or ""]:
            reason = f"by what it imports and calls this is {known.flavour}"
        reasons += [f"{folder}: {reason}"] if found and reason else []
    if trainer:
        module = contract_of(by_name[trainer]).module
        return by_name[trainer], trainer, reasons or [f"no file that imports {module} was found"] * (not seen)
    raise PatchError("no trainer that is known was found; name it with --trainer, or the rasterizer whose API it calls "
                     f"({', '.join(FLAVOURS)}):\n  " + "\n  ".join(
                         reasons or [f"there is no {GR} in {', '.join(map(str, files))}"]))


def _folders(words: Sequence[str]) -> List[Path]:
    """Returns where the checkout may be: the script's folder, those above it, the current folder."""
    script = next((Path(word).resolve() for word in words if word.endswith(".py") and Path(word).is_file()), None)
    folders = [script.parent, *list(script.parent.parents)[:2]] if script else []
    return list(dict.fromkeys([*folders, Path.cwd()]))


def _read(folder: Path, everywhere: bool) -> Dict[str, bytes]:
    """Returns the files of a checkout like that of 3DGS, else, if so asked, all that import a rasterizer."""
    of_3dgs = (folder / GR).is_file()
    patterns = ("*.py", "*/*.py", "*/*/*.py")[:2 if of_3dgs else 3 * everywhere]
    paths = (path for pattern in patterns for path in folder.glob(pattern) if path.is_file())
    files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths
             if not {"submodules", "site-packages"} & set(path.parts)}
    return {name: data for name, data in files.items() if of_3dgs or re.search(
        rb"^\s*(from|import) (diff_(gauss|surfel)|gsplat\b)", data, re.MULTILINE)}


def _cannot_use_sparse_adam(files: Dict[Path, Dict[str, bytes]]) -> bool:
    """Whether the trainer reads get_features_dc, as 3DGS does where it finds SparseGaussianAdam, and defines none."""
    text = b"\n".join(next((texts for texts in files.values() if GR in texts), {}).values())
    return b".get_features_dc" in text and not re.search(rb"def get_features_dc|\bget_features_dc *=", text)
