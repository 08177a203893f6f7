"""`dsmoe run`: a command of an unmodified trainer, with this package's rasterizer in front of its own.

PYTHONPATH names shims/, in which `diff_gaussian_rasterization` is the module of integrations whose API the trainer
calls. DSMOE_BLEND_MODE is the mode, and in `smoe` DSMOE_BACKGROUND_GATE the background's gate. Whatever the command
starts has them. Exit status and signals are the command's own, unless nothing was rendered: that is an error.
"""
from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Dict, List, NoReturn, Optional, Sequence, Tuple

from diff_smoe_rasterization.integrations.contracts import CONTRACTS, contract_of
from diff_smoe_rasterization.settings import BACKGROUND_GATE_VARIABLE, BLEND_MODE_VARIABLE, training_background_gate

from . import facts, scripts
from .record import Record
from .runtime import RASTERIZER_VARIABLE, SHIMS, USED_VARIABLE, WITHOUT_VARIABLE
from .source import PatchError
from .trainers import GR, RASTERIZER, TRAINER_NAMES, TRAINERS

FLAVOURS = tuple(sorted(contract.name for contract in CONTRACTS))
SPARSE_ADAM = "SparseGaussianAdam"
FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)


def run(words: Sequence[str], blend_mode: str, trainer: Optional[str] = None,
        background_gate: Optional[float] = None) -> NoReturn:
    """Runs the command, and ends as it ends. Raises PatchError where it would not run, or did not, with this
    rasterizer."""
    environment, lines = prepare(words, blend_mode, trainer, dict(os.environ), background_gate)
    for line in lines:
        print("dsmoe run: " + line, file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    with tempfile.TemporaryDirectory(prefix="dsmoe_run_") as folder:
        used = Path(folder, "used")
        status, is_used = _status_of(words, {**environment, USED_VARIABLE: str(used)}), used.exists()
    if status == 0 and not is_used:
        raise PatchError("the command ended without an error, but this package's rasterizer rendered nothing: what was "
                         f"trained or rendered was not {blend_mode}. A command that renders nothing needs no dsmoe run")
    if status < 0:
        with contextlib.suppress(OSError):  # SIGKILL has no handler
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    sys.exit(status)


def _status_of(words: Sequence[str], environment: Dict[str, str]) -> int:
    """Runs the command, to which signals of this process go. Returns its exit status; -N where signal N ended it."""
    child: Optional[subprocess.Popen] = None
    early: List[int] = []  # signals that came while the command was being started

    def forward(number: int, _: object) -> None:
        if child is None:
            early.append(number)
        elif number != signal.SIGINT or not _is_in_foreground():
            child.send_signal(number)

    for number in FORWARDED:
        if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup: the command inherits that, but no handler
            signal.signal(number, forward)
    child = subprocess.Popen(list(words), env=environment)
    for received in early:
        child.send_signal(received)
    for number in FORWARDED:
        signal.signal(number, forward)
    return child.wait()


def _is_in_foreground() -> bool:
    """Whether a terminal sends its SIGINT to this process group, in which the command is too."""
    try:
        with open("/dev/tty") as terminal:
            return os.tcgetpgrp(terminal.fileno()) == os.getpgrp()
    except OSError:
        return False


def prepare(words: Sequence[str], blend_mode: str, trainer: Optional[str],
            environment: Dict[str, str], background_gate: Optional[float] = None) -> Tuple[Dict[str, str], List[str]]:
    """Returns the environment of the command, and what the user is told about it."""
    try:
        gate = training_background_gate(blend_mode, background_gate)
    except ValueError as error:
        raise PatchError(str(error)) from None
    if not words:
        raise PatchError("there is no command; type: dsmoe run --blend-mode MODE -- python train.py ...")
    if shutil.which(words[0], path=environment.get("PATH")) is None:
        is_script = words[0].endswith(".py") and Path(words[0]).is_file()
        raise PatchError(f"{words[0]}: " + (f"is not executable; type: python {words[0]}" if is_script else
                                            "there is no such command"))
    flavour, found, warnings = _flavour(words, trainer)
    warnings = [*warnings, *scripts.of_one_name(_folders(words)[0])]
    environment = {**environment, BLEND_MODE_VARIABLE: blend_mode, BACKGROUND_GATE_VARIABLE: str(gate),
                   RASTERIZER_VARIABLE: flavour}
    if gate is None:
        del environment[BACKGROUND_GATE_VARIABLE]
    if _cannot_use_sparse_adam(_folders(words)):
        environment[WITHOUT_VARIABLE] = SPARSE_ADAM
        warnings = [*warnings, f"{SPARSE_ADAM} is not offered: where the trainer finds it, it reads get_features_dc of "
                    "its model, which has none"]
    if "PYTHONPYCACHEPREFIX" not in environment:
        environment["PYTHONDONTWRITEBYTECODE"] = "1"  # else Python leaves __pycache__ in the checkout
    environment["PYTHONPATH"] = os.pathsep.join([str(SHIMS), *filter(None, [environment.get("PYTHONPATH")])])
    _check_python(words, environment)
    said_gate = f", background gate {gate}" if gate is not None else ""
    module = contract_of(flavour).module
    return environment, [f"{found}: {module} will be {flavour} of this package, blend mode {blend_mode}{said_gate};"
                         " each process that imports it says so", *(f"warning: {warning}" for warning in warnings)]


def _flavour(words: Sequence[str], trainer: Optional[str]) -> Tuple[str, str, List[str]]:
    """Returns the flavour, for which trainer it was chosen, and what speaks against it."""
    by_name = {**{name: name for name in FLAVOURS}, **{known.name: known.flavour for known in TRAINERS}}
    if trainer is not None and trainer not in by_name:
        raise PatchError(f"there is no trainer {trainer!r}; it must be one of {', '.join(TRAINER_NAMES)}, or for "
                         f"another trainer the rasterizer whose API it calls: {', '.join(FLAVOURS)}")
    reasons, seen = [], False
    folders = _folders(words)
    for folder in folders:
        for path in (folder / RASTERIZER, folder / f"{RASTERIZER}.py"):
            if folder == folders[0] and path.exists():  # where Python looks first
                raise PatchError(f"{path} would be imported before this package's; move it away")
        found = facts.of_files(_files(folder, everywhere=folder == folders[0]))
        seen = seen or bool(found)
        if facts.PATCHED in found or Record.in_force(folder):
            raise PatchError(f"{folder} is patched already: run the command itself, with --blend_mode (train.py) or "
                             "without (render.py, which reads it from cfg_args)")
        known, reason = facts.recognise(found)
        if known and trainer is None:
            return known.flavour, f"{known.name if (folder / GR).is_file() else 'the trainer'} in {folder}", []
        is_other = facts.those(found, "uses ")
        if trainer is not None and (is_other or found and not any(fact.startswith("keeps ") for fact in found)):
            raise PatchError(f"{folder}: {reason}; --trainer {trainer} cannot help")
        if found and not (known and known.flavour == by_name[trainer]):
            reasons.append(f"{folder}: " + (reason or f"by what it imports and calls this is {known.flavour}"))
    if trainer is not None:
        module = contract_of(by_name[trainer]).module
        return by_name[trainer], trainer, reasons or ([] if seen else [f"no file that imports {module} was found"])
    raise PatchError("no trainer that is known was found; name it with --trainer, or the rasterizer whose API it calls "
                     f"({', '.join(FLAVOURS)}):\n  " + "\n  ".join(
                         reasons or [f"there is no {GR} in {', '.join(map(str, folders))}"]))


def _folders(words: Sequence[str]) -> List[Path]:
    """Returns where the checkout may be: the script's folder, those above it, the current folder."""
    script = next((Path(word).resolve() for word in words if word.endswith(".py") and Path(word).is_file()), None)
    folders = [script.parent, *list(script.parent.parents)[:2]] if script else []
    return list(dict.fromkeys([*folders, Path.cwd()]))


def _cannot_use_sparse_adam(folders: Sequence[Path]) -> bool:
    """Whether the trainer reads get_features_dc, as 3DGS does where it finds SparseGaussianAdam, and defines none."""
    folder = next((folder for folder in folders if (folder / GR).is_file()), None)
    sources = [path.read_bytes() for pattern in ("*.py", "*/*.py") for path in folder.glob(pattern)] if folder else []
    return (any(b".get_features_dc" in source for source in sources)
            and not any(re.search(rb"def get_features_dc|\bget_features_dc *=", source) for source in sources))


def _files(folder: Path, everywhere: bool) -> Dict[str, bytes]:
    """Returns the files by which a trainer is recognised: those of 3DGS, else, if so asked, all that rasterize."""
    if (folder / GR).is_file():
        files = {name: (folder / name).read_bytes() for name in facts.LOOKED_AT if (folder / name).is_file()}
        return {**files, **{name: (folder / name).read_bytes() for name in facts.further_renderers(files)
                            if (folder / name).is_file()}}
    found = {}
    for pattern in ("*.py", "*/*.py", "*/*/*.py") if everywhere else ():
        for path in folder.glob(pattern):
            if not {"submodules", "site-packages"} & set(path.parts) and path.is_file():
                data = path.read_bytes()
                if re.search(rb"^\s*(from|import) (diff_(gauss|surfel)|gsplat\b)", data, re.MULTILINE):
                    found[str(path)] = data
    return found


def _check_python(words: Sequence[str], environment: Dict[str, str]) -> None:
    """Raises PatchError where the command is a Python that has not this package."""
    if re.fullmatch(r"python[0-9.]*t?", os.path.basename(words[0])):
        code = "import importlib.util, sys; sys.exit(importlib.util.find_spec('diff_smoe_rasterization') is None)"
        if subprocess.call([words[0], "-c", code], env=environment) != 0:
            raise PatchError(f"{words[0]} cannot import diff_smoe_rasterization; install it there: {words[0]} -m pip "
                             "install PATH_OF_THIS_PROJECT")
