"""Copies of the small trainer, a 3DGS of 2023, and what tests ask about a folder."""
from __future__ import annotations

import json
import os
import shutil
import stat
from pathlib import Path

import diff_smoe_rasterization

HERE = Path(__file__).resolve().parent
PACKAGE_PARENT = Path(diff_smoe_rasterization.__file__).resolve().parent.parent  # its installation, or the tree
PACKAGES = HERE / "packages"  # what trainers import beside the rasterizer


def make_checkout(folder):
    """Copies the small trainer to `folder`; returns it."""
    return shutil.copytree(HERE / "trainer", folder, ignore=shutil.ignore_patterns("__pycache__"))


def make_scene(folder, seed=1):
    Path(folder).mkdir(parents=True)
    (Path(folder) / "made_up.json").write_text(json.dumps({"points": 150, "views": 4, "seed": seed}))
    return Path(folder)


def contents(folder):
    """{path: (mode, bytes or what a link points to)} of all below."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        data = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
        found[path.relative_to(folder).as_posix()] = stat.S_IMODE(path.lstat().st_mode), data
    return found


def environment(**more):
    """Environment of a trainer's process: this package, the trainer's other imports, one thread."""
    kept = {name: value for name, value in os.environ.items()
            if name not in ("PYTHONDONTWRITEBYTECODE", "DSMOE_BLEND_MODE", "DSMOE_BACKGROUND_GATE")}
    return {**kept, "PYTHONPATH": os.pathsep.join([str(PACKAGES), str(PACKAGE_PARENT)]), "OMP_NUM_THREADS": "1", **more}
