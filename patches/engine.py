"""Plans a patch, and makes it, shows it or takes it back. Everything is planned before anything is written.

A plan is made of the files as they were before any patch: those in the record where there is one, else those on disk.
So the plan is the same for a checkout that is patched, half patched by an interruption, or patched with other options,
and to apply it is to write what differs from it.
"""
from __future__ import annotations

import difflib
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, Dict, List, NamedTuple, Optional, Tuple, Union

from diff_smoe_rasterization._version import __version__

from . import facts, record, scripts
from .errors import PatchError
from .merge import without_patch
from .record import FOLDER, Record
from .trainers import GR, TRAINERS, Trainer, names

if TYPE_CHECKING:
    from .patch import Change, Requested  # which need LibCST

STATES = ("unknown", "patchable", "patched", "half-patched", "drifted")
PathLike = Union[str, Path]
OPTIONS = ("modernise", "fuse")


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
    options: Tuple[str, ...]  # of OPTIONS; also those that it was made with
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
            notes += [rule.note() for rule in rules if rule.files]
            skipped = [rule.rule for rule in rules if not rule.files]
            notes += [f"{option}: skipped, nothing matches: {', '.join(skipped)}"] if skipped else []
        return tuple(notes)


def inspect(path: PathLike, modernise: bool = False, trainer: Optional[str] = None, fuse: bool = False) -> Plan:
    """Plans the patch of a checkout in whatever state it is."""
    have_libcst()
    from .patch import Patch

    root = _root(path)
    recorded = Record.in_force(root)
    before = recorded.options if recorded else ()
    options = tuple(name for name, wanted in zip(OPTIONS, (modernise, fuse)) if wanted or name in before)
    files = {name: (root / name).read_bytes()
             for name in scripts.python_files(root, with_submodules="modernise" in options)}
    now = dict(files)
    files.update(recorded.before if recorded else {})
    found = facts.of_files({name: files[name] for name in facts.LOOKED_AT if name in files})
    known, reason = facts.recognise(found)
    name = trainer or (recorded.manifest["trainer"] if recorded else None)
    chosen = by_name(name) if name else known
    if chosen is not None and (not chosen.entries or facts.has_a_name_of_its_own(found)):
        reason = reason or f"its rasterizer is {chosen.flavour}, for which there is no patch: use `dsmoe run`"
        chosen = None
    if GR not in files or chosen is None or facts.uses_another_rasterizer(found):
        return Plan(root, Verdict("unknown", None, [reason if GR in files else _no_renderer(root)]), options, recorded)
    patch = Patch(files, chosen)
    requested = [rule._replace(pending=()) if rule.option in before else rule for rule in patch.request(options)]
    changes = patch.changes()
    state, reasons = patch.state()
    if recorded and not patch.problems:
        state, reasons = _state_by_record(recorded, now, changes, chosen)
    elif state == "patchable" and (root / FOLDER).exists():
        reasons = [f"no file is patched any more: `apply` replaces the {FOLDER} that is there, `revert` removes it"]
    warnings = [] if not trainer or known and known.flavour == chosen.flavour else [
        f"--trainer {trainer}: by what it imports and calls this is {known.name}, whose rasterizer has another API "
        f"({known.flavour}, not {chosen.flavour})" if known else f"--trainer {trainer}: {reason}"]
    return Plan(root, Verdict(state, chosen.name, reasons), options, recorded, changes,
                (*warnings, *patch.notes, *scripts.notes(root, files, chosen)), tuple(requested))


def plan(path: PathLike, **options: Any) -> Plan:
    """Plans a patch, with the options of `inspect`. Raises PatchError where it is refused."""
    planned = inspect(path, **options)
    states = set(planned.record.states().values()) if planned.record else {"not finished"}
    if planned.verdict in ("patchable", "patched") or states <= {"patched", "original"}:
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
    root, todo = planned.root, pending(planned)
    if not todo:
        return planned
    before = {change.name: change.before for change in planned.changes}
    after = {change.name: change.after for change in planned.changes}
    record.check_writable(root, todo)
    try:
        if planned.record:
            record.write_files(root, planned.record.before)
        record.remove(root)
        Record.make(root, before, after, {"version": __version__, "trainer": planned.verdict.trainer,
                                          "options": planned.options})
        record.write_files(root, after)
    except OSError as error:
        if (root / FOLDER).exists():  # of this patch or of the one before
            record.write_files(root, before)
        record.remove(root)
        raise PatchError(f"{error.filename2 or error.filename or FOLDER}: cannot be written, so all was put back: "
                         f"{error}") from None
    return planned._replace(written=True, requested=tuple(rule._replace(pending=()) for rule in planned.requested))


def pending(planned: Plan) -> Dict[str, bytes]:
    """Returns what `apply` would write, by the files' names. Raises PatchError where it refuses."""
    recorded = planned.record
    if planned.verdict == "patched" and recorded is None:
        if planned.options and planned.changes:
            raise PatchError(f"{planned.changes[0].name}: rule {planned.changes[0].rules[0]} is not applied, but the "
                             f"checkout is patched and has no {FOLDER}: take the patch back by your version control, "
                             f"then apply it with {words_of(planned.options)}")
        return {}
    edited = [name for name, state in recorded.states().items() if state == "changed"] if recorded else []
    if recorded and edited:
        if planned.options == recorded.options:
            return {}  # nothing is written over an edit
        raise PatchError(f"{edited[0]}: was changed since it was patched: undo your edit, then apply it with "
                         f"{words_of(planned.options)}")
    wanted = {**(recorded.before if recorded else {}), **{change.name: change.after for change in planned.changes}}
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
    recorded = Record.in_force(root)
    if recorded is None and record.remove(root):
        return Reverted()
    if recorded is None:
        raise PatchError(f"{root}: there is no {FOLDER}, so nothing can be put back: it was not patched, or by hand")
    states = recorded.states()
    back = {name: recorded.before[name] for name, state in states.items() if state in ("patched", "changed")}
    edited = [name for name in back if states[name] == "changed"]
    for name, state in states.items():
        if state == "gone" or name in edited and name not in recorded.after:
            raise PatchError(f"{name}: {_SINCE[state]}; nothing was touched. Undo your edit; or copy what lies in "
                             f"{FOLDER}/originals over the checkout, by which your edit is lost, and delete {FOLDER}")
    for name in edited:
        back[name] = without_patch(name, back[name], recorded.after[name], (root / name).read_bytes())
    record.check_writable(root, back)
    record.write_files(root, back)
    record.remove(root)
    reverted = Reverted(back)
    reverted.edited = tuple(edited)
    return reverted


_SINCE = {"changed": "was changed since it was patched", "gone": "was removed since it was patched",
          "replaced": "was changed since, and is not patched any more; `revert` leaves it, and puts back the others",
          "original": "is not patched, or not any more: `apply` finishes the patch, `revert` takes it back"}


def _state_by_record(recorded: Record, now: Dict[str, bytes], changes: Tuple[Change, ...],
                     trainer: Trainer) -> Tuple[str, List[str]]:
    """How a checkout is that has a record: `patched`, or what the record and the files disagree in."""
    from .patch import Patch

    states = recorded.states()
    edited = [name for name, state in states.items() if state == "changed"]
    if set(states.values()) <= {"patched", "changed"}:
        by = ", with ".join(filter(None, [f"by version {recorded.manifest['version']}", words_of(recorded.options)]))
        is_current = all(now.get(change.name) == change.after for change in changes)
        if is_current or Patch(now, trainer).state()[0] == "patched":
            return "patched", [by] + [f"{name}: was edited since; every rule for the blend mode is still applied"
                                      for name in edited]
        if not edited:
            return "patched", [by, f"its rules were others: to bring it up to date, type: dsmoe patch apply "
                                   f"{recorded.root}"]
    return "half-patched", [f"{name}: {_SINCE[state]}" for name, state in states.items() if state != "patched"]


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
    near = [folder for folder in (*above.parents, *sorted(above.glob("*/"))) if (folder / GR).is_file()]
    return f"there is no {GR} in {root}; wanted is the checkout's folder" + (f", such as {near[0]}" if near else "")


def refusal(verdict: Verdict) -> str:
    """Returns why a checkout cannot be patched."""
    trainer = f" ({verdict.trainer})" if verdict.trainer else ""
    return "\n".join([f"the checkout is {verdict}{trainer}:", *("  " + reason for reason in verdict.reasons)])


def diff_of(name: str, before: bytes, after: bytes) -> str:
    """Returns the unified diff of one file."""
    old, new = (io.StringIO(_text(data), newline="\n").readlines() for data in (before, after))
    lines = difflib.unified_diff(old, new, "a/" + name, "b/" + name)
    return "".join(line if line.endswith("\n") else line + "\n\\ No newline at end of file\n" for line in lines)


def _text(data: bytes) -> str:
    import libcst

    return data.decode(libcst.parse_module(data).encoding)


def have_libcst() -> None:
    """Raises ImportError, which says what to type, where LibCST is missing."""
    try:
        import libcst  # noqa: F401
    except ImportError as error:
        raise ImportError(f"patching reads and writes Python with LibCST, which cannot be imported ({error}): "
                          "pip install libcst; `dsmoe run` needs no patch") from None
