"""Takes a patch back from a file that was edited since, line by line."""
from __future__ import annotations

import difflib
from typing import List, Tuple

from . import source
from .errors import PatchError

Hunk = Tuple[int, int, List[bytes]]  # the lines first to last - 1 of the patched file become these


def without_patch(name: str, original: bytes, patched: bytes, edited: bytes) -> bytes:
    """Returns the edited file with what the patch changed as it was in the original.

    Raises PatchError, which shows the lines, where an edit and the patch change the same ones, and where the result is
    no Python though the edited file is.
    """
    base, before, now = (data.splitlines(keepends=True) for data in (patched, original, edited))
    undo, edits = _hunks(base, before), _hunks(base, now)
    for edit in edits:
        if edit not in undo and any(_meet(edit, hunk) for hunk in undo):
            raise PatchError(_conflict(name, "you have edited what the patch wrote", base, now))
    merged = list(base)
    for first, last, lines in sorted(undo + [edit for edit in edits if edit not in undo], reverse=True):
        merged[first:last] = lines
    data = b"".join(merged)
    if source.python_tree(edited).body and not source.python_tree(data).body:
        raise PatchError(_conflict(name, "your edit needs statements of the patch", base, now))
    return data


def _hunks(old: List[bytes], new: List[bytes]) -> List[Hunk]:
    opcodes = difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes()
    return [(i, last, new[j:end]) for tag, i, last, j, end in opcodes if tag != "equal"]


def _meet(one: Hunk, other: Hunk) -> bool:
    """Whether they change the same lines, or insert at the same place; those side by side do not meet."""
    return one[0] < other[1] and other[0] < one[1] or one[0] == one[1] == other[0] == other[1]


def _conflict(name: str, reason: str, patched: List[bytes], edited: List[bytes]) -> str:
    texts = ([line.decode("utf-8", "replace").rstrip("\r\n") for line in lines] for lines in (patched, edited))
    lines = list(difflib.unified_diff(*texts, lineterm="", n=0))[2:]
    return (f"{name}: {reason}; nothing was touched. Undo that edit (- the patch's, + yours), then revert:\n"
            + "\n".join("  " + line for line in lines))
