"""Copies of the small trainers, and what tests ask about a folder."""
from __future__ import annotations

import ast
import json
import os
import shutil
import stat
from pathlib import Path

import diff_smoe_rasterization

HERE = Path(__file__).resolve().parent
PACKAGES = HERE / "packages"  # what the trainers import beside the rasterizer
RECORD = ".dsmoe_patch"

# A trainer is these folders of trainers/, one laid over the other.
LAYERS = {"3dgs-2023": ("common", "3dgs-2023"), "3dgs-2024": ("common", "3dgs-2023", "3dgs-2024"),
          "taming": ("common", "3dgs-2023", "taming"), "c3dgs": ("common", "c3dgs"), "hac": ("common", "hac"),
          "hac-plus": ("common", "hac", "hac-plus")}
# HAC++ grew out of HAC: these lines of HAC's files are others in it.
EDITS = {"hac-plus": {
    "train.py": {
        "import torch\n": "import lpips\nimport torch\n",
        "run_codec = True\n": "lpips_fn = lpips.LPIPS(net=\"vgg\").to(\"cpu\")\nrun_codec = True\n",
        """PSNR {psnr(image, view.original_image).item():.9g}")\n    world.gaussians.train()""":
            """PSNR {psnr(image, view.original_image).item():.9g}")
        logger.info(f"step {step}: LPIPS {lpips_fn(image, view.original_image).item():.9g}")
    world.gaussians.train()"""},
    "gaussian_renderer/__init__.py": {
        "(pc.get_opacity_mlp(inputs) * pc.get_mask[visible_mask][..., 0])": "pc.get_opacity_mlp(inputs)",
        "    return xyz, color, neural_opacity[mask], sizes, rot, neural_opacity, mask":
            """    kept = pc.get_mask[visible_mask].view(-1, 1)[mask]
    return xyz, color, neural_opacity[mask] * kept, sizes * kept, rot, neural_opacity, mask"""},
    "arguments/__init__.py": {
        "        self.lambda_dssim = 0.25\n":
            """        self.mlp_hyp_lr_init, self.mlp_hyp_lr_final, self.mlp_hyp_lr_delay_mult = 0.005, 0.001, 0.01
        self.mask_lr_final, self.lambda_dssim = 0.001, 0.25\n"""}}}
TRAINERS = tuple(LAYERS)
WITH_RENDER = ("3dgs-2023", "3dgs-2024", "taming", "c3dgs")

# Where the patch puts the mode into the pipeline: the functions behind the command lines.
ENTRIES = {"3dgs-2023": {"train.py": ["training"], "render.py": ["render_sets"]},
           "c3dgs": {"compress.py": ["run_vq"], "render.py": ["render_sets"]},
           "hac": {"train.py": ["training", "render_sets"]}}
ENTRIES["3dgs-2024"] = ENTRIES["taming"] = ENTRIES["3dgs-2023"]
ENTRIES["hac-plus"] = ENTRIES["hac"]


def make_checkout(name, folder):
    """Copies trainer `name` to `folder`; returns it."""
    for layer in LAYERS[name]:
        shutil.copytree(HERE / "trainers" / layer, folder, dirs_exist_ok=True,
                        ignore=shutil.ignore_patterns("__pycache__"))
    for file, lines in EDITS.get(name, {}).items():
        text = (Path(folder) / file).read_text()
        for before, after in lines.items():
            assert text.count(before) == 1, (file, before)
            text = text.replace(before, after)
        (Path(folder) / file).write_text(text)
    return Path(folder)


def make_scene(folder, seed=1):
    Path(folder).mkdir(parents=True)
    (Path(folder) / "made_up.json").write_text(json.dumps({"points": 150, "views": 4, "seed": seed}))
    return Path(folder)


def contents(folder, record=True):
    """{path: (mode, bytes)} of every file and {path: mode} of every folder below, without the record if so asked."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not record and (name + "/").startswith(RECORD + "/"):
            continue
        mode = stat.S_IMODE(path.lstat().st_mode)
        found[name] = (mode, path.read_bytes()) if path.is_file() else mode
    return found


def changed_files(before, after):
    return {name for name in set(before) | set(after) if before.get(name) != after.get(name)}


class _WithoutImports(ast.NodeTransformer):
    def visit_Import(self, node):
        return ast.Pass()

    visit_ImportFrom = visit_Import


def definitions(path):
    """{qualified name: syntax tree} of each function, and "" for the rest of the file; imports are left out."""
    found = {}

    def collect(body, prefix):
        rest = []
        for node in body:
            if isinstance(node, ast.FunctionDef):
                found[prefix + node.name] = node
            elif isinstance(node, ast.ClassDef):
                collect(node.body, prefix + node.name + ".")
            elif not isinstance(node, ast.Pass):
                rest.append(node)
        found[prefix] = ast.Module(body=rest, type_ignores=[])

    collect(_WithoutImports().visit(ast.parse(path.read_bytes())).body, "")
    return found


def environment(**more):
    """Of a process of a trainer: this package, what else trainers import, one thread."""
    kept = {name: value for name, value in os.environ.items()
            if name not in ("PYTHONDONTWRITEBYTECODE", "DSMOE_BLEND_MODE", "DSMOE_BACKGROUND_GATE")}
    above = Path(diff_smoe_rasterization.__file__).resolve().parent.parent  # where it is installed, or the source tree
    return {**kept, "PYTHONPATH": os.pathsep.join([str(PACKAGES), str(above)]), "OMP_NUM_THREADS": "1", **more}
