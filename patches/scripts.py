"""Which files of a checkout are looked at, and which scripts no rule reaches."""
from __future__ import annotations

import ast
import os
import re
from pathlib import Path
from typing import Dict, Iterator, List, Set

from . import facts
from .trainers import GR, INTEGRATIONS, RASTERIZER, RUNTIME, Trainer

# Not all folders: outputs hold copies of the code, environments whole packages.
FOLDERS = ("", "arguments", "compression", "gaussian_renderer", "lpipsPyTorch", "scene", "utils")
SETTINGS = "GaussianRasterizationSettings"
# Signs of an environment, of a run's output and of another checkout.
OF_NO_CHECKOUT = ("pyvenv.cfg", "conda-meta", "cfg_args", GR)


def python_files(root: Path, with_submodules: bool = False) -> Iterator[str]:
    """Yields the names of the files that rules look at: the checkout's, and how its submodules are built."""
    patterns = [f"{folder}/*.py".lstrip("/") for folder in FOLDERS]
    patterns += ["submodules/*/setup.py", "submodules/*/backend.py"] if with_submodules else []
    for pattern in patterns:
        yield from (path.relative_to(root).as_posix() for path in sorted(root.glob(pattern)) if path.is_file())


def other_files(root: Path) -> Dict[str, bytes]:
    """Returns the Python files elsewhere in the checkout, which no rule changes: scripts of the user's own."""
    found = {}
    for above, folders, names in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")
                      and name not in ("submodules", "site-packages", "__pycache__")
                      and not any(Path(above, name, sign).exists() for sign in OF_NO_CHECKOUT)]
        folder = Path(above).relative_to(root)
        for name in names if folder.as_posix() not in (".", *FOLDERS) else ():
            if name.endswith(".py") and os.access(Path(above, name), os.R_OK):  # no link to nothing
                found[(folder / name).as_posix()] = Path(above, name).read_bytes()
    return found


def of_one_name(root: Path) -> List[str]:
    """Says which rasterizers of one name a checkout brings, such as one for each kind of lens."""
    own = sorted(path.parent.name for path in root.glob(f"submodules/*/{RASTERIZER}"))
    return [f"the checkout has {', '.join(own)}, all called {RASTERIZER}: this package's takes the place of each, and "
            "renders pinhole cameras alone"] if len(own) > 1 else []


def notes(root: Path, files: Dict[str, bytes], trainer: Trainer) -> List[str]:
    """Says which scripts keep the original rasterizer, make settings without a blend mode, or render without one.

    files: those that rules look at.
    """
    files = {name: data for name, data in files.items() if not name.startswith("submodules/")}
    scripts = {**files, **other_files(root)}
    imported = set().union(*map(_imports, scripts.values()))
    lines = of_one_name(root)
    for name, data in sorted(scripts.items()):
        if not any(word in data for word in (RASTERIZER.encode(), b"gaussian_renderer", SETTINGS.encode())):
            continue
        found = facts.of_files({name: data})
        # `from ... import` is a rule's in the files that are looked at.
        if "keeps the original" in found or "keeps the original by name" in found and name not in files:
            lines.append(f"{name}: imports the original rasterizer, which no rule changes there; this package's is "
                         f"`from {INTEGRATIONS}.{trainer.flavour} import ...`")
        elif name != GR and "blends by default" in found:
            lines.append(f"{name}: makes {SETTINGS} of its own without a blend mode, which no rule gives it: without "
                         f"`blend_mode=...` it is $DSMOE_BLEND_MODE, else alpha")
        is_reached = (name in {entry.file for entry in trainer.entries} or re.search(rb"\.blend\s*=[^=]", data)
                      or name[:-len(".py")].replace("/", ".") in imported)
        if "renders" in found and not is_reached:
            mode = "blend_of" if "calls backward" in found else "saved_blend_of"
            lines.append(f"{name}: renders, but no rule reaches it: before it renders it needs the statements "
                         f"`from {RUNTIME} import {mode}` and `pipe.blend = {mode}(dataset)`, or it stops with an "
                         "AttributeError")
    return lines


def _imports(data: bytes) -> Set[str]:
    """Returns the modules that a file imports, and what it imports from them: that may be a module too."""
    modules: Set[str] = set()
    for node in ast.walk(facts.python_tree(data)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return modules
