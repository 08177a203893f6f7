"""The rules of a trainer, applied to its files in memory."""
from __future__ import annotations

from functools import partial
from typing import Callable, Dict, Iterable, List, NamedTuple, Optional, Tuple

import libcst as cst

from . import codemods, source
from .codemods import Found
from .errors import PatchError
from .optional import OPTIONS
from .record import FOLDER
from .trainers import ARGUMENTS, GR, RASTERIZER, Trainer


class Rule(NamedTuple):
    """What has to change in one file."""

    file: str  # relative to the checkout
    name: str
    right: str  # what it looks for
    codemod: Callable[[cst.Module, Found], cst.Module]


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
    pending: Tuple[str, ...]  # those of them in which it is not applied

    def note(self) -> str:
        """Says where it is applied and where not."""
        states = {"applied in": [name for name in self.files if name not in self.pending],
                  "not applied in": self.pending}
        said = ", ".join(f"{state} {', '.join(names)}" for state, names in states.items() if names)
        return f"{self.option} {self.rule}: {said}: {self.reason}"


def rules_of(trainer: Trainer) -> List[Rule]:
    """The rules of a trainer; each has to match."""
    import_rule = Rule(GR, "import-rasterizer", f"`from {RASTERIZER} import ...`",
                       partial(codemods.rasterizer_import, flavour=trainer.flavour))
    settings = Rule(GR, "settings-blend-mode", "a call of GaussianRasterizationSettings by keyword, in a function "
                    "whose pipeline argument it names in `debug=pipe.debug`", codemods.settings_blend)
    # Of the groups of options only ModelParams is saved in cfg_args.
    options = Rule(ARGUMENTS, "model-parameter", "a class ModelParams whose __init__ has the statement "
                   "`super().__init__(...)`", codemods.model_options)
    return [import_rule, settings, options, *(
        Rule(entry.file, "pipe-blend-mode", f"a function {entry.function} with the parameters {entry.dataset} and "
             f"{entry.pipe}", partial(codemods.pipe_blend, entry=entry)) for entry in trainer.entries)]


class Patch:
    """What the rules of a trainer make of its files; those files that none of them changes are not in it."""

    def __init__(self, files: Dict[str, bytes], trainer: Trainer) -> None:
        self.files = files
        self.trees: Dict[str, cst.Module] = {}  # of each file that was parsed
        self.rules: Dict[str, List[str]] = {}  # of each file, those that changed it
        self.problems: List[str] = []  # why it cannot be patched
        self.pending: List[str] = []  # rules that are not applied, as "FILE: rule NAME"
        self.done: List[str] = []
        self.notes: List[str] = []
        rules = rules_of(trainer)
        for rule in rules:
            self._require(rule)
        # A script of the user's that imports the rasterizer must not get another one than the trainer's own files.
        for name in sorted(set(files) - {GR}):
            if RASTERIZER.encode() in files[name] and not name.startswith("submodules/"):
                self._try(name, rules[0].name, rules[0].codemod)
                if f"from {RASTERIZER}._C ".encode() in files[name]:
                    self.notes.append(f"{name}: the import from {RASTERIZER}._C stays; where it fails, the file has to "
                                      "do without what it names")

    def _require(self, rule: Rule) -> None:
        line = f"{rule.file}: rule {rule.name}"
        if rule.file not in self.files:
            self.problems.append(f"{line}: there is no such file; expected is {rule.right}")
            return
        try:
            found = self._run(rule.file, rule.name, rule.codemod)
        except PatchError as error:
            self.problems.append(str(error))
            return
        if found.misfits or not found.pending + found.done:
            misfits = f"{found.misfits} that look alike" if found.misfits else "no match"
            self.problems.append(f"{line}: {misfits}; right would be {rule.right}")
        self.pending += [line] if found.pending else []
        self.done += [line] if found.done else []

    def request(self, options: Iterable[str]) -> Tuple[Requested, ...]:
        """Applies the rules of these options; returns what becomes of each."""
        requested = []
        for option in options:
            for rule in OPTIONS[option]:
                found = {name: self._try(name, rule.name, rule.codemod) for name in sorted(self.files)
                         if rule.looks_at(self.files[name])}
                matching = {name: counts for name, counts in found.items() if counts and counts != Found()}
                requested.append(Requested(option, rule.name, rule.reason, tuple(matching), tuple(
                    name for name, counts in matching.items() if counts.pending)))
        return tuple(requested)

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
        return tuple(Change(name, self.files[name], self.trees[name].bytes, tuple(dict.fromkeys(rules)))
                     for name, rules in self.rules.items())

    def _try(self, name: str, label: str, codemod: Callable) -> Optional[Found]:
        """Applies a rule that may match or not; a file that cannot be read is left as it is."""
        try:
            return self._run(name, label, codemod)
        except PatchError as error:
            note = f"left as it is: {error}"
            self.notes += [note] if note not in self.notes else []
            return None

    def _run(self, name: str, label: str, codemod: Callable) -> Found:
        if name not in self.trees:
            self.trees[name] = source.parse(name, self.files[name])
        found = Found()
        self.trees[name] = codemod(self.trees[name], found)
        if found.pending:
            self.rules.setdefault(name, []).append(label)
        return found
