"""A Python file: its tree, lines that are put into it, and the file as it was before.

Whatever a patch puts into a file carries a mark, by which it is taken out again. So the files themselves say whether
they are patched, also in a copy, a clone or another commit of the checkout. A mark ends with a digest of what the patch
wrote: if that was edited, the mark stays, and `leftover` names it.

    text  # dsmoe patch DIGEST                      a line of the patch
    # dsmoe patch TRAINER: MODULE DIGEST            the line below it imported from MODULE, and now from another one
    f(**chosen_blend(pipe),  # dsmoe patch DIGEST   up to the next word
"""
from __future__ import annotations

import ast
import codecs
import hashlib
import re
import warnings
from typing import Any, Iterator, Match

MARK = "# dsmoe patch"
# A flag of compilers in the place of one that asks for an old standard.
STANDARD, NO_STANDARD = b"-std=c++14", b"-DDSMOE_PATCH_STD=14"
# Each with the groups `text`, which the patch wrote, and `digest`.
END = rb"[ \t]+# dsmoe patch (?P<digest>\w+)[ \t]*\r?\n"
LINE = re.compile(rb"(?m)^(?P<kept>\xef\xbb\xbf)?[ \t]*(?P<text>\S.*?)" + END)
ARGUMENT = re.compile(rb"(?m)^(?P<kept>[^#\n]*)(?P<text>\*\*\w+\(\w+\),)" + END + rb"[ \t]*")
IMPORT = re.compile(rb"(?m)^[ \t]*# dsmoe patch [\w-]+: (?P<module>\w+) (?P<digest>\w+)\r?\n"
                    rb"(?P<kept>[ \t]*from[ \t]+)(?P<text>[\w.]+)")


class PatchError(RuntimeError):
    """A refusal in plain words: it names the file and the rule, and nothing was written."""


def tree_of(data: bytes) -> ast.Module:
    """Returns the syntax tree of a file. Raises PatchError if it has none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # such as of invalid escapes in a string
            return ast.parse(data)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise PatchError(f"is not Python that can be parsed: {str(error).replace('<unknown>, ', '')}") from None


def digest(text: bytes) -> str:
    """What a mark says of a text that the patch wrote."""
    return hashlib.sha256(text).hexdigest()[:8]


def marked(text: str) -> str:
    """A line of the patch."""
    return f"{text}  {MARK} {digest(text.encode())}"


def unpatched(data: bytes) -> bytes:
    """Returns a file without what a patch put into it; what was edited of that stays, with its mark."""
    for pattern in (IMPORT, ARGUMENT, LINE):
        data = pattern.sub(_as_it_was, data)
    return data.replace(NO_STANDARD, STANDARD)


def _as_it_was(found: Match[bytes]) -> bytes:
    parts = found.groupdict()
    if digest(parts["text"]) != parts["digest"].decode():
        return found[0]
    return (parts["kept"] or b"") + parts.get("module", b"")


def leftover(data: bytes, more: str = "") -> str:
    """Says which line still has the mark (or `more`): an edited line of the patch, or one of the user's; "" if none."""
    found = re.search(rf"(?m)^.*(?:{MARK}|-DDSMOE_PATCH_STD{more}).*".encode(), data)
    return f"still has `{found[0].decode(errors='replace').strip()}`" if found else ""


class Source:
    """A file into which lines are put. Its lines keep the numbers that the tree has."""

    def __init__(self, data: bytes) -> None:
        """Raises PatchError if it cannot be parsed."""
        self.tree = tree_of(data)
        self.bom = codecs.BOM_UTF8 if data.startswith(codecs.BOM_UTF8) else b""
        self.lines = data[len(self.bom):].splitlines(keepends=True)
        self.newline = b"\r\n" if self.lines and self.lines[0].endswith(b"\r\n") else b"\n"

    @property
    def data(self) -> bytes:
        return self.bom + b"".join(self.lines)

    def nodes(self, kind: Any) -> Iterator[Any]:
        return (node for node in ast.walk(self.tree) if isinstance(node, kind))

    def indent(self, number: int) -> bytes:
        """Returns what is before the first word of a line."""
        line = self.lines[number - 1]
        return line[:len(line) - len(line.lstrip(b" \t\f"))]

    def put(self, text: str, statement: ast.stmt) -> None:
        """Puts a line before a statement. Raises PatchError if that does not begin a line."""
        number = min(node.lineno for node in (statement, *getattr(statement, "decorator_list", ())))
        if len(self.indent(number)) != statement.col_offset:
            raise PatchError(f"line {number} has more than one statement")
        if number > 1 and self.lines[number - 2].strip().startswith(MARK.encode()):
            number -= 1  # what it says is of the statement
        self.lines[number - 1] = self.indent(number) + text.encode() + self.newline + self.lines[number - 1]

    def put_on_top(self, text: str) -> None:
        """Puts a line before the first statement that may have one above it, unless it is there."""
        body = self.tree.body[int(ast.get_docstring(self.tree) is not None):]
        later = [line for line in body if getattr(line, "module", "") != "__future__"]
        if not later:
            raise PatchError("it has no statement")
        if text.encode() not in self.data:
            self.put(text, later[0])
