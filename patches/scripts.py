"""Which files of a checkout are looked at, and which scripts no rule reaches."""
from __future__ import annotations

import ast
import os
import re
from pathlib import Path
from typing import Dict, Iterator, List, Set

from .source import called_name, python_tree
from .trainers import GR, INTEGRATIONS, RASTERIZER, Trainer

# Not all folders: outputs hold copies of the code, environments whole packages.
FOLDERS = ("", "arguments", "compression", "gaussian_renderer", "lpipsPyTorch", "scene", "utils")
RENDERERS = {"render", "prefilter_voxel", "*"}
SETTINGS = "GaussianRasterizationSettings"
# Signs of an environment, of a run's output and of another checkout.
OF_NO_CHECKOUT = ("pyvenv.cfg", "conda-meta", "cfg_args", GR)


def python_files(root: Path) -> Iterator[str]:
    """Yields the names of the checkout's Python files, relative to it."""
    for folder in FOLDERS:
        yield from (path.relative_to(root).as_posix() for path in sorted((root / folder).glob("*.py"))
                    if path.is_file())


def build_files(root: Path) -> Iterator[str]:
    """Yields the names of the Python files that say how the checkout's submodules are built."""
    for pattern in ("setup.py", "backend.py"):
        yield from (path.relative_to(root).as_posix() for path in sorted((root / "submodules").glob("*/" + pattern)))


def other_files(root: Path) -> Dict[str, bytes]:
    """Returns the Python files elsewhere in the checkout, which no rule changes: scripts of the user's own."""
    found = {}
    for above, folders, names in os.walk(str(root)):
        folders[:] = [name for name in folders if not name.startswith(".")
                      and name not in ("submodules", "site-packages", "__pycache__")
                      and not any(os.path.exists(os.path.join(above, name, sign)) for sign in OF_NO_CHECKOUT)]
        folder = Path(above).relative_to(root)
        for name in names if folder.as_posix() not in (".", *FOLDERS) else ():
            if name.endswith(".py") and os.access(os.path.join(above, name), os.R_OK):  # no link to nothing
                found[(folder / name).as_posix()] = Path(above, name).read_bytes()
    return found


def notes(root: Path, files: Dict[str, bytes], trainer: Trainer) -> List[str]:
    """Says which scripts keep the original rasterizer, make settings without a blend mode, or render without one.

    files: those that rules look at.
    """
    files = {name: data for name, data in files.items() if not name.startswith("submodules/")}
    scripts = {**files, **other_files(root)}
    reached = _reached(scripts, trainer)
    lines = []
    for name, data in sorted(scripts.items()):
        if not any(word in data for word in (RASTERIZER.encode(), b"gaussian_renderer", SETTINGS.encode())):
            continue
        nodes = list(ast.walk(python_tree(data)))
        if any(_imports_original(node, name in files) for node in nodes):
            lines.append(f"{name}: imports the original rasterizer, which no rule changes there; this package's is "
                         f"`from {INTEGRATIONS}.{trainer.flavour} import ...`")
        elif name != GR and any(map(_makes_settings, nodes)):
            lines.append(f"{name}: makes {SETTINGS} of its own without a blend mode, which no rule gives it: without "
                         f"`blend_mode=...` it is $DSMOE_BLEND_MODE, else alpha")
        if name not in reached and not re.search(rb"\.blend\s*=[^=]", data) and any(map(_renders, nodes)):
            lines.append(f"{name}: renders, but no rule reaches it: before it renders it needs the statement "
                         "`pipe.blend = blend_of(dataset)`, or it stops with an AttributeError")
    return lines


def _reached(scripts: Dict[str, bytes], trainer: Trainer) -> Set[str]:
    """A script is reached where a rule works in it, or where one that is reached imports it."""
    reached = {rule.file for rule in trainer.entries}
    frontier = list(reached)
    while frontier:
        for module in _imports(scripts.get(frontier.pop(), b"")):
            path = module.replace(".", "/")
            new = {path + ".py", path + "/__init__.py"} & set(scripts) - reached
            reached |= new
            frontier += new
    return reached


def _imports(data: bytes) -> Set[str]:
    """Returns the modules that a file imports, and what it imports from them: that may be a module too."""
    modules: Set[str] = set()
    for node in ast.walk(python_tree(data)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return modules


def _renders(node: ast.AST) -> bool:
    """Whether it takes what renders from the renderer."""
    if isinstance(node, ast.ImportFrom):
        return node.module == "gaussian_renderer" and any(alias.name in RENDERERS for alias in node.names)
    return isinstance(node, ast.Import) and any(alias.name == "gaussian_renderer" for alias in node.names)


def _imports_original(node: ast.AST, is_looked_at: bool) -> bool:
    """Whether it imports the rasterizer; `from ... import` is a rule's (patch.py) in the files that are looked at."""
    if isinstance(node, ast.ImportFrom):
        return not is_looked_at and not node.level and (node.module or "").partition(".")[0] == RASTERIZER
    return isinstance(node, ast.Import) and any(alias.name.partition(".")[0] == RASTERIZER for alias in node.names)


def _makes_settings(node: ast.AST) -> bool:
    return (isinstance(node, ast.Call) and called_name(node) == SETTINGS
            and not {"blend_mode", None} & {keyword.arg for keyword in node.keywords})  # None: **settings
