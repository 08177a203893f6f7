"""Copies of the small trainers, and what tests ask about a folder."""
from __future__ import annotations

import json
import os
import shutil
import stat
from pathlib import Path

import diff_smoe_rasterization

HERE = Path(__file__).resolve().parent
PACKAGE_PARENT = Path(diff_smoe_rasterization.__file__).resolve().parent.parent  # where it is installed, or the tree
PACKAGES = HERE / "packages"  # what the trainers import beside the rasterizer
RECORD = ".dsmoe_patch"

# A trainer is the small 3DGS of 2023 with other files laid over it, without some, and with other lines in some.
LAYERS = {"3dgs-2023": (), "c3dgs": ("c3dgs",), "hac": ("hac",)}
REMOVED = {"c3dgs": ("train.py", "full_eval.py"), "hac": ("render.py", "full_eval.py")}
EDITS = {
    "c3dgs": {"scene/gaussian_model.py": {
        "import Adam, build_covariance\n": "import Adam, build_covariance\n\nfrom scene.compressed import Compressed\n",
        "class GaussianModel:": "class GaussianModel(Compressed):",
        "        np.savez(path, **{":
            "        np.savez(path, indices=torch.stack(self.indices).cpu().numpy(), **{",
        "for name in self.FIELDS})\n": """for name in self.FIELDS})
            self.indices = torch.tensor(saved["indices"], device=data_device).unbind() if "indices" in saved else None
"""}},
}
TRAINERS = tuple(LAYERS)

# Where the patch puts the mode into the pipeline: the functions behind the command lines.
ENTRIES = {"3dgs-2023": {"train.py": ["training"], "render.py": ["render_sets"]},
           "c3dgs": {"compress.py": ["run_vq"], "render.py": ["render_sets"]},
           "hac": {"train.py": ["training", "render_sets"]}}


def make_checkout(name, folder):
    """Copies trainer `name` to `folder`; returns it."""
    folder = Path(folder)
    for layer in ("common", *LAYERS[name]):
        shutil.copytree(HERE / "trainers" / layer, folder, dirs_exist_ok=True,
                        ignore=shutil.ignore_patterns("__pycache__"))
    for file in REMOVED.get(name, ()):
        (folder / file).unlink()
    for file, lines in EDITS.get(name, {}).items():
        text = (folder / file).read_text()
        for before, after in lines.items():
            assert text.count(before) == 1, (file, before)
            text = text.replace(before, after)
        (folder / file).write_text(text)
    return folder


def make_scene(folder, seed=1):
    Path(folder).mkdir(parents=True)
    (Path(folder) / "made_up.json").write_text(json.dumps({"points": 150, "views": 4, "seed": seed}))
    return Path(folder)


def contents(folder, record=True):
    """{path: (mode, bytes or what a link points to)} of all below, without the record if so asked."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        name = path.relative_to(folder).as_posix()
        if record or not (name + "/").startswith((RECORD + "/", RECORD + ".unfinished/")):
            data = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
            found[name] = stat.S_IMODE(path.lstat().st_mode), data
    return found


def changed_files(before, after):
    return {name for name in set(before) | set(after) if before.get(name) != after.get(name)}


def environment(**more):
    """Of a process of a trainer: this package, what else trainers import, one thread."""
    kept = {name: value for name, value in os.environ.items()
            if name not in ("PYTHONDONTWRITEBYTECODE", "DSMOE_BLEND_MODE", "DSMOE_BACKGROUND_GATE")}
    return {**kept, "PYTHONPATH": os.pathsep.join([str(PACKAGES), str(PACKAGE_PARENT)]), "OMP_NUM_THREADS": "1", **more}
