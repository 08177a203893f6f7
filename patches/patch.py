"""The rules of a trainer, applied to its files in memory. Needs LibCST."""
from __future__ import annotations

from typing import Dict, Iterable, List, NamedTuple, Optional, Tuple

import libcst as cst

from .errors import PatchError
from .rules import ON_REQUEST, Misfit, Rule, rules_of
from .trainers import GR, RASTERIZER, Trainer


class Change(NamedTuple):
    """What becomes of one file."""

    name: str  # relative to the checkout
    before: bytes
    after: bytes
    rules: Tuple[str, ...]


class Patch:
    """What the rules of a trainer make of its files; those files that none of them changes are not in it."""

    def __init__(self, files: Dict[str, bytes], trainer: Trainer, options: Iterable[str] = ()) -> None:
        """options: which rules on request are applied too."""
        self.files = files
        self.trees: Dict[str, cst.Module] = {}  # of each file that was parsed
        self.rules: Dict[str, List[str]] = {}  # of each file, those that changed it
        self.problems: List[str] = []  # why it cannot be patched
        self.pending: List[str] = []  # rules that are not applied, as "FILE: rule NAME"
        self.done: List[str] = []
        self.notes: List[str] = []
        self.requested: Dict[Tuple[str, Rule], List[str]] = {}  # of each option and rule, the files that it changes
        needed = rules_of(trainer)
        for rule in needed:
            self._require(rule)
        # A script of the user's that imports the rasterizer must not get another one than the trainer's own files.
        for name in sorted(set(files) - {GR}):
            if RASTERIZER.encode() in files[name] and not name.startswith("submodules/"):
                self._try(name, needed[0])
                if f"from {RASTERIZER}._C ".encode() in files[name]:
                    self.notes.append(f"{name}: the import from {RASTERIZER}._C stays; where it fails, the file has to "
                                      "do without what it names")
        for option in options:
            for rule in ON_REQUEST[option]:
                self.requested[option, rule] = [name for name in sorted(files) if any(
                    hint.encode() in files[name] for hint in rule.hints) and self._try(name, rule)]

    def state(self) -> Tuple[str, List[str]]:
        """One of engine.STATES, and the reasons."""
        if self.problems:
            return "drifted", self.problems
        if self.done and self.pending:
            return "half-patched", ([f"{line}: is not applied" for line in self.pending]
                                    + [f"{line}: is applied already" for line in self.done])
        return "patched" if self.done else "patchable", []

    def changes(self) -> Tuple[Change, ...]:
        return tuple(Change(name, self.files[name], self.trees[name].bytes, tuple(dict.fromkeys(rules)))
                     for name, rules in self.rules.items())

    def _require(self, rule: Rule) -> None:
        line = f"{rule.file}: rule {rule.name}"
        if rule.file not in self.files:
            self.problems.append(f"{line}: there is no such file; expected is {rule.says}")
            return
        try:
            is_changed = self._apply(rule.file, rule)
        except Misfit as misfit:
            self.problems.append(f"{line}: {misfit}; right would be {rule.says}")
        except PatchError as error:
            self.problems.append(str(error))
        else:
            if is_changed is None:
                self.problems.append(f"{line}: no match; right would be {rule.says}")
            else:
                (self.pending if is_changed else self.done).append(line)

    def _try(self, name: str, rule: Rule) -> bool:
        """Applies a rule that may match or not; returns whether it did. A file that cannot be read stays."""
        try:
            return bool(self._apply(name, rule))
        except PatchError as error:
            note = f"left as it is: {error}"
            self.notes += [note] if note not in self.notes else []
            return False

    def _apply(self, name: str, rule: Rule) -> Optional[bool]:
        """Returns whether the rule changed the file; None where nothing matched."""
        if name not in self.trees:
            self.trees[name] = parse(name, self.files[name])
        changed = rule.change(self.trees[name])
        if changed in (None, self.trees[name]):
            return None if changed is None else False
        self.trees[name] = changed
        self.rules.setdefault(name, []).append(rule.name)
        return True


def parse(name: str, data: bytes) -> cst.Module:
    """Returns the tree of a file. Raises PatchError where it would not come back as it was."""
    try:
        tree = cst.parse_module(data)
    except (cst.ParserSyntaxError, SyntaxError, UnicodeDecodeError) as error:
        raise PatchError(f"{name}: is not Python that can be parsed: {' '.join(str(error).split())}") from None
    if tree.bytes != data:
        raise PatchError(f"{name}: would not be written back as it is; LibCST cannot represent it")
    return tree
