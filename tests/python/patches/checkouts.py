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
SPARSE_ADAM = """
try:
    from diff_gaussian_rasterization import SparseGaussianAdam
    HAS_SPARSE_ADAM = True
except ImportError:
    HAS_SPARSE_ADAM = False
"""

# A trainer is the small 3DGS of 2023 with other files laid over it, without some, and with other lines in some.
LAYERS = {"3dgs-2023": (), "3dgs-2024": ("3dgs-2024",), "taming": ("taming",), "c3dgs": ("c3dgs",), "hac": ("hac",),
          "hac-plus": ("hac", "hac-plus")}
REMOVED = {"c3dgs": ("train.py", "full_eval.py"), "hac": ("render.py", "full_eval.py"),
           "hac-plus": ("render.py", "full_eval.py")}
SPARSE = {"        return Adam(groups, lr=0.0, eps=1e-15)":
          """        if self.kind == "sparse_adam":
            return SparseGaussianAdam(groups, lr=0.0, eps=1e-15)
        return Adam(groups, lr=0.0, eps=1e-15)""",
          "import Adam, build_covariance\n": "import Adam, build_covariance\n" + SPARSE_ADAM}
SPARSE_STEP = {"model.optimizer.step()": """visible = result["radii"] > 0
            model.optimizer.step(*([visible, len(visible)] if opt.optimizer_type == "sparse_adam" else []))"""}
EDITS = {
    "3dgs-2024": {
        "scene/gaussian_model.py": SPARSE,
        "utils/loss_utils.py": {"avg_pool2d\n\n": """avg_pool2d

try:
    from diff_gaussian_rasterization._C import fusedssim, fusedssim_backward
except ImportError:
    fusedssim = fusedssim_backward = None

"""},
        "render.py": {"safe_state, save_image\n": "safe_state, save_image\n" + SPARSE_ADAM,
                      "skip_test: bool)": "skip_test: bool,\n                separate_sh: bool)",
                      "background_of(dataset))[": "background_of(dataset), separate_sh=separate_sh)[",
                      "args.skip_test)": "args.skip_test,\n                HAS_SPARSE_ADAM)"},
        "train.py": {**SPARSE_STEP, "import l1_loss, ssim\n": "import l1_loss, ssim\n" + SPARSE_ADAM,
                     "else fixed)\n": "else fixed,\n                        separate_sh=HAS_SPARSE_ADAM)\n",
                     "        loss.backward()":
                     """        depth_loss = (result["depth"] - view.invdepthmap).abs().mean()
        (loss + 0.1 * depth_loss).backward()"""}},
    "taming": {
        "scene/gaussian_model.py": SPARSE,
        "train.py": {**SPARSE_STEP, "import l1_loss, ssim\n": """import l1_loss
from utils.taming_utils import compute_gaussian_score, compute_photometric_loss
""",
                     "torch.lerp(l1_loss(image, target), 1 - ssim(image, target), opt.lambda_dssim)":
                     "compute_photometric_loss(view, image) + 0 * l1_loss(image, target)",
                     "            if step % opt":
                     """            views_of_all = world.getTrainCameras()
            scores = compute_gaussian_score(views_of_all, model, pipe, fixed)
            print(f"step {step}: loss by Gaussian {scores.sum().item():.9g}")
            if step % opt"""}},
    "c3dgs": {"scene/gaussian_model.py": {
        "import Adam, build_covariance\n": "import Adam, build_covariance\n\nfrom scene.compressed import Compressed\n",
        "class GaussianModel:": "class GaussianModel(Compressed):",
        "        np.savez(path, **{":
            "        np.savez(path, indices=torch.stack(self.indices).cpu().numpy(), **{",
        "for name in self.FIELDS})\n": """for name in self.FIELDS})
            self.indices = torch.tensor(saved["indices"], device=data_device).unbind() if "indices" in saved else None
"""}},
    "hac-plus": {"train.py": {"import torch\n": "import lpips\nimport torch\n",
                              "\ndef training(": "\nlpips_fn = lpips.LPIPS(net='vgg').to('cpu')\n\n\ndef training("}},
}
TRAINERS = tuple(LAYERS)

# Where the patch puts the mode into the pipeline: the functions behind the command lines.
ENTRIES = {"3dgs-2023": {"train.py": ["training"], "render.py": ["render_sets"]},
           "c3dgs": {"compress.py": ["run_vq"], "render.py": ["render_sets"]},
           "hac": {"train.py": ["training", "render_sets"]}}
ENTRIES["3dgs-2024"] = ENTRIES["taming"] = ENTRIES["3dgs-2023"]
ENTRIES["hac-plus"] = ENTRIES["hac"]


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
