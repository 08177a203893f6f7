"""The rules of a trainer, applied to its files in memory."""
from __future__ import annotations

from typing import Callable, Dict, Iterable, List, NamedTuple, Optional, Tuple

from . import codemods, fuse, modernise, optional, source
from .errors import PatchError
from .record import FOLDER
from .rules import RASTERIZER, ImportRasterizer, Trainer


class Change(NamedTuple):
    """What becomes of one file."""

    name: str  # relative to the checkout
    before: bytes
    after: bytes
    rules: Tuple[str, ...]


OPTIONS = {"modernise": modernise.RULES, "fuse": fuse.RULES}


class Requested(NamedTuple):
    """What becomes of a rule that an option asks for; without files nothing matches it."""

    option: str
    rule: str
    reason: str
    files: Tuple[str, ...]  # that it changes, or had changed when they were read: as they were before any known patch
    pending: Tuple[str, ...]  # those of them in which it is not applied, as they are now

    def note(self, written: bool) -> str:
        """Says where it is applied and where not. written: whether the patch was, since this was found."""
        todo = () if written else self.pending
        states = {"applied in": [name for name in self.files if name not in todo], "not applied in": todo}
        said = ", ".join(f"{state} {', '.join(names)}" for state, names in states.items() if names)
        return f"{self.option} {self.rule}: {said}: {self.reason}"


class Patch:
    """What the rules of a trainer make of its files; those files that none of them changes are not in it."""

    def __init__(self, files: Dict[str, bytes], trainer: Trainer) -> None:
        self.files, self.trees, self.writers = files, {}, {}
        self.rules: Dict[str, List[str]] = {}  # of each file, those that changed it
        self.problems: List[str] = []  # why it cannot be patched
        self.pending: List[str] = []
        self.done: List[str] = []
        self.notes: List[str] = []
        for rule in trainer.rules:
            if rule.file not in files:
                self.problems.append(f"{rule.file}: rule {rule.name}: there is no such file; expected is {rule.right}")
                continue
            try:
                outcome = self._run(codemods.run, rule, rule.file)
            except PatchError as error:
                self.problems.append(str(error))
                continue
            found = outcome.pending + outcome.done
            line = f"{rule.file}: rule {rule.name}"
            if not getattr(rule, "least", rule.expected) <= found <= rule.expected or outcome.misfits:
                misfits = f", and {outcome.misfits} that look alike" if outcome.misfits else ""
                self.problems.append(f"{line}: {found} matches instead of {rule.expected}{misfits}; right would be "
                                     f"{rule.right}")
            if outcome.pending:
                self.pending.append(line)
            if outcome.done:
                self.done.append(line)
        # A script of the user's that imports the rasterizer must not get another one than the trainer's own files.
        known = {rule.file for rule in trainer.rules if isinstance(rule, ImportRasterizer)}
        for name in sorted(set(files) - known):
            if RASTERIZER.encode() in files[name] and not name.startswith("submodules/"):
                self._tried(codemods.run, ImportRasterizer(name, trainer.flavour), name)
                if f"from {RASTERIZER}._C ".encode() in files[name]:
                    self.notes.append(f"{name}: the import from {RASTERIZER}._C stays; where it fails, the file has to "
                                      "do without what it names")

    def request(self, options: Iterable[str], read_now: Callable[[str], Optional[bytes]]) -> Tuple[Requested, ...]:
        """Applies the rules of these of OPTIONS; returns what becomes of each.

        read_now: the bytes of a file as it is now, patched or not; None where it is gone.
        """
        found = {(option, rule): {name: self._tried(optional.run, rule, name) for name in sorted(self.files)
                                  if rule.looks_at(self.files[name])}
                 for option in options for rule in OPTIONS[option]}
        states = {change.name: (read_now(change.name), change.after) for change in self.changes()}
        requested = []
        for (option, rule), outcomes in found.items():
            names = tuple(name for name, outcome in outcomes.items() if outcome and (outcome.pending or outcome.done))
            pending = tuple(name for name in names if outcomes[name].pending
                            and self._is_pending(rule, name, *states[name]))
            requested.append(Requested(option, rule.name, rule.reason, names, pending))
        return tuple(requested)

    def _is_pending(self, rule: optional.Rule, name: str, now: Optional[bytes], after: bytes) -> bool:
        """Whether a rule that changes a file is still to be applied to what the file is now.

        after: what the file is once every rule is applied.
        """
        if now is None or now == self.files[name]:
            return True
        if now == after:
            return False
        try:
            return rule.looks_at(now) and optional.run(rule, source.parse(name, now)[0]).pending > 0
        except PatchError:  # an edit that cannot be read
            return True

    def _tried(self, run, rule, name: str) -> Optional[codemods.Outcome]:
        """Applies a rule that may match or not; a file that cannot be read is left as it is."""
        try:
            return self._run(run, rule, name)
        except PatchError as error:
            note = f"left as it is: {error}"
            self.notes += [note] if note not in self.notes else []
            return None

    def state(self) -> Tuple[str, List[str]]:
        if self.problems:
            return "drifted", self.problems
        if self.done and self.pending:
            return "half-patched", ([f"{line}: is not applied" for line in self.pending]
                                    + [f"{line}: is applied already" for line in self.done])
        if self.done:
            return "patched", [f"every rule is applied; there is no {FOLDER}, so `revert` cannot undo it"]
        return "patchable", []

    def changes(self) -> Tuple[Change, ...]:
        changes = []
        for name, rules in self.rules.items():
            after = self.writers[name](self.trees[name])
            changes.append(Change(name, self.files[name], after, tuple(dict.fromkeys(rules))))
        return tuple(changes)

    def _run(self, run, rule, name: str):
        if name not in self.trees:
            self.trees[name], self.writers[name] = source.parse(name, self.files[name])
        outcome = run(rule, self.trees[name])
        self.trees[name] = outcome.tree
        if outcome.pending:
            self.rules.setdefault(name, []).append(rule.name)
        return outcome
