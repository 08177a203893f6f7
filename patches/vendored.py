"""What the rasterizers in a checkout return and blend, if their sources are there: read as text, never run.

In Inria's a Gaussian has alpha = min(0.99, opacity * exp(power)), with power a quadratic form. It adds
colour * alpha * T to a pixel, and the background adds T times its own. A kernel with another of these statements blends
something else.
"""
from __future__ import annotations

import ast
import contextlib
import re
from pathlib import Path
from typing import Any, Collection, Dict, Iterator, List

from .source import PatchError, tree_of

COMMENTS = re.compile(r"//[^\n]*|/\*.*?\*/", re.S)
NAME, SUBSCRIPTS = r"[\w.>-]+", re.compile(r"\[[^\[\]]*\]")
SHARE = r"\w*alpha\w*\*T\w*|T\w*\*\w*alpha\w*"
EXP = rf"\w*exp\w*\({NAME}\)"
# Of each kind the statements, and what one is in a kernel that blends as here; both without blanks and subscripts.
STATEMENTS = {kind: (re.compile(statement), re.compile(expected)) for kind, statement, expected in (
    ("the exponent", r"(?:float|[;{}])power=([^;=]*);",
     rf"-0\.5f?\*\({NAME}\*d\.x\*d\.x\+{NAME}\*d\.y\*d\.y\)-{NAME}\*d\.x\*d\.y"),
    ("alpha", r"alpha=\w*min\w*\([\d.]+f?,([^;]*)\);", rf"{NAME}\*{EXP}|{EXP}\*{NAME}"),
    ("the weight", r"(?:float|[;{}])(?:weight|w|aT)=([^;=]*);", rf"[\d.]+f?|{SHARE}"),
    ("the colour", r"\bC\+=([^;]*);", rf"{NAME}\*\(?({SHARE}|(?!alpha){NAME})\)?|\(?({SHARE}|weight|w|aT)\)?\*{NAME}"),
    ("the pixel", r"\bout_color=([^;]*);", rf"C(\+T\w*\*{NAME})?"))}


def another_blend(root: Path, packages: Collection[str]) -> str:
    """Says which statement of a checkout's forward kernels blends something else; "" if none does or none is there.

    packages: what the checkout imports as its rasterizer; only the kernels of these are read. A statement in a form of
    its own, such as a call of a function that makes alpha, says nothing.
    """
    for path in _kernels(root, packages):
        text = COMMENTS.sub("", path.read_text(errors="replace"))
        text = re.sub(r"\s+", "", text[max(text.find("renderCUDA"), 0):])
        while SUBSCRIPTS.search(text):
            text = SUBSCRIPTS.sub("", text)
        for kind, (pattern, expected) in STATEMENTS.items():
            for found in pattern.finditer(text):
                if not expected.fullmatch(found[1]):
                    return (f"{path.relative_to(root).as_posix()} blends something else than 3DGS: {kind} there is "
                            f"`{found[1][:80]}`")
    return ""


def _kernels(root: Path, packages: Collection[str]) -> List[Path]:
    """Returns the forward kernels of these packages, which their setup.py names."""
    named = re.compile(rf"""name\s*=\s*["'](?:{'|'.join(map(re.escape, sorted(packages)))})["']""")
    setups = [path for pattern in ("*/setup.py", "*/*/setup.py", "*/*/*/setup.py") for path in root.glob(pattern)]
    return sorted({path for setup in setups if named.search(setup.read_text(errors="replace"))
                   for path in setup.parent.glob("cuda_rasterizer/forward.cu")})


def facts_of(root: Path, packages: Collection[str]) -> Iterator[str]:
    """Yields "brings PACKAGE: color, radii" for what the autograd function of a package returns, if all copies agree.

    Its names are closer to the meaning than those of callers, and say what a caller does not unpack.
    """
    for package in packages:
        found = {_returned(path) for folders in ("*/", "*/*/", "*/*/*/")
                 for path in root.glob(f"{folders}{package}/__init__.py")}
        yield from (f"brings {package}: {names}" for names in found if names and len(found) == 1)


def _returned(path: Path) -> str:
    """Returns the names that GaussianRasterizer passes on as they are, "" where it does not, or they have no names."""
    results: Dict[str, List[Any]] = {}
    with contextlib.suppress(PatchError):
        for node in tree_of(path.read_bytes()).body:
            is_autograd = any(getattr(base, "attr", "") == "Function" for base in getattr(node, "bases", ()))
            for method in getattr(node, "body", ()) if isinstance(node, ast.ClassDef) else ():
                if getattr(method, "name", "") == "forward":
                    results.setdefault("Function" if is_autograd else node.name, []).extend(
                        line.value for line in ast.walk(method) if isinstance(line, ast.Return))
    made, passed = results.get("Function", []), results.get("GaussianRasterizer", [])
    is_seen = len(made) == 1 and isinstance(made[0], ast.Tuple) and all(isinstance(one, ast.Call) for one in passed)
    names = [getattr(one, "id", "") for one in made[0].elts] if is_seen else []
    return ", ".join(names) * all(names)
