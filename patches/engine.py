"""Plans a patch, and makes it, shows it or takes it back. Everything is planned before anything is written.

A plan is made of the files as they were before any patch: those in the record where there is one, else those on disk.
So the plan is the same for a checkout that is patched, half patched by an interruption, or patched with other options,
and to apply it is to write what differs from it.
"""
from __future__ import annotations

import difflib
import io
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Dict, Iterable, List, Mapping, NamedTuple, Optional, Tuple, Union

from diff_smoe_rasterization._version import __version__

from . import facts, record, scripts
from .record import FOLDER, Record
from .rules import ON_REQUEST, Misfit, Rule, rules_of
from .source import PatchError, Source
from .trainers import GR, RASTERIZER, TRAINER_NAMES, TRAINERS, Trainer

STATES = ("unknown", "patchable", "patched", "half-patched", "drifted")
PathLike = Union[str, Path]


class Change(NamedTuple):
    """What becomes of one file."""

    name: str  # relative to the checkout
    before: bytes
    after: bytes
    rules: Tuple[str, ...]


class Plan(NamedTuple):
    """What `apply` would do, and why it would not."""

    root: Path
    state: str  # one of STATES
    trainer: Optional[str]
    reasons: Tuple[str, ...]  # of the state, as lines
    options: Tuple[str, ...]  # of ON_REQUEST; also those that it was made with
    applied: Tuple[str, ...]  # those that the files on disk are patched with
    record: Optional[Record]
    changes: Tuple[Change, ...] = ()
    notes: Tuple[str, ...] = ()  # scripts that no rule reaches, files that stay, and where each rule on request is
    written: bool = False  # whether `apply` wrote files by this plan

    def refusal(self) -> str:
        """Why the checkout cannot be patched."""
        trainer = f" ({self.trainer})" if self.trainer else ""
        return "\n".join([f"the checkout is {self.state}{trainer}:", *("  " + reason for reason in self.reasons)])


class Patched:
    """Files in memory, to which rules are applied."""

    def __init__(self, files: Mapping[str, bytes], trainer: Trainer) -> None:
        """Applies the rules that have to match."""
        self.before, self.sources = files, {}
        self.rules: Dict[str, List[str]] = {}  # of each file, those that changed it
        self.problems: List[str] = []  # why it cannot be patched
        self.pending: List[str] = []  # rules that are not applied, as "FILE: rule NAME"
        self.done: List[str] = []
        self.notes: List[str] = []
        for rule in rules_of(trainer):
            line = f"{rule.file}: rule {rule.name}"
            try:
                is_changed = self.apply(rule.file, rule)
                if is_changed is None:
                    raise Misfit("no match")
                (self.pending if is_changed else self.done).append(line)
            except KeyError:
                self.problems.append(f"{line}: there is no such file; expected is {rule.says}")
            except Misfit as misfit:
                self.problems.append(f"{line}: {misfit}; right would be {rule.says}")
            except PatchError as error:
                self.problems.append(str(error))

    def apply(self, name: str, rule: Rule) -> Optional[bool]:
        """Returns whether a rule changed a file; None where nothing matched."""
        if name not in self.sources:
            self.sources[name] = Source(name, self.before[name])
        after = rule.change(self.sources[name])
        if after in (None, self.sources[name].data):
            return None if after is None else False
        try:
            self.sources[name] = Source(name, after)
        except PatchError as error:
            raise Misfit(f"{name}: what {rule.name} would make of it {str(error).partition(': ')[2]}") from None
        self.rules.setdefault(name, []).append(rule.name)
        return True

    def attempt(self, name: str, rule: Rule) -> bool:
        """Applies a rule that may match or not; returns whether it did. A file that cannot be read stays."""
        try:
            return bool(self.apply(name, rule))
        except (PatchError, Misfit) as error:
            self.notes = list(dict.fromkeys([*self.notes, f"left as it is: {error}"]))
            return False

    def changes(self) -> Tuple[Change, ...]:
        return tuple(Change(name, self.before[name], self.sources[name].data, tuple(dict.fromkeys(rules)))
                     for name, rules in self.rules.items())

    def state(self) -> Tuple[str, List[str]]:
        """One of STATES, and the reasons."""
        if self.problems:
            return "drifted", self.problems
        if self.done and self.pending:
            return "half-patched", ([f"{line}: is not applied" for line in self.pending]
                                    + [f"{line}: is applied already" for line in self.done])
        return "patched" if self.done else "patchable", []


def check(path: PathLike, modernise: bool = False, trainer: Optional[str] = None, fuse: bool = False) -> Plan:
    """Plans the patch of a checkout in whatever state it is."""
    root = _root(path)
    recorded = Record.in_force(root)
    applied = tuple(recorded.manifest["options"]) if recorded else ()
    wanted = {"modernise": modernise, "fuse": fuse}
    options = tuple(name for name in ON_REQUEST if wanted[name] or name in applied)
    now = {name: (root / name).read_bytes()
           for name in scripts.python_files(root, with_submodules="modernise" in options)}
    if recorded is None and any(b"import fused_where_equal" in data for data in now.values()):
        applied = ("fuse",)
    files = {**now, **(recorded.before if recorded else {})}
    looked_at = {name: files[name] for name in facts.LOOKED_AT if name in files}
    looked_at.update({name: files[name] for name in facts.further_renderers(looked_at) if name in files})
    found = facts.of_files(looked_at)
    known, reason = facts.recognise(found)
    name = trainer or (recorded.manifest["trainer"] if recorded else None)
    chosen = by_name(name) if name else known
    if chosen is not None and (not chosen.entries or facts.is_for_run_alone(found)):
        reason = reason or f"its rasterizer is {chosen.flavour}, for which there is no patch: use `dsmoe run`"
        chosen = None
    if GR not in files or chosen is None or facts.those(found, "uses "):
        return Plan(root, "unknown", None, (reason if GR in files else _no_renderer(root),), options, applied, recorded)
    patched = Patched(files, chosen)
    state, reasons = patched.state()
    import_rule = rules_of(chosen)[0]
    # A script of the user's that imports the rasterizer must not get another one than the trainer's own files.
    for name in sorted(set(files) - {GR}):
        if RASTERIZER.encode() in files[name] and not name.startswith("submodules/"):
            patched.attempt(name, import_rule)
            if f"from {RASTERIZER}._C ".encode() in files[name]:
                patched.notes.append(f"{name}: the import from {RASTERIZER}._C stays; where it fails, the file has to "
                                     "do without what it names")
    notes = []
    for option in options:
        by_rule = {rule.name: [name for name in sorted(files)
                               if any(hint.encode() in files[name] for hint in rule.hints)
                               and patched.attempt(name, rule)] for rule in ON_REQUEST[option]}
        where = "applied in" if option in applied else "not applied in"
        notes += [f"{option} {rule.name}: {where} {', '.join(by_rule[rule.name])}: {rule.says}"
                  for rule in ON_REQUEST[option] if by_rule[rule.name]]
        skipped = [name for name, changed in by_rule.items() if not changed]
        notes += [f"{option}: skipped, nothing matches: {', '.join(skipped)}"] if skipped else []
    notes = [*patched.notes, *scripts.notes(root, files, chosen), *notes]
    if recorded and not patched.problems:
        is_current = all(now.get(change.name) == change.after for change in patched.changes())
        state, reasons = _state_by_record(recorded, is_current or Patched(now, chosen).state()[0] == "patched")
    elif state == "patched":
        reasons = [f"every rule is applied; there is no {FOLDER}, so `revert` cannot undo it"]
    elif state == "patchable" and (root / FOLDER).exists():
        reasons = [f"no file is patched any more: `apply` replaces the {FOLDER} that is there, `revert` removes it"]
    if trainer and not (known and known.flavour == chosen.flavour):
        notes.insert(0, f"--trainer {trainer}: " + (
            f"by what it imports and calls this is {known.name}, whose rasterizer has another API ({known.flavour}, "
            f"not {chosen.flavour})" if known else reason))
    return Plan(root, state, chosen.name, tuple(reasons), options, applied, recorded, patched.changes(), tuple(notes))


def plan(path: PathLike, **options: Any) -> Plan:
    """Plans a patch, with the options of `check`. Raises PatchError where it is refused."""
    planned = check(path, **options)
    states = set(planned.record.states().values()) if planned.record else {"not finished"}
    if planned.state in ("patchable", "patched") or states <= {"patched", "original", "cut"}:
        return planned
    raise PatchError(planned.refusal())


def diff(path: PathLike, **options: Any) -> str:
    """Returns what the patch changes, as a unified diff against the files as they were before any patch."""
    return text_of(plan(path, **options).changes)


def apply(path: PathLike, **options: Any) -> Plan:
    """Patches a checkout, with the options of `check`; writes nothing where it is patched already.

    Returns the plan; its `state` is how the checkout was before, `written` whether anything was changed.
    Raises PatchError where it is refused, and then every file is as it was; where the disk fails, as before any patch.
    """
    planned = plan(path, **options)
    root = planned.root
    if not pending(planned):
        return planned
    before = {change.name: change.before for change in planned.changes}
    after = {change.name: change.after for change in planned.changes}
    for name in before:
        if root.resolve() not in (root / name).resolve().parents:
            raise PatchError(f"{name}: is a link to {(root / name).resolve()}, outside the checkout; copy it into the "
                             "checkout first")
    originals = {**(planned.record.before if planned.record else {}), **before}
    try:
        _write(root, originals)
        record.remove(root)
        Record.make(root, before, after, version=__version__, trainer=planned.trainer, options=planned.options)
        _write(root, after)
    except OSError as error:
        _write(root, originals)
        record.remove(root)
        raise PatchError(f"{error.filename or FOLDER}: cannot be written, so all was put back: {error}") from None
    return planned._replace(written=True, applied=planned.options)


def pending(planned: Plan) -> Tuple[Change, ...]:
    """Returns what `apply` would write, from what the files are. Raises PatchError where it refuses."""
    recorded, words = planned.record, " ".join("--" + option for option in planned.options)
    if planned.state == "patched" and recorded is None:
        if planned.options and planned.changes:
            raise PatchError(f"{planned.changes[0].name}: rule {planned.changes[0].rules[0]} is not applied, but the "
                             f"checkout is patched and has no {FOLDER}: take the patch back by your version control, "
                             f"then apply it with {words}")
        return ()
    edited = [name for name, state in recorded.states().items() if state == "changed"] if recorded else []
    if edited:
        if planned.options == planned.applied:
            return ()  # nothing is written over an edit
        raise PatchError(f"{edited[0]}: was changed since it was patched: undo your edit, then apply it with {words}")
    now = [change._replace(before=(planned.root / change.name).read_bytes()) for change in planned.changes]
    return tuple(change for change in now if change.before != change.after)


def revert(path: PathLike) -> Dict[str, bool]:
    """Puts every file that is patched back and removes the record; returns of each whether it was edited since.

    Files come back byte for byte; of one that was edited since, the edit stays. Raises PatchError, and touches nothing,
    where an edit is of the patch's own lines, where a patched file is gone, and where there is no record.
    """
    root = _root(path)
    recorded = Record.in_force(root)
    if recorded is None:
        if record.remove(root):
            return {}
        raise PatchError(f"{root}: there is no {FOLDER}, so nothing can be put back: it was not patched, or by hand")
    states = recorded.states()
    gone = [name for name, state in states.items() if state == "gone"]
    if gone:
        raise PatchError(f"{gone[0]}: {_SINCE['gone']}; nothing was touched. {_WAY_OUT}")
    back = {name: _without_patch(recorded, name) if state == "changed" else recorded.before[name]
            for name, state in states.items() if state in ("patched", "changed", "cut")}
    try:
        _write(root, back)
    except OSError as error:
        raise PatchError(f"{error.filename}: cannot be written: {error}; `revert` goes on where it can be") from None
    record.remove(root)
    return {name: states[name] == "changed" for name in back}


_WAY_OUT = (f"Undo your edit; or copy what lies in {FOLDER}/originals over the checkout, by which your edit is lost, "
            f"and delete {FOLDER}")
_SINCE = {"cut": "is written in part, as a kill leaves it: `apply` finishes the patch, `revert` takes it back",
          "changed": "was changed since it was patched", "gone": "was removed since it was patched",
          "replaced": "was changed since, and is not patched any more; `revert` leaves it, and puts back the others",
          "original": "is not patched, or not any more: `apply` finishes the patch, `revert` takes it back"}


def _without_patch(recorded: Record, name: str) -> bytes:
    """Returns an edited file without the patch, which git takes back: its lines have to be as the patch wrote them."""
    undo = diff_of("file", recorded.before[name], recorded.after[name], context=0)
    with tempfile.TemporaryDirectory() as folder:
        file, edited = Path(folder, "file"), (recorded.root / name).read_bytes()
        file.write_bytes(edited)
        try:
            done = subprocess.run(["git", "apply", "--reverse", "--unidiff-zero"], cwd=folder, input=undo,
                                  capture_output=True)
            for data in (edited, file.read_bytes()):
                Source(name, data)
        except (OSError, PatchError) as error:  # there is no git; what is left needs a statement of the patch
            done = subprocess.CompletedProcess((), 1, stderr=str(error).encode())
        if done.returncode == 0:
            return file.read_bytes()
    mine = diff_of(name, recorded.after[name], edited, context=0).decode(errors="replace")
    raise PatchError(f"{name}: you have edited what the patch wrote, or what needs it; nothing was touched. {_WAY_OUT}."
                     f" Your edit (- the patch's, + yours):\n{mine}{done.stderr.decode(errors='replace').strip()}")


def _state_by_record(recorded: Record, is_current: bool) -> Tuple[str, List[str]]:
    """How a checkout is that has a record. is_current: whether its files have what today's rules make of them."""
    states, manifest = recorded.states(), recorded.manifest
    edited = [name for name, state in states.items() if state == "changed"]
    if set(states.values()) <= {"patched", "changed"} and (is_current or not edited):
        options = " ".join("--" + option for option in manifest["options"])
        is_old = [] if is_current else ["its rules were others: to bring it up to date, type: dsmoe patch apply "
                                        f"{recorded.root}"]
        return "patched", [f"by version {manifest['version']}" + (f", with {options}" if options else ""), *is_old,
                           *(f"{name}: was edited since; every rule for the blend mode is still applied"
                             for name in edited)]
    return "half-patched", [f"{name}: {_SINCE[state]}" for name, state in states.items() if state != "patched"]


def _write(root: Path, files: Mapping[str, bytes]) -> None:
    """Writes those files that are not these bytes; each keeps mode and owner, and a link its target."""
    for name, data in files.items():
        if (root / name).read_bytes() != data:
            (root / name).write_bytes(data)


def by_name(name: str) -> Trainer:
    for trainer in TRAINERS:
        if trainer.name == name:
            return trainer
    raise PatchError(f"there is no trainer {name!r}; it must be one of {', '.join(TRAINER_NAMES)}")


def _root(path: PathLike) -> Path:
    root = Path(path)
    if not root.is_dir():
        raise PatchError(f"{root}: is not a folder; wanted is the checkout's, in which train.py or compress.py lies")
    return root


def _no_renderer(root: Path) -> str:
    """Says that a folder is no checkout, and which one beside it is."""
    above = root.resolve()
    near = [folder for folder in (*above.parents, *sorted(above.glob("*/"))) if (folder / GR).is_file()]
    return f"there is no {GR} in {root}; wanted is the checkout's folder" + (f", such as {near[0]}" if near else "")


def diff_of(name: str, before: bytes, after: bytes, context: int = 3) -> bytes:
    """Returns the unified diff of one file."""
    old, new = (io.BytesIO(data).readlines() for data in (before, after))
    lines = difflib.diff_bytes(difflib.unified_diff, old, new, b"a/" + name.encode(), b"b/" + name.encode(), n=context)
    return b"".join(line if line.endswith(b"\n") else line + b"\n\\ No newline at end of file\n" for line in lines)


def text_of(changes: Iterable[Change]) -> str:
    """Returns the unified diff of files, as it is shown."""
    return "".join(diff_of(name, before, after).decode(Source(name, before).encoding)
                   for name, before, after, _ in changes)
