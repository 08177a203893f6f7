"""Plans a patch, and makes it, shows it or takes it back. Everything is planned before anything is written.

A plan is made of the files as they were before any patch: those in the record where there is one, else those on disk.
So the plan is the same for a checkout that is patched, half patched by an interruption, or patched with other options,
and to apply it is to write what differs from it.
"""
from __future__ import annotations

import difflib
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Dict, List, NamedTuple, Optional, Tuple, Union

from diff_smoe_rasterization._version import __version__

from . import facts, scripts, source
from .errors import PatchError
from .merge import without_patch
from .record import FOLDER, Record, check_writable, put_back, remove_rest, replace_file
from .trainers import GR, TRAINERS, Trainer, names

if TYPE_CHECKING:
    from .patch import Change, Requested  # which need LibCST

STATES = ("unknown", "patchable", "patched", "half-patched", "drifted")
PathLike = Union[str, Path]


class Verdict(str):
    """One of STATES, as a string, with `trainer` (a name or None) and `reasons` (lines)."""

    trainer: Optional[str]
    reasons: Tuple[str, ...]

    def __new__(cls, state: str, trainer: Optional[str], reasons: List[str]) -> Verdict:
        assert state in STATES
        verdict = super().__new__(cls, state)
        verdict.trainer, verdict.reasons = trainer, tuple(reasons)
        return verdict


class Plan(NamedTuple):
    """What `apply` would do, and why it would not."""

    root: Path
    verdict: Verdict
    options: Tuple[str, ...]  # of the patch, "modernise" and "fuse"; also those that it was made with
    record: Optional[Record]
    changes: Tuple[Change, ...] = ()
    remarks: Tuple[str, ...] = ()  # which scripts no rule reaches, which files are left as they are
    requested: Tuple[Requested, ...] = ()  # every rule that the options ask for
    written: bool = False  # whether `apply` wrote files by this plan

    @property
    def notes(self) -> Tuple[str, ...]:
        """The remarks, and of each rule that an option asks for where it is applied, or that it is skipped."""
        notes = list(self.remarks)
        for option in self.options:
            rules = [rule for rule in self.requested if rule.option == option]
            notes += [rule.note(self.written) for rule in rules if rule.files]
            skipped = [rule.rule for rule in rules if not rule.files]
            notes += [f"{option}: skipped, nothing matches: {', '.join(skipped)}"] if skipped else []
        return tuple(notes)


def inspect(path: PathLike, modernise: bool = False, trainer: Optional[str] = None, fuse: bool = False) -> Plan:
    """Plans the patch of a checkout in whatever state it is."""
    have_libcst()
    from .patch import Patch

    root = _root(path)
    record = Record.in_force(root)
    before = options_of(record)
    options = tuple(name for name, wanted in (("modernise", modernise), ("fuse", fuse)) if wanted or name in before)

    def read(name: str) -> Optional[bytes]:
        return record.original(name) if record and name in record.files else read_file(root / name)

    known, why_unknown = facts.recognise(facts.of_checkout(read))
    name = trainer or (record.manifest["trainer"] if record else None)
    chosen = by_name(name) if name else known
    if read(GR) is None or chosen is None:
        reason = _no_renderer(root) if read(GR) is None else why_unknown
        return Plan(root, Verdict("unknown", None, [reason]), options, record)
    files = {name: read(name) for name in scripts.python_files(root)}
    if "modernise" in options:
        files.update((name, read(name)) for name in scripts.build_files(root))
    patch = Patch(files, chosen)
    requested = patch.request(options, lambda name: read_file(root / name))
    changes = patch.changes()
    state, reasons = patch.state()
    if record and not patch.problems:
        state, reasons = _state_by_record(root, record, changes, chosen)
    elif state == "patchable" and (root / FOLDER / "manifest.json").exists():
        reasons = [f"no file is patched any more: `apply` replaces the {FOLDER} that is there, `revert` removes it"]
    if trainer and known and known.flavour != chosen.flavour:
        patch.notes.insert(0, f"--trainer {trainer}: by what it imports and calls this is {known.name}, whose "
                              f"rasterizer has another API ({known.flavour}, not {chosen.flavour})")
    remarks = (*patch.notes, *scripts.notes(root, files, chosen))
    return Plan(root, Verdict(state, chosen.name, reasons), options, record, changes, remarks, requested)


def plan(path: PathLike, **options: Any) -> Plan:
    """Plans a patch, with the options of `inspect`. Raises PatchError where it is refused."""
    planned = inspect(path, **options)
    can_be_finished = planned.verdict == "half-patched" and planned.record and planned.record.can_be_finished()
    if planned.verdict in ("patchable", "patched") or can_be_finished:
        return planned
    raise PatchError(refusal(planned.verdict))


def check(path: PathLike, **options: Any) -> Verdict:
    """Says how a checkout is: one of STATES, with `.trainer` and `.reasons`. Options as of `inspect`."""
    return inspect(path, **options).verdict


def diff(path: PathLike, **options: Any) -> str:
    """Returns what the patch changes, as a unified diff against the files as they were before any patch."""
    changes = plan(path, **options).changes
    return "".join(diff_of(change.name, change.before, change.after) for change in changes)


def apply(path: PathLike, modernise: bool = False, trainer: Optional[str] = None, fuse: bool = False) -> Plan:
    """Patches a checkout; writes nothing where it is patched already.

    Returns the plan; its `verdict` is how the checkout was before, `written` whether anything was changed.
    Raises PatchError where it is refused, and then every file is as it was; where the disk fails, as before any patch.
    """
    planned = plan(path, modernise=modernise, trainer=trainer, fuse=fuse)
    root, record, todo = planned.root, planned.record, pending(planned)
    if not todo:
        if record and not record.manifest["complete"]:
            record.note_complete(True)
        return planned
    before = {change.name: change.before for change in planned.changes}
    after = {change.name: change.after for change in planned.changes}
    check_writable(root, todo)
    failing = FOLDER
    try:
        if record:
            record.take_back()  # so that each file is the original, or patched by this plan
        elif (root / FOLDER / "manifest.json").exists():  # of a patch of which nothing is left
            Record.load(root).remove()
        begun = Record.begin(root, before, after, {
            "version": __version__, "trainer": planned.verdict.trainer, "options": planned.options,
            "rules": {change.name: change.rules for change in planned.changes}})
        for failing, data in after.items():
            replace_file(root, root / failing, data)
        begun.note_complete(True)
    except OSError as error:
        put_back(root, before)
        remove_rest(root)
        raise PatchError(f"{failing}: cannot be written, so all was put back: {error}") from None
    return planned._replace(written=True)


def pending(planned: Plan) -> Dict[str, bytes]:
    """Returns what `apply` would write, by the files' names. Raises PatchError where it refuses."""
    record = planned.record
    if planned.verdict == "patched" and record is None:
        if planned.options and planned.changes:
            raise PatchError(f"{planned.changes[0].name}: rule {planned.changes[0].rules[0]} is not applied, but the "
                             f"checkout is patched and has no {FOLDER}: take the patch back by your version control, "
                             f"then apply it with {words_of(planned.options)}")
        return {}
    edited = [name for name, state in record.states().items() if state == "changed"] if record else []
    if edited and planned.options == options_of(record):
        return {}  # nothing is written over an edit
    if edited:
        raise PatchError(f"{edited[0]}: was changed since it was patched: undo your edit, then apply it with "
                         f"{words_of(planned.options)}")
    wanted = {name: record.original(name) for name in record.files} if record else {}
    wanted.update((change.name, change.after) for change in planned.changes)
    return {name: data for name, data in wanted.items() if (planned.root / name).read_bytes() != data}


class Reverted(Tuple[str, ...]):
    """Names of files that were put back; `edited` are those in which edits were kept."""

    edited: Tuple[str, ...] = ()


def revert(path: PathLike) -> Reverted:
    """Puts every file that is patched back and removes the record; returns the files' names.

    Files come back byte for byte; of one that was edited since, the edit stays. Raises PatchError, and touches nothing,
    where an edit is of the patch's own lines, where a patched file is gone, and where there is no record.
    """
    root = _root(path)
    record = Record.load(root)
    if record is None and remove_rest(root):
        return Reverted()
    if record is None:
        raise PatchError(f"{root}: there is no {FOLDER}, so nothing can be put back: it was not patched, or by hand")
    states = record.states() if Record.in_force(root) else {}
    back = {name: record.original(name) for name, state in states.items() if state in ("patched", "changed")}
    edited = [name for name in back if states[name] == "changed"]
    for name, state in states.items():
        if state == "gone" or name in edited and record.patched(name) is None:
            raise PatchError(f"{name}: {_SINCE[state]}; nothing was touched. Undo your edit; or copy what lies in "
                             f"{FOLDER}/originals over the checkout, by which your edit is lost, and delete {FOLDER}")
    for name in edited:
        back[name] = without_patch(name, back[name], record.patched(name), (root / name).read_bytes())
    check_writable(root, back)
    record.note_complete(False)  # an interruption leaves what `apply` can finish too
    put_back(root, back)
    record.remove()
    reverted = Reverted(back)
    reverted.edited = tuple(edited)
    return reverted


_SINCE = {"changed": "was changed since it was patched", "gone": "was removed since it was patched",
          "replaced": "was changed since, and is not patched any more; `revert` leaves it, and puts back the others",
          "original": "is the original, though the record says that it was patched; `revert` puts back the others too"}


def _state_by_record(root: Path, record: Record, changes: Tuple[Change, ...],
                     trainer: Trainer) -> Tuple[str, List[str]]:
    """How a checkout is that has a record: `patched`, or what the record and the files disagree in."""
    from .patch import Patch

    states = record.states()
    if set(states.values()) <= {"patched", "changed"}:
        by = ", with ".join(filter(None, [f"by version {record.manifest['version']}", words_of(options_of(record))]))
        is_current = all(read_file(root / change.name) == change.after for change in changes)
        files = {} if is_current else {name: read_file(root / name) for name in scripts.python_files(root)}
        if is_current or Patch(files, trainer).state()[0] == "patched":
            return "patched", [by] + [f"{name}: was edited since; every rule for the blend mode is still applied"
                                      for name, state in states.items() if state == "changed"]
        if "changed" not in states.values():
            return "patched", [by, f"its rules were others: to bring it up to date, type: dsmoe patch apply {root}"]
    if record.can_be_finished():
        return "half-patched", ["the patch was interrupted: `apply` finishes it, `revert` takes it back"]
    return "half-patched", [f"{name}: {_SINCE[state]}" for name, state in states.items() if state != "patched"]


def options_of(record: Optional[Record]) -> Tuple[str, ...]:
    """The options that a patch was made with."""
    return tuple(record.manifest["options"]) if record else ()


def words_of(options: Tuple[str, ...]) -> str:
    """The options as they are typed."""
    return " ".join("--" + option for option in options)


def by_name(name: str) -> Trainer:
    for trainer in TRAINERS:
        if trainer.name == name:
            return trainer
    raise PatchError(f"there is no trainer {name!r}; it must be one of {', '.join(names())}")


def _root(path: PathLike) -> Path:
    root = Path(path)
    if not root.is_dir():
        raise PatchError(f"{root}: is not a folder; wanted is the checkout's, in which train.py or compress.py lies")
    return root


def _no_renderer(root: Path) -> str:
    """Says that a folder is no checkout, and which one beside it is."""
    above = root.resolve()
    near = [folder for folder in (*above.parents, *sorted(above.glob("*/"))) if os.path.isfile(str(folder / GR))]
    return f"there is no {GR} in {root}; wanted is the checkout's folder" + (f", such as {near[0]}" if near else "")


def read_file(path: Path) -> Optional[bytes]:
    return path.read_bytes() if path.is_file() else None


def refusal(verdict: Verdict) -> str:
    """Returns why a checkout cannot be patched."""
    trainer = f" ({verdict.trainer})" if verdict.trainer else ""
    return "\n".join([f"the checkout is {verdict}{trainer}:", *("  " + reason for reason in verdict.reasons)])


def diff_of(name: str, before: bytes, after: bytes) -> str:
    """Returns the unified diff of one file."""
    old, new = (io.StringIO(source.decode(name, data)[0], newline="\n").readlines() for data in (before, after))
    lines = difflib.unified_diff(old, new, "a/" + name, "b/" + name)
    return "".join(line if line.endswith("\n") else line + "\n\\ No newline at end of file\n" for line in lines)


def have_libcst() -> None:
    """Raises ImportError, which says what to type, where LibCST is missing."""
    try:
        import libcst  # noqa: F401
    except ImportError as error:
        raise ImportError(f"patching reads and writes Python with LibCST, which cannot be imported ({error}): "
                          "pip install libcst; `dsmoe run` needs no patch") from None
