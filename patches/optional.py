"""Rules that a patch has on request alone: those of --modernise and of --fuse."""
from __future__ import annotations

from typing import NamedTuple, Tuple, Type

import libcst as cst

from .codemods import Codemod, Outcome


class Rule(NamedTuple):
    """One of them."""

    name: str
    reason: str
    codemod: Type[Codemod]
    hints: Tuple[str, ...]  # a file without any of these words cannot match and is not parsed

    def looks_at(self, data: bytes) -> bool:
        return any(hint.encode() in data for hint in self.hints)


def run(rule: Rule, tree: cst.Module) -> Outcome:
    """Applies a rule to a tree."""
    return rule.codemod(rule).applied_to(tree)
