"""`dsmoe run`: a command of an unmodified trainer, with this package's rasterizer in front of its own.

PYTHONPATH names a folder of shims/, in which `diff_gaussian_rasterization` is the module of integrations whose API the
trainer calls. DSMOE_BLEND_MODE is the mode, and in `smoe` DSMOE_BACKGROUND_GATE the background's gate. Whatever the
command starts has them. dsmoe becomes the command (exec), so that its exit status and signals are the command's own.
"""
from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Dict, List, NoReturn, Optional, Sequence, Tuple

from diff_smoe_rasterization.settings import BACKGROUND_GATE_VARIABLE, BLEND_MODE_VARIABLE, training_background_gate

from . import facts
from .engine import read_file
from .errors import PatchError
from .record import Record
from .trainers import RASTERIZER, TRAINERS, names

SHIMS = Path(__file__).resolve().parent / "shims"
STAND_INS = {"simple_knn": "simple_knn._C", "fused_ssim": "fused_ssim", "torch_scatter": "torch_scatter",
             "weighted_distance": "weighted_distance._C"}
PROBE = """
import importlib, importlib.util, json, sys
def usable(module):
    if importlib.util.find_spec(module.partition(".")[0]) is None:
        return False
    try:
        import torch
        importlib.import_module(module)
        return True
    except Exception:
        return False
print(json.dumps({"version": sys.version.split()[0], "ours": importlib.util.find_spec(sys.argv[1]) is not None,
                  "usable": [name for name in sys.argv[2:] if usable(name)]}))
"""


def run(words: Sequence[str], blend_mode: str, trainer: Optional[str] = None,
        background_gate: Optional[float] = None) -> NoReturn:
    """Becomes the command. Raises PatchError where it would not run with this rasterizer."""
    environment, lines = prepare(words, blend_mode, trainer, dict(os.environ), background_gate)
    for line in lines:
        print("dsmoe run: " + line, file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os.execvpe(words[0], list(words), environment)


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
    flavour, found = _flavour(words, trainer)
    environment = {**environment, BLEND_MODE_VARIABLE: blend_mode, BACKGROUND_GATE_VARIABLE: str(gate)}
    if gate is None:
        del environment[BACKGROUND_GATE_VARIABLE]
    if "PYTHONPYCACHEPREFIX" not in environment:
        environment["PYTHONDONTWRITEBYTECODE"] = "1"  # else Python leaves __pycache__ in the checkout
    usable, lines = _ask_python(words, environment)
    absent = [name for name, module in STAND_INS.items() if module not in usable]
    folders = [str(SHIMS / name) for name in [flavour, *absent]]
    environment["PYTHONPATH"] = os.pathsep.join(folders + list(filter(None, [environment.get("PYTHONPATH")])))
    said_gate = f", background gate {gate}" if gate is not None else ""
    return environment, [f"{found}: {RASTERIZER} will be {flavour} of this package, blend mode {blend_mode}{said_gate};"
                         " each process that imports it says so", *lines]


def flavours() -> Tuple[str, ...]:
    """The rasterizers whose API there is a shim for."""
    return tuple(sorted(folder.name for folder in SHIMS.iterdir() if (folder / RASTERIZER).is_dir()))


def _flavour(words: Sequence[str], trainer: Optional[str]) -> Tuple[str, str]:
    """Returns the flavour, and for which trainer it was chosen."""
    by_name = {**{name: name for name in flavours()}, **{known.name: known.flavour for known in TRAINERS}}
    if trainer is not None and trainer not in by_name:
        raise PatchError(f"there is no trainer {trainer!r}; it must be one of {', '.join(names())}, or for "
                         f"another trainer the rasterizer whose API it calls: {', '.join(flavours())}")
    reasons = []
    folders = _folders(words)
    for folder in folders:
        found = facts.of_checkout(lambda name, folder=folder: read_file(folder / name))
        if facts.PATCHED in found or Record.in_force(folder):
            raise PatchError(f"{folder} is patched already: run the command itself, with --blend_mode (train.py) or "
                             "without (render.py, which reads it from cfg_args)")
        for path in (folder / RASTERIZER, folder / f"{RASTERIZER}.py"):
            if folder == folders[0] and path.exists():  # where Python looks first
                raise PatchError(f"{path} would be imported before this package's; move it away")
        known, reason = facts.recognise(found)
        if known and trainer is None:
            return known.flavour, f"{known.name} in {folder}"
        reasons.append(f"{folder}: {reason}")
    if trainer is not None:
        return by_name[trainer], trainer
    raise PatchError("no trainer that is known was found; name it with --trainer, or the rasterizer whose API it calls "
                     f"({', '.join(flavours())}):\n  " + "\n  ".join(reasons))


def _folders(words: Sequence[str]) -> List[Path]:
    """Returns where the checkout may be: the script's folder, those above it, the current folder."""
    script = next((Path(word).resolve() for word in words if word.endswith(".py") and Path(word).is_file()), None)
    folders = [script.parent, *list(script.parent.parents)[:2]] if script else []
    return list(dict.fromkeys([*folders, Path.cwd()]))


def _ask_python(words: Sequence[str], environment: Dict[str, str]) -> Tuple[List[str], List[str]]:
    """Returns which of STAND_INS the command's Python has itself, and a warning where it may not have this package.

    Raises PatchError where it has not.
    """
    is_python = re.fullmatch(r"python[0-9.]*t?", os.path.basename(words[0])) is not None
    python = words[0] if is_python else next((name for name in ("python", "python3")
                                              if shutil.which(name, path=environment.get("PATH"))), None)
    if python is None:
        return list(STAND_INS.values()), []
    asked = subprocess.run([python, "-c", PROBE, "diff_smoe_rasterization", *STAND_INS.values()], env=environment,
                           stdout=subprocess.PIPE, stderr=subprocess.PIPE, universal_newlines=True)
    try:
        answer = json.loads(asked.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        said = asked.stderr.strip() or "it printed nothing"
        raise PatchError(f"{python} cannot be asked what it can import: {said}") from None
    if answer["ours"]:
        return answer["usable"], []
    message = (f"{python} (Python {answer['version']}) cannot import diff_smoe_rasterization; install it there: "
               f"{python} -m pip install PATH_OF_THIS_PROJECT")
    if is_python:
        raise PatchError(message)
    return answer["usable"], [message + f", unless {words[0]} starts another Python"]
