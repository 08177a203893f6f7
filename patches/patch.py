"""The rules of a trainer, applied to its files in memory."""
from __future__ import annotations

from typing import Callable, Dict, Iterable, List, NamedTuple, Optional, Tuple

from . import source
from .codemods import CODEMODS, Found
from .errors import PatchError
from .optional import OPTIONS
from .record import FOLDER
from .trainers import RASTERIZER, Rule, Trainer

Read = Callable[[str], Optional[bytes]]  # the bytes of a file of the checkout, None where there is none


class Change(NamedTuple):
    """What becomes of one file."""

    name: str  # relative to the checkout
    before: bytes
    after: bytes
    rules: Tuple[str, ...]


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
        self.files = files
        self.parsed: Dict[str, Tuple] = {}  # of each file that was, its tree and what makes bytes of it
        self.rules: Dict[str, List[str]] = {}  # of each file, those that changed it
        self.problems: List[str] = []  # why it cannot be patched
        self.pending: List[str] = []  # rules that are not applied, as "FILE: rule NAME"
        self.done: List[str] = []
        self.notes: List[str] = []
        for rule in trainer.rules:
            self._require(rule)
        # A script of the user's that imports the rasterizer must not get another one than the trainer's own files.
        known = {rule.file for rule in trainer.rules if rule.name == "import-rasterizer"}
        for name in sorted(set(files) - known):
            if RASTERIZER.encode() in files[name] and not name.startswith("submodules/"):
                rule = Rule("import-rasterizer", name, trainer.flavour)
                self._try(name, rule.name, CODEMODS[rule.name], rule=rule)
                if f"from {RASTERIZER}._C ".encode() in files[name]:
                    self.notes.append(f"{name}: the import from {RASTERIZER}._C stays; where it fails, the file has to "
                                      "do without what it names")

    def _require(self, rule: Rule) -> None:
        line = f"{rule.file}: rule {rule.name}"
        if rule.file not in self.files:
            self.problems.append(f"{line}: there is no such file; expected is {rule.right}")
            return
        try:
            found = self._run(rule.file, rule.name, CODEMODS[rule.name], rule=rule)
        except PatchError as error:
            self.problems.append(str(error))
            return
        matches = found.pending + found.done
        if not rule.least <= matches <= rule.expected or found.misfits:
            misfits = f", and {found.misfits} that look alike" if found.misfits else ""
            self.problems.append(f"{line}: {matches} matches instead of {rule.expected}{misfits}; right would be "
                                 f"{rule.right}")
        self.pending += [line] if found.pending else []
        self.done += [line] if found.done else []

    def request(self, options: Iterable[str], read_now: Read) -> Tuple[Requested, ...]:
        """Applies the rules of these options; returns what becomes of each. read_now: files patched or not."""
        matching = []
        for option in options:
            for rule in OPTIONS[option]:
                found = {name: self._try(name, rule.name, rule.codemod) for name in sorted(self.files)
                         if rule.looks_at(self.files[name])}
                matching.append((option, rule, {name: counts for name, counts in found.items()
                                                if counts and (counts.pending or counts.done)}))
        after = {change.name: change.after for change in self.changes()}

        def is_pending(rule, name: str) -> bool:
            now = read_now(name)
            if now in (None, self.files[name], after[name]):
                return now != after[name]
            try:  # a file that is patched with other options, or was edited
                counts = Found()
                rule.codemod(source.parse(name, now)[0], counts)
                return counts.pending > 0
            except PatchError:
                return True

        return tuple(Requested(option, rule.name, rule.reason, tuple(found), tuple(
            name for name, counts in found.items() if counts.pending and is_pending(rule, name)))
            for option, rule, found in matching)

    def state(self) -> Tuple[str, List[str]]:
        """One of engine.STATES, and the reasons."""
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
            tree, write = self.parsed[name]
            changes.append(Change(name, self.files[name], write(tree), tuple(dict.fromkeys(rules))))
        return tuple(changes)

    def _try(self, name: str, label: str, codemod: Callable, **words: Rule) -> Optional[Found]:
        """Applies a rule that may match or not; a file that cannot be read is left as it is."""
        try:
            return self._run(name, label, codemod, **words)
        except PatchError as error:
            note = f"left as it is: {error}"
            self.notes += [note] if note not in self.notes else []
            return None

    def _run(self, name: str, label: str, codemod: Callable, **words: Rule) -> Found:
        if name not in self.parsed:
            self.parsed[name] = source.parse(name, self.files[name])
        (tree, write), found = self.parsed[name], Found()
        self.parsed[name] = codemod(tree, found, **words), write
        if found.pending:
            self.rules.setdefault(name, []).append(label)
        return found
