"""Which files of a checkout are looked at, and which of them no rule reaches."""
from __future__ import annotations

import ast
import warnings
from pathlib import Path
from typing import Dict, Iterator, List, Set

from .rules import PipeBlendMode, Trainer

# Not all folders: outputs hold copies of the code, environments whole packages.
FOLDERS = ("", "arguments", "compression", "gaussian_renderer", "lpipsPyTorch", "scene", "utils")
RENDERERS = {"render", "prefilter_voxel"}


def python_files(root: Path) -> Iterator[str]:
    """Yields the names of the checkout's Python files, relative to it."""
    for folder in FOLDERS:
        for path in sorted((root / folder).glob("*.py")):
            if path.is_file():
                yield path.relative_to(root).as_posix()


def build_files(root: Path) -> Iterator[str]:
    """Yields the names of the Python files that say how the checkout's submodules are built."""
    for pattern in ("setup.py", "backend.py"):
        for path in sorted((root / "submodules").glob("*/" + pattern)):
            yield path.relative_to(root).as_posix()


def callers_out_of_reach(files: Dict[str, bytes], trainer: Trainer) -> List[str]:
    """Says which scripts render with a pipeline that no rule gives a blend mode.

    A script is reached where a rule works in it, or where one that is reached imports it (the pipeline is passed on).
    """
    reached = {rule.file for rule in trainer.rules if isinstance(rule, PipeBlendMode)}
    imports = {name: _imports(data) for name, data in files.items() if not name.startswith("submodules/")}
    frontier = list(reached)
    while frontier:
        for module in imports.get(frontier.pop(), ()):
            for name in (module.replace(".", "/") + ".py", module.replace(".", "/") + "/__init__.py"):
                if name in files and name not in reached:
                    reached.add(name)
                    frontier.append(name)
    return [f"{name}: renders, but no rule reaches it: before it renders it needs the statement `pipe.blend_mode = "
            "blend_mode_of(dataset)`, or it stops with an AttributeError"
            for name, modules in sorted(imports.items())
            if name not in reached and b".blend_mode = " not in files[name]
            and RENDERERS & {module.rpartition(":")[2] for module in modules}]


def _imports(data: bytes) -> Set[str]:
    """Returns the modules that a file imports, and "gaussian_renderer:NAME" of what it takes from the renderer."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(data)
    except (SyntaxError, ValueError):
        return set()
    modules: Set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
            if node.module == "gaussian_renderer":
                modules |= {f"{node.module}:{alias.name}" for alias in node.names}
    return modules
