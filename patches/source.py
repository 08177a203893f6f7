"""A Python file: its text, its tree as Python's own parser has it, and edits of the text where the tree says so."""
from __future__ import annotations

import ast
import io
import re
import tokenize
import warnings
from typing import Any, Dict, Iterable, Iterator, List, NamedTuple, Optional, Tuple


class PatchError(RuntimeError):
    """A refusal in plain words: it names the file and the rule, and nothing was written."""


class Edit(NamedTuple):
    """Another text between two places of a file."""

    start: int
    end: int
    text: str


DONE = Edit(0, 0, "")  # what an edit would bring is there


class Source:
    """A file, without what is not in its tree: its places are counted in bytes of its text as UTF-8."""

    def __init__(self, name: str, data: bytes) -> None:
        """Raises PatchError where it cannot be parsed."""
        self.data = data
        try:
            self.encoding = tokenize.detect_encoding(io.BytesIO(data).readline)[0]
            text = data.decode(self.encoding)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # such as of invalid escapes in a string
                self.tree = ast.parse(text, name)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise PatchError(f"{name}: is not Python that can be parsed: {error}") from None
        self.text = text.encode()
        lines = self.text.splitlines(keepends=True)
        self.newline = "\r\n" if lines and lines[0].endswith(b"\r\n") else "\n"
        self.lines = [0]  # where each begins
        for line in lines:
            self.lines.append(self.lines[-1] + len(line))

    def edited(self, edits: Iterable[Edit]) -> bytes:
        """Returns the file with these edits, of which two at one place keep their order."""
        parts, place = [], 0
        for start, end, text in sorted(edits, key=lambda edit: edit[:2]):
            parts += [self.text[place:start], text.encode()]
            place = end
        return b"".join([*parts, self.text[place:]]).decode().encode(self.encoding)

    def span(self, node: Any) -> Tuple[int, int]:
        """Returns where a node begins and where it ends, without parentheses around it."""
        return (self.lines[node.lineno - 1] + node.col_offset, self.lines[node.end_lineno - 1] + node.end_col_offset)

    def indent(self, statement: ast.stmt) -> str:
        """Returns what is before a statement on its line."""
        start, _ = self.span(statement)
        return self.text[self.lines[statement.lineno - 1]:start].decode()

    def line_before(self, body: List[ast.stmt], place: int, line: str) -> Iterator[Edit]:
        """One more line before a statement of a body and the comments above it; none where it begins no line."""
        statement, indent = body[place], self.indent(body[place])
        number = min(node.lineno for node in (statement, *getattr(statement, "decorator_list", ()))) - 1
        above = body[place - 1].end_lineno if place else 0  # whose own lines may look like comments
        while number > above and self.text[self.lines[number - 1]:self.lines[number]].lstrip()[:1] in (b"", b"#"):
            number -= 1
        if not indent.strip():
            yield Edit(self.lines[number], self.lines[number], f"{indent}{line}{self.newline}")

    def import_of(self, module: str, name: str) -> Iterator[Edit]:
        """`from module import name` behind the imports that the file begins with, or in one of them."""
        body = self.tree.body
        place = int(ast.get_docstring(self.tree) is not None)
        for statement in body[place:]:
            if not isinstance(statement, (ast.Import, ast.ImportFrom)):
                break
            place += 1
            if isinstance(statement, ast.ImportFrom) and statement.module == module:
                if {name, "*"}.isdisjoint(alias.name for alias in statement.names):
                    start = re.compile(rb"import[\s(\\]*").search(self.text, self.span(statement)[0]).end()
                    yield Edit(start, start, name + ", ")
                return
        following = min((body[place], *getattr(body[place], "decorator_list", ())), key=self.span).lineno - 1
        line = self.lines[body[place - 1].end_lineno if place else following]
        blank = "" if self.text[line:].lstrip(b" \t")[:1] in b"\r\n" else self.newline
        yield Edit(line, line, f"from {module} import {name}{self.newline}{blank}")

    def calls(self, name: str) -> Iterator[ast.Call]:
        """Yields the calls of what has this name, with dots in it."""
        return (node for node in self.nodes(ast.Call) if dotted(node.func) == name and self.is_placed(node.func))

    def is_placed(self, name: ast.AST) -> bool:
        """Whether a name is where its node says; before Python 3.12 one in an f-string of some lines is elsewhere."""
        start, end = self.span(name)
        return self.text[start:end].decode(errors="replace") == dotted(name)

    def nodes(self, kind: type) -> Iterator[Any]:
        return (node for node in ast.walk(self.tree) if isinstance(node, kind))


def dotted(node: Optional[ast.AST]) -> str:
    """Returns a name with its dots, "" for other expressions."""
    if isinstance(node, ast.Attribute):
        return dotted(node.value) and f"{dotted(node.value)}.{node.attr}"
    return getattr(node, "id", "")


def on_top(node: ast.AST) -> Iterator[ast.stmt]:
    """Yields the statements of a node that are not inside of a function, a class or a `try`."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt):
            yield child
            if not isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Try)):
                yield from on_top(child)


def keywords_of(call: ast.Call) -> Dict[Any, ast.expr]:
    """Returns the values of a call's keywords; None is the key of `**more`."""
    return {keyword.arg: keyword.value for keyword in call.keywords}
