"""A source file as text and as a syntax tree, and back to the same bytes."""
from __future__ import annotations

import ast
import io
import tokenize
import warnings
from typing import Tuple

from .errors import PatchError


def decode(name: str, data: bytes) -> Tuple[str, str]:
    """Returns the text of a Python file, newlines untouched, and the encoding that makes the same bytes of it."""
    try:
        encoding = tokenize.detect_encoding(io.BytesIO(data).readline)[0]  # "utf-8-sig" where there is a BOM
        return data.decode(encoding), encoding
    except (SyntaxError, UnicodeDecodeError) as error:
        raise PatchError(f"{name}: cannot be decoded: {error}") from None


def parse(name: str, data: bytes):
    """Returns the LibCST tree of a Python file, and a function that makes the file's bytes of a tree.

    Raises PatchError where the file cannot be read, or would not come back as it was.
    """
    import libcst

    text, encoding = decode(name, data)
    code = text.rstrip(" \t\f")  # LibCST drops blanks after the last newline
    rest = text[len(code):]
    try:
        tree = libcst.parse_module(code)
    except libcst.ParserSyntaxError as error:
        raise PatchError(f"{name}: is not Python that can be parsed: {_where(data) or error.message}") from None

    def write(changed) -> bytes:
        return (changed.code + rest).encode(encoding)

    if write(tree) != data:
        raise PatchError(f"{name}: would not be written back as it is; LibCST cannot represent it")
    return tree, write


def _where(data: bytes) -> str:
    """Returns what Python itself says of a file that LibCST cannot parse."""
    try:
        ast.parse(data)
    except (SyntaxError, ValueError) as error:  # a ValueError of a null byte, as some Pythons have it
        line = getattr(error, "lineno", None)
        return f"line {line}: {error.msg}" if line else str(error)
    return ""


def python_tree(data: bytes) -> ast.Module:
    """Returns the syntax tree of a file as Python's own parser has it; of one that cannot be parsed an empty one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # such as of invalid escapes in a string
        try:
            return ast.parse(data)
        except (SyntaxError, ValueError):
            return ast.Module(body=[], type_ignores=[])


def called_name(call: ast.Call) -> str:
    """Returns the last part of the name that is called: c of a.b.c(...)."""
    return getattr(call.func, "attr", getattr(call.func, "id", ""))
