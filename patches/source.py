"""A source file as a syntax tree: of LibCST, which gives the same bytes back, and of Python itself."""
from __future__ import annotations

import ast
import warnings

from .errors import PatchError


def parse(name: str, data: bytes):
    """Returns the LibCST tree of a Python file. Raises PatchError where it would not come back as it was."""
    import libcst

    try:
        tree = libcst.parse_module(data)
    except (libcst.ParserSyntaxError, SyntaxError, UnicodeDecodeError) as error:
        raise PatchError(f"{name}: is not Python that can be parsed: {' '.join(str(error).split())}") from None
    if tree.bytes != data:
        raise PatchError(f"{name}: would not be written back as it is; LibCST cannot represent it")
    return tree


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
