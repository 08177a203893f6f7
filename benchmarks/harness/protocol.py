"""The rules that make two rows comparable, as data: each row carries them. What the trainer writes down is its own."""
from __future__ import annotations

import contextlib
import os
import subprocess
from pathlib import Path
from typing import Any, Dict, Optional

from ..options.config import TrainConfig
from .names import RECIPE

COMMIT_VARIABLE = "DSMOE_COMMIT"  # says the project's commit if its files are not a git checkout
ROOT = str(Path(__file__).resolve().parents[2])  # of the package
BYTES_PER_GAUSSIAN = 4 * 59  # float32 numbers: position 3, SH colours 48, opacity 1, scale 3, quaternion 4

STRONG_GRADIENT = 0.05  # of luminance in [0, 1], per pixel: 13 grey levels from one pixel to the next
EDGE_REACH = 3  # pixels in x and y
EDGE_RULE = (f"8-bit images, pixels within {EDGE_REACH} px (in x and y) of a pixel of the ground truth whose Rec. 601 "
             f"luminance has a Sobel gradient of at least {STRONG_GRADIENT} per pixel; mean over test views that have "
             "such pixels")

RULES = {
    "quantisation": "headline figures on 8-bit images (clamped, rounded); psnr_float on floats clamped to [0, 1]",
    "psnr": "squared error averaged over pixels and channels of one 8-bit image; mean over test views",
    "psnr_edge": EDGE_RULE,
    "lpips": {"lpips_vgg_inria": "VGG, images in [0, 1] as they are, which is what the code of 3DGS feeds",
              "lpips_vgg_std": "VGG, images taken to [-1, 1], as LPIPS is defined",
              "lpips_alex": "AlexNet, images taken to [-1, 1]"},
    "fps": "1 / mean seconds per test view; synchronised before and after; the first views rendered once before; no "
           "disk, no metrics",
    "train_seconds": "the training loop, synchronised; without loading, evaluation and checkpoints",
    "wall_seconds": "the whole cell: loading, training, rendering, measuring; not what an interrupted attempt took",
    "size": "bytes; own: the method's own files; common: 59 float32 numbers for each Gaussian",
    "num_gaussians": "Gaussians of the trained model; for HAC and HAC++ its anchors",
    "peak_gpu_mib": "the most that torch's allocator held while training, ground truth included",
}


def config_of(cell: Dict[str, Any], output: str = "") -> TrainConfig:
    """The cell as options of the native trainer, which have 3DGS's names. Raises ConfigError."""
    protocol, scene = cell["protocol"], cell["scene"]
    config = TrainConfig(
        scene=scene["path"] or "", output=output, blend_mode=cell["blend_mode"],
        background_gate=cell["background_gate"], faint_below=cell.get("faint_below"),
        iterations=protocol["iterations"], batch=protocol.get("batch", 1),
        resolution=scene["resolution"], images=scene["images"], principal_point=protocol["principal_point"],
        white_background=scene["background"] == "white", init_points=scene["init_points"],
        strategy=cell["strategy"] or "3dgs", budget=cell.get("budget", 0), seed=cell["seed"], device=protocol["device"],
        densify_grad_threshold=cell["densify_grad_threshold"], eval_every=protocol["evaluate_every"],
        checkpoint_every=protocol["checkpoint_every"])
    if protocol["scale_recipe"]:
        config = config.shortened()
    return config.changed(**{"strict": True, **protocol["options"]})


def protocol_of(measured: Dict[str, Any], config: TrainConfig, lpips: Any) -> Dict[str, Any]:
    """The protocol of a row: what the trainer's `result_row` says, and the harness. A checkout's notes win over it."""
    rules = {**RULES, "lpips": {row["kind"]: RULES["lpips"][row["kind"]] for row in lpips}}
    return {**measured, **rules, "images": config.images, "downscaler": downscaler(config, measured["downscaler"]),
            "sh_degree": config.sh_degree,
            "recipe": {name: getattr(config, name) for name in RECIPE if getattr(config, name) != ""},
            "eval": "every test view of the split, none left out"}


def downscaler(config: TrainConfig, name: str) -> str:
    from ..scenes.images import image_size, target_size  # they load torch, which a suite does without
    from ..scenes.scene import read_layout

    layout = read_layout(config)
    posed = (list(layout.test) or list(layout.train))[0]
    supplied = image_size(posed.path)
    if target_size(*supplied, config.resolution) == supplied:
        return f"none: files of {config.images} as supplied"
    return name


def project_commit() -> Optional[str]:
    """That of this project's files, as `commit_of` has it; None if nothing says it."""
    known = os.environ.get(COMMIT_VARIABLE) or commit_of(ROOT)
    if known is None:
        with contextlib.suppress(ImportError):
            from diff_smoe_rasterization._build_info import COMMIT as known
    return known


def commit_of(folder: str) -> Optional[str]:
    """The commit that a checkout is at, "+" behind it if tracked files were changed.

    None without git, and for a folder inside of another checkout, whose commit says nothing about it.
    """
    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", folder, *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                              check=True).stdout.decode().strip()

    try:
        if os.path.realpath(git("rev-parse", "--show-toplevel")) != os.path.realpath(folder):
            return None
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
