"""`dsmoe run`: a command of an unmodified trainer, with this package's rasterizer in front of its own.

PYTHONPATH names a folder that is written for this run. There `diff_gaussian_rasterization` is the module of
integrations whose API the trainer calls. DSMOE_BLEND_MODE is the mode, and in GATED_MODES DSMOE_BACKGROUND_GATE the
background's gate. Whatever the command starts has them. That nothing was rendered is an error.
"""
from __future__ import annotations

import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Dict, List, NoReturn, Optional, Sequence, Set, Tuple, Union

from diff_smoe_rasterization.integrations.contracts import CONTRACTS, contract_of
from diff_smoe_rasterization.settings import (
    BACKGROUND_GATE_VARIABLE,
    BLEND_MODE_VARIABLE,
    FAINT_BELOW_VARIABLE,
    resolve_faint_below,
    training_background_gate,
)
from dsmoe.system.children import die_with_parent

from . import facts, vendored
from .runtime import RASTERIZER_VARIABLE, STAND_INS, USED_VARIABLE, WITHOUT_VARIABLE
from .source import PatchError
from .trainers import GR, OF_AUTHORS, RASTERIZER, TRAINER_NAMES, TRAINERS

PACKAGES = "DSMOE_RUN_PACKAGES"  # PACKAGE=FLAVOUR of what the trainer imports; without a flavour it is not to be used
AS_RASTERIZER = "from dsmoe.patches import runtime\nglobals().update(runtime.rasterizer_of_run({0!r}))\n"
AS_NOTHING = "raise ImportError('dsmoe run: {0} computes something else; this package cannot stand in for it')\n"
AS_GSPLAT = "from dsmoe.patches import runtime\nruntime.gsplat_of_run()\n"
TO_FOLDER = "change into"  # the remedy where the trainer is in a folder below
FLAVOURS = tuple(sorted(contract.name for contract in CONTRACTS))
TRAINER_LIST = (f"trainers: {', '.join(TRAINER_NAMES)}\nrasterizers, for other trainers that call their API: "
                f"{', '.join(FLAVOURS)}\nor what a call returns, such as color,depth,median_depth,alpha,radii")


def run(words: Sequence[str], blend_mode: str, trainer: Optional[str] = None,
        background_gate: Union[float, str, None] = None, faint_below: Optional[float] = None) -> NoReturn:
    """Runs the command, and ends with its exit status, or 128 + N if signal N ended it.

    If this process is killed, the command gets a SIGTERM. Raises PatchError if the command would not run, or did
    not, with this rasterizer.
    """
    environment, lines = prepare(words, blend_mode, trainer, dict(os.environ), background_gate, faint_below)
    _check_python(words[0], environment)
    for line in lines:
        print("dsmoe run: " + line, file=sys.stderr)
    with tempfile.TemporaryDirectory(prefix="dsmoe_run_") as folder:
        used, packages = Path(folder, "used"), Path(folder, "packages")
        write_rasterizers(packages, environment.pop(PACKAGES))
        environment["PYTHONPATH"] = os.pathsep.join([str(packages), environment["PYTHONPATH"]])
        try:
            child = subprocess.Popen(list(words), env={**environment, USED_VARIABLE: str(used)},
                                     preexec_fn=die_with_parent)
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
            environment: Dict[str, str], background_gate: Union[float, str, None] = None,
            faint_below: Optional[float] = None) -> Tuple[Dict[str, str], List[str]]:
    """Returns the environment of the command, and what the user is told about it."""
    try:
        gate = training_background_gate(blend_mode, background_gate)
        faint = None if faint_below is None else resolve_faint_below(blend_mode, faint_below)
    except ValueError as error:
        raise PatchError(str(error)) from None
    if not words:
        raise PatchError("there is no command; type: dsmoe run --blend-mode MODE -- python train.py ...")
    missing = _missing_script(words)
    if missing:
        below = facts.below(Path.cwd(), TO_FOLDER) or [f"{TO_FOLDER} the trainer's folder"]
        raise PatchError(f"{missing}: there is no such script in {Path.cwd()}; {below[0]}, or name the script with its "
                         "folder")
    script = _script(words)
    folders = _folders(script)
    files = {folder: _read(folder, everywhere=folder == folders[0]) for folder in folders}
    flavour, where, warnings, found = _flavour(files, trainer, script)
    flavours = _flavours(flavour, trainer, found)
    named = flavours.get(RASTERIZER, "inria")  # beside another stands Inria's
    renamed = sorted(name for name, one in flavours.items() if name not in (RASTERIZER, contract_of(one).module))
    blocked = sorted(facts.those(found, "may use ") if trainer else facts.blocked(found))
    path = [str(STAND_INS), *filter(None, [environment.get("PYTHONPATH")])]
    environment = {**environment, BLEND_MODE_VARIABLE: blend_mode, RASTERIZER_VARIABLE: named,
                   BACKGROUND_GATE_VARIABLE: "" if gate is None else str(gate), "PYTHONPATH": os.pathsep.join(path),
                   "PYTHONDONTWRITEBYTECODE": "1",  # no __pycache__ in the checkout
                   PACKAGES: os.pathsep.join([*(f"{name}={one}" for name, one in flavours.items()),
                                              *(f"{name}=" for name in blocked)])}
    if faint is not None:
        environment[FAINT_BELOW_VARIABLE] = str(faint)
    environment.setdefault("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # torch.load of checkpoints, which are tuples
    warnings += facts.of_one_name(folders[0])
    if (named == "inria_2024" or "," in named) and not _may_use_sparse_adam(words, files, found):
        environment[WITHOUT_VARIABLE] = facts.SPARSE_ADAM
    if renamed:
        why = "as --trainer says" if trainer else "since its calls fit"
        warnings += [f"{', '.join(renamed)} is taken for {RASTERIZER} under another name, {why}; if it computes "
                     "something else, that is not computed here"]
    warnings += [f"the results are told by what the trainer calls them: {one} ({name})"
                 for name, one in flavours.items() if "," in one and one not in ("color,radii", trainer)]
    warnings += [f"{name} computes something else: an import of it fails here" for name in blocked]
    warnings += [f"the trainer may call gsplat's {name}, which this package has not: that ends the command"
                 for name in sorted(facts.those(found, "calls gsplat's ")) if name.startswith("rasterization")]
    shown = {facts.OF_GSPLAT: flavour} if flavour == facts.OF_GSPLAT else flavours
    will_be = ", ".join(f"{', '.join(name for name in shown if shown[name] == one)} will be {one}"
                        for one in dict.fromkeys(shown.values()))
    blend = blend_mode if gate is None else f"{blend_mode}, background gate {gate}"
    blend += "" if faint is None else f", faint_below {faint:g}"
    return environment, [f"{where}: {will_be} of this package, blend mode {blend}; each process that "
                         "imports it says so", *(f"warning: {warning}" for warning in warnings)]


def _flavours(flavour: str, trainer: Optional[str], found: Set[str]) -> Dict[str, str]:
    """Returns for each package that the trainer imports as its rasterizer what it will be.

    flavour: what --trainer names, or what the trainer was recognised by.
    """
    imported = facts.packages(found)
    if not trainer:
        return {name: one.name for name, one in facts.contracts_of(found)[0].items()} if imported else {}
    own = contract_of(flavour).module
    kept = {name: one.name for name, one in facts.MODULES.items() if name in imported and own in facts.MODULES}
    given = dict.fromkeys(sorted(imported - set(kept)) or [own], flavour if own == RASTERIZER else "inria")
    flavours = {**given, **kept, **{own: flavour}} if own != facts.OF_GSPLAT else {}
    for name, one in flavours.items():
        missing = facts.not_offered(found, name, contract_of(one))
        if missing:
            raise PatchError(f"it imports {', '.join(missing)} from {name}, which the rasterizer {one} has not; "
                             f"--trainer {trainer} cannot help")
    return flavours


def write_rasterizers(folder: Path, packages: str) -> None:
    """Makes the packages that a trainer may import as its rasterizer, each of one file, in a new folder.

    packages: PACKAGE=FLAVOUR of what it imports, with os.pathsep between them.
    """
    texts = {module: AS_RASTERIZER.format(contract.name) for module, contract in facts.MODULES.items()}
    texts[RASTERIZER] = AS_RASTERIZER.format("")
    for name, _, flavour in (package.partition("=") for package in packages.split(os.pathsep) if package):
        texts[name] = AS_RASTERIZER.format(flavour) if flavour else AS_NOTHING.format(name)
    for name, text in {**texts, facts.OF_GSPLAT: AS_GSPLAT}.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(text)


def _flavour(files: Dict[Path, Dict[str, bytes]], trainer: Optional[str], script: Optional[Path]
             ) -> Tuple[str, str, List[str], Set[str]]:
    """Returns the flavour, for which trainer it was chosen, what speaks against it, and the facts."""
    by_name = {"": "", **{name: name for name in FLAVOURS}, **{known.name: known.flavour for known in TRAINERS}}
    with contextlib.suppress(KeyError):
        by_name.setdefault(trainer or "", contract_of(trainer or "").name)
    if (trainer or "") not in by_name:
        raise PatchError(f"there is no trainer {trainer!r}; it must be one of {', '.join(TRAINER_NAMES)}, or for "
                         f"another trainer the rasterizer whose API it calls: {', '.join(FLAVOURS)}, or what a call "
                         "returns, such as color,depth,median_depth,alpha,radii")
    reasons, everything = [], set()
    for path in (next(iter(files)) / name for name in (RASTERIZER, f"{RASTERIZER}.py")):
        if path.exists():  # Python looks there first
            raise PatchError(f"{path} would be imported before this package's; move it away")
    for folder, texts in files.items():
        inside = script is not None and folder in script.parents
        name = script.relative_to(folder).as_posix() if script and inside else ""
        found = facts.of_checkout(texts, name)
        found.update(vendored.facts_of(folder, facts.packages(found)))
        everything |= found
        if facts.PATCHED in found:
            raise PatchError(f"{folder} is patched already: run the command itself, with --blend_mode (train.py) or "
                             "without (render.py, which reads it from cfg_args)")
        known, reason = facts.recognise(found)
        blends = vendored.another_blend(folder, facts.packages(found)) if known and known.name != OF_AUTHORS else ""
        if blends and not trainer:
            raise PatchError(f"{folder}: {blends}: {facts.STILL}")
        reasons += [f"{folder}: {blends}"] * bool(blends)
        if known and not trainer:
            return known.flavour, f"{known.name if GR in texts else 'the trainer'} in {folder}", [], found
        is_hidden = by_name[trainer or ""] == facts.OF_GSPLAT and "has gsplat" in found
        if trainer and (facts.those(found, "uses ") or found and not facts.calls_some(found) and not is_hidden):
            raise PatchError(f"{folder}: {reason}; --trainer {trainer} cannot help")
        if known and known.flavour != by_name[trainer or ""]:
            reason = f"by what it imports and calls this is {known.flavour}"
        reasons += [f"{folder}: {reason}"] if found and reason else []
    if trainer:
        module = contract_of(by_name[trainer]).module
        return by_name[trainer], trainer, reasons or [f"no file that imports {module} was found"] * (
            not everything), everything
    nearest = dict.fromkeys([next(iter(files)), Path.cwd()])
    below = [f"{folder}: {hint}" for folder in nearest for hint in facts.below(folder, TO_FOLDER)]
    raise PatchError("no trainer that is known was found; --trainer names it, or the rasterizer whose API it calls "
                     "(`dsmoe run --trainer list` prints the names):\n  " + "\n  ".join(
                         [*reasons, *below] or [f"there is no {GR} in {', '.join(map(str, files))}"]))


def _check_python(program: str, environment: Dict[str, str]) -> None:
    """Raises PatchError if a Python that would run the trainer has not this package."""
    if not re.fullmatch(r"python[\d.]*", Path(program).name):
        return
    find = "import importlib.util as u, sys; sys.exit(not (u.find_spec('dsmoe') and u.find_spec('torch')) and 41)"
    with contextlib.suppress(OSError):  # it is not a program: what starts it will say so
        if subprocess.run([program, "-c", find], env=environment, check=False).returncode == 41:
            raise PatchError(f"{program} has not this package, or no PyTorch: install it there (pip install .), or "
                             f"name the Python that has it, such as {sys.executable}")


def _script(words: Sequence[str]) -> Optional[Path]:
    """Returns the file that a command runs: the first .py, or the file of `-m`; None if there is none."""
    modules = [after.replace(".", "/") + ".py" for word, after in zip(words, words[1:]) if word == "-m"]
    return next((Path(word).resolve() for word in [*words, *modules]
                 if word.endswith(".py") and Path(word).is_file()), None)


def _missing_script(words: Sequence[str]) -> str:
    """Returns the script that a command of Python names and that is not there, else ""."""
    options = list(itertools.takewhile(lambda word: word.startswith("-"), words[1:]))
    script = next(iter(words[1 + len(options):]), "")
    runs_other = any(word == "-" or word.startswith(("-c", "-m")) for word in options)  # what is typed, code, a module
    is_script = re.fullmatch(r"python[\d.]*", Path(words[0]).name) and script.endswith(".py") and not runs_other
    return script if is_script and not Path(script).exists() else ""


def _folders(script: Optional[Path]) -> List[Path]:
    """Returns the folders that may be the checkout: the script's folder, those above it, the current folder."""
    folders = [script.parent, *list(script.parent.parents)[:2]] if script else []
    return list(dict.fromkeys([*folders, Path.cwd()]))


def _read(folder: Path, everywhere: bool) -> Dict[str, bytes]:
    """Returns the Python files in a folder and two levels below it; {} if none imports a rasterizer.

    everywhere: also if it is not a checkout like 3DGS's.
    """
    patterns = ("*.py", "*/*.py", "*/*/*.py") if everywhere or (folder / GR).is_file() else ()
    paths = (path for pattern in patterns for path in folder.glob(pattern) if path.is_file())
    files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths
             if not {"submodules", "site-packages"} & set(path.parts)}
    return files if GR in files or any(map(facts.IMPORTS_RASTERIZER.search, files.values())) else {}


def _may_use_sparse_adam(words: Sequence[str], files: Dict[Path, Dict[str, bytes]], found: Set[str]) -> bool:
    """Whether the trainer was written for SparseGaussianAdam, or the command asks for it."""
    return any(facts.ASKS_FOR_SPARSE_ADAM in word for word in words) or any(
        facts.is_for_sparse_adam(folder, texts, found) for folder, texts in files.items())
