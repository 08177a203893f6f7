"""Plans a patch, and makes it, shows it or takes it back. Everything is planned before anything is written.

A plan is made of the files without what a patch put into them. So it is the same if the checkout is patched, half
patched by an interruption, or patched with other options. To apply it is to write what differs from it.
"""
from __future__ import annotations

import ast
import contextlib
import difflib
import importlib.util
import os
import re
import shlex
import shutil
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Sequence, Set, Union

from . import facts, run, vendored
from .rules import OPTIONS, SETTINGS, entries_in, import_rasterizer, rules_of, settings_blend, start
from .runtime import STAND_INS
from .source import MARK, NO_STANDARD, STANDARD, PatchError, Source, leftover, tree_of, unpatched
from .trainers import GR, INTEGRATIONS, OF_AUTHORS, RASTERIZER, TRAINER_NAMES, TRAINERS, Trainer

UNFINISHED = ".dsmoe_unfinished"  # begins the name of a folder of new files, until all are written
OF_PROCESS = re.compile(re.escape(UNFINISHED) + r"\w{8}\.(\d+)")  # the whole name; the number is of its process
# Signs of an environment, of a run's output and of another checkout or package.
OF_NO_CHECKOUT = ("pyvenv.cfg", "conda-meta", "cfg_args", GR, ".git", "pyproject.toml")
CALLS = r"|\b(?:chosen_blend|default_(?:blend|smoe)|(?:saved_)?(?:blend|smoe)_of)\("  # nowhere imported without it
TO_COMPILE = {"_gridencoder", "arithmetic", "tinycudann"}  # PyPI has none of them, or another's of that name
PIP_NAMES = {"cv2": "opencv-python-headless", "PIL": "pillow", "skimage": "scikit-image", "sklearn": "scikit-learn",
             "yaml": "pyyaml"}  # of packages that are installed by another name
TRAINS, IS_SCRIPT = re.compile(rb"(?m)^def training\("), re.compile(rb"(?m)^if __name__ *==.*__main__")
OWN = "it is this package's own, and no trainer's; name the folder in which a trainer's train.py lies"
PathLike = Union[str, Path]


class Plan(NamedTuple):
    """What `apply` would do, and why it would not. Files are by name, relative to the checkout."""

    root: Path
    state: str  # unknown, supported (by `dsmoe run`), unpatchable, patchable, patched, half-patched or drifted
    trainer: Optional[str]
    reasons: Sequence[str]  # of the state, as lines
    applied: Sequence[str] = ()  # of OPTIONS, those that the files on disk are patched with
    now: Mapping[str, bytes] = {}
    before: Mapping[str, bytes] = {}  # without the patch
    after: Mapping[str, bytes] = {}
    rules: Mapping[str, Sequence[str]] = {}  # of each file
    notes: Sequence[str] = ()  # what no rule reaches
    written: bool = False  # whether `apply` wrote files by this plan

    def possible(self) -> Plan:
        """Returns the plan. Raises PatchError if the checkout cannot be patched."""
        if self.state in ("unknown", "supported", "unpatchable", "drifted"):
            trainer = f" ({self.trainer})" if self.trainer else ""
            trainer += ", but not by a patch" * (self.state == "supported")
            raise PatchError("\n  ".join([f"the checkout is {self.state}{trainer}:", *self.reasons]))
        return self


class Patched:
    """What a patch makes of files."""

    def __init__(self, before: Mapping[str, bytes], trainer: Trainer, options: Sequence[str],
                 sparse_adam: bool) -> None:
        self.before, self.after = before, dict(before)
        self.rules: Dict[str, List[str]] = {}  # of each file
        # Why it cannot be patched.
        self.problems = [f"{name}: {leftover(data)}, which is not as a patch writes it; change that line back, or "
                         "take the mark out of it" for name, data in before.items() if leftover(data)]
        scripts = [name for name, data in before.items() if "/" not in name and b"__main__" in data]
        self.notes = [f"--{one}: fits no script: no .py beside train.py has __main__" for one in options if not scripts]
        rendering = [entry for entry in trainer.entries if entry.renders]
        if rendering and not entries_in(before, rendering):  # it may render by other means
            file, function, *_, blend = rendering[-1]
            self.notes += [f"{file}: there is none, nor a function {function}; a script that renders needs "
                           f"`pipe.blend = {blend}(dataset)`, and says so where it has not"]
        for rule in rules_of(trainer, before, sparse_adam):
            why = self.apply(rule.file, rule.name, rule.edit)
            self.problems += [f"{rule.file}: rule {rule.name}: {why}; right would be {rule.says}"] if why else []
        for name, data in before.items():  # a script of the user's must not get another rasterizer
            if name != GR and RASTERIZER.encode() in data and not name.startswith("submodules/"):
                edit = partial(import_rasterizer, trainer=trainer, sparse_adam=sparse_adam)
                self.apply(name, "import-rasterizer", edit)
                self.notes += [f"{name}: {note}" for note in self.notes_on(name, trainer)]
        for option in options:
            for name, data in before.items():
                if name in scripts:
                    why = self.apply(name, option, partial(start, option=option))
                    self.notes += [f"{name}: does not begin with {option}.start(): {why}"] if why else []
                elif name.startswith("submodules/") and STANDARD in data and option == "modernise":
                    self.after[name], self.rules[name] = data.replace(STANDARD, NO_STANDARD), ["cpp-standard"]

    def apply(self, name: str, rule: str, edit: Callable[[Source], None]) -> str:
        """Applies a rule to a file; returns why it does not fit."""
        try:
            if name not in self.after:
                raise PatchError("there is no such file")
            source = Source(self.after[name])
            edit(source)
            tree_of(source.data)
            if unpatched(source.data) != self.before[name]:
                raise PatchError("the patch could not be taken back")
        except PatchError as error:
            return str(error)
        self.after[name] = source.data
        self.rules.setdefault(name, []).append(rule)
        return ""

    def notes_on(self, name: str, trainer: Trainer) -> List[str]:
        """What a script does without the blend mode that the trainer has; it can do without what it tries to import."""
        needed = re.sub(rb"(?m)^([ \t]*)try:\s*\n(\1[ \t]+from .*\n)+(?=\1except)", b"", self.after[name])
        kept = re.search(rf"(?m)^[ \t]*((from|import) {RASTERIZER}\b.*)".encode(), needed)
        if kept:
            return [f"`{kept[1].decode(errors='replace').strip()}` is the original rasterizer, which no rule changes "
                    f"there; this package's is `from {INTEGRATIONS}.{trainer.flavour} import ...`"]
        makes_settings = f"{SETTINGS}(".encode() in self.after[name]
        why = self.apply(name, "settings-blend-mode", settings_blend) if makes_settings else ""
        return [f"makes {SETTINGS} without a blend mode, and no rule gives it one ({why}): without `blend_mode=...` it "
                "is $DSMOE_BLEND_MODE, else alpha"] if why else []


def check(path: PathLike, modernise: bool = False, trainer: Optional[str] = None, fuse: bool = False) -> Plan:
    """Plans the patch of a checkout in whatever state it is."""
    root, now = Path(path), _files(path)
    before = {name: unpatched(data) for name, data in now.items()}
    applied = [name for name in OPTIONS if any(f"{name}.start()  {MARK}".encode() in data for data in now.values())]
    found = facts.of_checkout(before)
    found.update(vendored.facts_of(root, facts.packages(found)))
    known, reason = facts.recognise(found)
    recorded = re.search(rf"{MARK} ([\w-]+): ".encode(), now.get(GR, b""))
    by_name = {"": known, **{one.name: one for one in reversed(TRAINERS)}}
    name = trainer or (recorded[1].decode() if recorded else "")
    if name not in by_name:
        raise PatchError(f"there is no trainer {name!r}; it must be one of {', '.join(TRAINER_NAMES)}")
    chosen = by_name[name]
    renamed = facts.those(found, "renamed ")
    others = facts.those(found, "from ") - {RASTERIZER} or facts.those(found, "defines ") or renamed
    callers = facts.importers(before)
    is_own = GR not in now and (root / "dsmoe/cli.py").is_file()
    below = [OWN] if is_own else facts.below(root)
    if below:
        reason, chosen = below[0], None
    elif known and facts.blocked(found):
        also = ", ".join(sorted(facts.blocked(found)))
        reason, chosen = f"it imports {also} too, another rasterizer, which no patch replaces: {_by_run(before)}", None
    elif chosen is not None and (not chosen.entries or others):
        by = f" ({', '.join(sorted(renamed))})" if renamed else ""
        reason = reason or f"its rasterizer is {chosen.flavour}{by}, for which there is no patch: {_by_run(before)}"
        chosen = None
    elif callers and GR not in callers and known and _has_script(before):
        reason = (f"{GR} {'does not import' if GR in now else 'is not there to import'} the rasterizer, but "
                  f"{', '.join(callers[:3])}, and a patch is only of {GR}: {_by_run(before)}")
        chosen = None
    elif GR not in now:
        reason, chosen = f"there is no {GR} in it", None
    blends = vendored.another_blend(root, facts.packages(found)) if known and known.name != OF_AUTHORS else ""
    if blends and not trainer:
        return Plan(root, "unknown", None, [f"{blends}: {facts.STILL}"], applied)
    if chosen is None or facts.those(found, "uses "):
        instead = [] if "type `dsmoe run" in reason or below else [_instead(before, found)]
        state = "supported" if "type `dsmoe run" in reason and _runs(root, before) else "unknown"
        return Plan(root, state, None, [reason, *instead], applied)
    wanted = {"modernise": modernise, "fuse": fuse}
    options = [name for name in OPTIONS if wanted[name] or name in applied]
    sparse_adam = facts.is_for_sparse_adam(root, before, found)
    patched = Patched(before, chosen, options, sparse_adam)
    as_it_was = (patched if options == applied else Patched(before, chosen, applied, sparse_adam)).after
    wrong = [f"{name}: is not as this version patches it: `apply` finishes the patch, `revert` takes it back"
             for name, data in now.items() if data != as_it_was[name]]
    state, reasons = (("unpatchable" if now == before else "drifted", patched.problems) if patched.problems else
                      ("patched", []) if not wrong else ("patchable", []) if now == before else ("half-patched", wrong))
    if state == "unpatchable" and _can_start(before):
        reasons = [*reasons, f"unpatched it may run: {_by_run(before)}"]
    patched.notes += facts.of_one_name(root)
    patched.notes += [f"warning: {blends}"] * bool(blends)
    if trainer and not (known and known.flavour == chosen.flavour):
        reason = f"by what it imports and calls it is {known.name}, which has another API" if known else reason
        patched.notes.insert(0, f"--trainer {trainer}: {reason}")
    return Plan(root, state, chosen.name, reasons, applied, now, before, patched.after, patched.rules, patched.notes)


def _instead(files: Mapping[str, bytes], found: Set[str]) -> str:
    """Says what to do with a checkout that no patch fits."""
    scripts = _training_scripts(files)
    if scripts and all("/" in name for name in scripts):
        return f"name the folder of the script that you run, such as {scripts[0].rpartition('/')[0]}"
    if not _has_script(files) or not facts.calls_some(found) and not facts.importers(files):
        return ("name the folder in which train.py lies; a script of any other folder is run by "
                "`dsmoe run --blend-mode smoe -- python SCRIPT ...`")
    if facts.those(found, "uses ") or "from " + facts.OF_GSPLAT in found:
        return (f"neither a patch nor `dsmoe run` can stand in for that; an import of {INTEGRATIONS} in its code can: "
                "integrations/README.md lists their APIs")
    by_run = _by_run(files).replace("smoe --", "smoe --trainer NAME --")
    return (f"no patch fits; {by_run}. NAME is the rasterizer whose API it calls (`dsmoe run --trainer list` prints "
            "all), or the order of its results, such as color,depth,radii")


def _script_of(files: Mapping[str, bytes]) -> str:
    trains = [name for name, data in files.items() if TRAINS.search(data) and IS_SCRIPT.search(data)]
    trains = trains or _training_scripts(files) or ["train.py" if "train.py" in files else "SCRIPT"]
    return min(trains, key=lambda name: (name.count("/"), name != "train.py", not name.startswith("train"), name))


def _training_scripts(files: Mapping[str, bytes]) -> List[str]:
    """Scripts that say by their name that they train; tests of a training do not."""
    return [name for name, data in files.items() if "train" in name.rpartition("/")[2] and IS_SCRIPT.search(data)
            and not {"test", "tests"} & set(name.split("/")) and not name.rpartition("/")[2].startswith("test_")]


def _has_script(files: Mapping[str, bytes]) -> bool:
    """Whether something may be run in a folder; in one of a checkout's modules there is nothing."""
    return "train.py" in files or any(map(IS_SCRIPT.search, files.values()))


def _can_start(files: Mapping[str, bytes]) -> bool:
    """Whether the script that trains is there, and it and what it imports can be parsed."""
    loaded = facts.reached(files, [_script_of(files)])
    with contextlib.suppress(PatchError):
        return bool([tree_of(data) for data in loaded.values()])
    return False


def _by_run(files: Mapping[str, bytes]) -> str:
    """Says how a checkout is run without a patch."""
    return f"type `dsmoe run --blend-mode smoe -- python {_script_of(files)} ...` in it, which needs none"


def _runs(root: Path, files: Mapping[str, bytes]) -> bool:
    """Whether `dsmoe run` takes what `_by_run` says."""
    with contextlib.suppress(PatchError):
        run.prepare(["python", str(root / _script_of(files))], "smoe", None, {})
        return _script_of(files) in files
    return False


def _missing(files: Mapping[str, bytes], trainer: Trainer, options: Sequence[str]) -> List[str]:
    """Says what the trainer's scripts import that neither the checkout nor this environment has."""
    scripts = facts.reached(files, [GR, *(entry.file for entry in trainer.entries)])
    begin = [line for data in scripts.values() for line in tree_of(data).body]  # not in a `try`
    needed = {name.partition(".")[0] for line in begin if isinstance(line, (ast.Import, ast.ImportFrom))
              for name in ([alias.name for alias in line.names] if isinstance(line, ast.Import) else
                           [line.module or ""] * (not line.level))}
    ours = {path.name for path in STAND_INS.iterdir()}  # under --modernise
    own = {part.partition(".")[0] for name in files for part in name.split("/")} | {RASTERIZER}
    missing = {name for name in needed - own if importlib.util.find_spec(name) is None}
    of_pip = missing - ours - TO_COMPILE
    lines = {f"pip install {' '.join(PIP_NAMES.get(name, name) for name in sorted(of_pip))}": of_pip,
             "compile what the trainer's page names": missing & TO_COMPILE,
             "--modernise brings this package's": missing & ours if "modernise" not in options else set()}
    return [f"not installed here: {', '.join(sorted(names))}; {remedy}" for remedy, names in lines.items() if names]


def diff(path: PathLike, **options: Any) -> str:
    """Returns what the patch changes, as a unified diff against the files as they were before any patch."""
    planned, text = check(path, **options).possible(), []
    for name in planned.before:
        old, new = ([line.decode(errors="replace") for line in files[name].splitlines(keepends=True)]
                    for files in (planned.before, planned.after))
        text += list(difflib.unified_diff(old, new, "a/" + name, "b/" + name))
    return "".join(line if line.endswith("\n") else line + "\n\\ No newline at end of file\n" for line in text)


def apply(path: PathLike, **options: Any) -> Plan:
    """Patches a checkout, with the options of `check`; writes nothing if it is patched already.

    Returns the plan; its `state` is how the checkout was before, `written` whether anything was changed.
    Raises PatchError if it is refused, and then every file is as it was.
    """
    planned = check(path, **options).possible()
    todo = {name: data for name, data in planned.after.items() if data != planned.now[name]}
    _write(planned.root, todo, planned.now)
    by_name = {one.name: one for one in TRAINERS}
    missing = _missing(planned.before, by_name[str(planned.trainer)], [
        name for name in OPTIONS if options.get(name) or name in planned.applied])
    return planned._replace(written=bool(todo), notes=[*planned.notes, *missing])


def revert(path: PathLike) -> List[str]:
    """Takes the patch out of every file, with your own edits kept; returns their names.

    Raises PatchError, and touches nothing, if a file has no patch that can be taken out.
    """
    root, now = Path(path), _files(path)
    before = {name: unpatched(data) for name, data in now.items()}
    back = {name: data for name, data in before.items() if data != now[name]}
    for name, data in before.items():
        try:
            why = leftover(data, "" if name not in back else f"|{INTEGRATIONS}{CALLS}" if name == GR else CALLS)
            if name in back and not why:
                tree_of(data)
        except PatchError as error:
            why = str(error)
        if why:
            raise PatchError(f"{name}: without the lines of the patch it {why}. Undo your edit of them, then revert "
                             "again; nothing was touched")
    if not back and not _unfinished(root):
        raise PatchError(f"{root}: no file has a line of a patch, so nothing can be taken back")
    _write(root, back, now)
    return list(back)


def _files(path: PathLike) -> Dict[str, bytes]:
    """Returns the Python files of a checkout, and how its submodules are built."""
    root = Path(path)
    if not str(path):  # pathlib takes it for the current folder, as a variable that is unset would have it patched
        raise PatchError("the path is empty; name the checkout's folder, `.` for the current one")
    if not root.is_dir():
        raise PatchError(f"{root}: is not a folder; wanted is the checkout's, in which train.py or compress.py lies")
    paths = [*root.glob("submodules/*/setup.py"), *root.glob("submodules/*/backend.py")]
    _check_readable(root)
    for above, folders, names in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")
                      and name not in ("submodules", "site-packages", "__pycache__")
                      and _check_readable(Path(above, name))
                      and not any(Path(above, name, sign).exists() for sign in OF_NO_CHECKOUT)]
        paths += [Path(above, name) for name in names if name.endswith(".py")]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in sorted(paths) if path.is_file()}


def _check_readable(folder: Path) -> bool:
    if not os.access(folder, os.R_OK | os.X_OK):
        raise PatchError(f"{folder}: you may not read this folder, whose scripts a patch may be of; take the right to "
                         "(chmod u+rx), or move it out of the checkout")
    return True


def _write(root: Path, files: Mapping[str, bytes], now: Mapping[str, bytes]) -> None:
    """Writes files, each at once: a kill leaves every one as it was or as it becomes. Modes, owners and links stay.

    now: what they were read as. Raises PatchError if one is another one by now, as an editor has saved it.
    """
    targets = {name: (root / name).resolve() for name in files}
    for name, target in targets.items():
        if root.resolve() not in target.parents:
            raise PatchError(f"{name}: is a link to {target}, outside the checkout; copy it into the checkout first")
        if not os.access(target.parent, os.W_OK):
            raise PatchError(f"{target.parent}: you may not write in this folder; nothing was touched")
    try:
        unfinished = Path(tempfile.mkdtemp(prefix=UNFINISHED, suffix=f".{os.getpid()}", dir=root))
        for name, data in files.items():
            (unfinished / name).parent.mkdir(parents=True, exist_ok=True)
            (unfinished / name).write_bytes(data)
            shutil.copymode(targets[name], unfinished / name)
            with contextlib.suppress(PermissionError):
                os.chown(unfinished / name, targets[name].stat().st_uid, targets[name].stat().st_gid)
        there = {target: now[name] for name, target in targets.items()}  # of two names of one file once
        for name, target in targets.items():  # all of them before the first is replaced
            _check_unchanged(name, target, there)
        for name, target in targets.items():
            _check_unchanged(name, target, there)
            os.replace(unfinished / name, target)
            there[target] = files[name]
    except OSError as error:
        raise PatchError(f"{error.filename or root}: cannot be written: {error}; `dsmoe patch check "
                         f"{shlex.quote(str(root))}` says how the checkout is") from None
    finally:
        for folder, process in _unfinished(root).items():  # but those of other processes that still run
            if process == str(os.getpid()) or not os.path.exists(f"/proc/{process}/fd"):
                shutil.rmtree(folder, ignore_errors=True)


def _unfinished(root: Path) -> Dict[Path, str]:
    """Returns the folders of new files, of this process and others, each with the number of its process."""
    names = ((path, OF_PROCESS.fullmatch(path.name)) for path in root.glob(UNFINISHED + "*"))
    return {path: found[1] for path, found in names if found}


def _check_unchanged(name: str, target: Path, there: Mapping[Path, bytes]) -> None:
    if target.read_bytes() != there[target]:
        raise PatchError(f"{name}: another program has saved it meanwhile, and it is left as it is now; the same "
                         "command again finishes")
