"""OUT/results.json: rows that say what was measured, how and on what."""
from __future__ import annotations

import json
import os
from typing import Any, Dict, List, Optional, Union

from diff_smoe_rasterization.settings import GATED_MODES

from ..errors import TrainerError
from ..options.config import LEARNED, TrainConfig, learned_gate_of
from ..options.importance_options import importance_settings
from ..scenes.images import DOWNSCALER
from ..scenes.scene import Scene
from ..system.environment import machine, versions
from ..system.files import is_file, write_json_atomically
from ..system.process import command
from .evaluation import Evaluation

RESULTS_NAME = "results.json"
SSIM = "8-bit images, 11x11 window, sigma 1.5, zero padding, mean over test views"


def result_row(config: TrainConfig, scene: Scene, num_gaussians: int, train_seconds: Optional[float],
               evaluation: Evaluation, psnr_train: Optional[float] = None, background_gate: Optional[float] = None,
               pinhole_every: int = 0) -> Dict[str, Any]:
    """One row: the figures first, then the protocol that makes them comparable.

    psnr_train: over the training views, if it was measured. background_gate: the one that was rendered with; None: the
    config's. pinhole_every: of how many views through lenses the training has shown one by a pinhole.
    """
    views = list(scene.test) or list(scene.train)
    first = views[0].camera
    # Named only if they are not as usual, so that other rows stay comparable with earlier ones.
    unusual: Dict[str, Any] = {}
    if config.background_gate == LEARNED:
        unusual.update(background_gate_learned=True, background_gate_bound=config.background_gate_bound)
        usual = learned_gate_of("smoe_eq7")
        for name in ("background_gate_start", "background_gate_lr"):
            if getattr(config, name) != usual[name]:
                unusual[name] = getattr(config, name)
    if config.unusual_faint is not None:
        unusual["faint_below"] = config.unusual_faint
    if config.batch > 1:
        unusual["batch"] = config.batch
    if config.deterministic:
        unusual["deterministic"] = True
    if config.budget:
        unusual["budget"] = config.budget
    if config.init:
        unusual["init"] = os.path.basename(config.init)
    if config.strategy == "importance":  # with the defaults of this version
        unusual.update(strategy_options=importance_settings(config.importance_options()),
                       densify_until_iter=config.densify_until_iter)
    if config.unusual_recipe():
        unusual["recipe"] = config.unusual_recipe()
    if config.random_background:
        unusual["random_background"] = True
    if scene.missing:
        unusual["images_left_out"] = scene.missing
    if scene.note:
        unusual["undistortion"] = "by OpenCV, bicubic; focal lengths, principal points and sizes stay"
    if any(view.camera.lens for view in views):
        unusual["lenses"] = "native"
    if pinhole_every:
        unusual["pinhole_every"] = pinhole_every
    if any(view.camera.is_panorama for view in views):
        unusual["ssim"] = f"{SSIM}; windows of panoramas go across their seam"
    if any(view.mask is not None for view in views):
        unusual["masks"] = "metrics over the kept pixels; SSIM of images times their masks"
    return {
        "scene": os.path.basename(os.path.abspath(config.scene)),
        "blend_mode": config.blend_mode,
        "background_gate": config.background_gate if background_gate is None else background_gate,
        **evaluation.metrics,
        "psnr_train": psnr_train,
        "num_gaussians": num_gaussians,
        "train_seconds": train_seconds,  # only the loop: without loading, evaluation and checkpoints
        "fps": evaluation.fps,
        "protocol": {
            "scene_kind": scene.kind,
            "split": scene.split,
            "train_views": len(scene.train),
            "test_views": len(scene.test),
            "resolution": config.resolution,
            "image_size": [first.width, first.height],
            "downscaler": DOWNSCALER,
            "background": "white" if config.white_background else "black",
            "principal_point": config.principal_point,
            "strategy": config.strategy,
            "densify_grad_threshold": config.densify_grad_threshold,
            "init_points": len(scene.points.positions),
            "iterations": config.iterations,
            "seed": config.seed,
            "psnr": "8-bit images, mean over test views; psnr_float: floats clamped to [0, 1]",
            "ssim": SSIM,
            **unusual,
            "device": config.device,
            "machine": machine(config.device),
            "versions": versions(),
        },
    }


def write_results(folder: str, rows: List[Dict[str, Any]]) -> None:
    """Writes OUT/results.json."""
    write_json_atomically(os.path.join(folder, RESULTS_NAME), rows)


def read_results(folder: str) -> List[Dict[str, Any]]:
    """The rows of OUT/results.json; none if the file is absent. Raises TrainerError if it is damaged."""
    path = os.path.join(folder, RESULTS_NAME)
    if not is_file(path):
        return []
    try:
        with open(path, encoding="utf-8") as file:
            rows = json.load(file)
    except (ValueError, RecursionError) as error:
        raise TrainerError(f"{path}: not valid json ({error}); remove the file to measure anew") from error
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise TrainerError(f"{path}: expected a list of rows; remove the file to measure anew")
    for row in rows:
        for name, kind in (("protocol", dict), ("train_seconds", (int, float, type(None)))):  # what is read of it
            if name in row and not isinstance(row[name], kind):
                raise TrainerError(f"{path}: `{name}` is {row[name]!r}; remove the file to measure anew")
    return rows


def results_table(rows: List[Dict[str, Any]]) -> str:
    """Rows as a text table: blend mode and gate, PSNR, SSIM, #Gaussians, training seconds, frames per second."""
    header = ("blend mode", "PSNR [dB]", "SSIM", "#Gaussians", "train [s]", "FPS")
    body = [(blend_name(row["blend_mode"], row.get("background_gate"), row.get("protocol", {}).get("faint_below")),
             _number(row["psnr"], 2), _number(row["ssim"], 4), f"{row['num_gaussians']:,}",
             _number(row["train_seconds"], 1), _number(row["fps"], 1)) for row in rows]
    widths = [max(len(line[column]) for line in [header, *body]) for column in range(len(header))]
    lines = ["  ".join(cell.ljust(width) if column == 0 else cell.rjust(width)
                       for column, (cell, width) in enumerate(zip(line, widths))) for line in [header, *body]]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def blend_name(blend_mode: str, background_gate: Union[float, str, None], faint_below: Optional[float] = None) -> str:
    """The blend in words: the mode, in GATED_MODES with its background gate, such as "smoe (gate 0.022)".

    And with its `faint_below`, if that is not as usual.
    """
    if blend_mode not in GATED_MODES or background_gate is None:
        return blend_mode
    gate = background_gate if isinstance(background_gate, str) else format(background_gate, ".2g")
    if faint_below is None:
        return f"{blend_mode} (gate {gate})"
    return f"{blend_mode} (gate {gate}, {'all pairs' if faint_below > 1 else f'faint below {faint_below:g}'})"


def viewer_warning(row: Dict[str, Any], form: str = "ply") -> str:
    """What whoever opens the row's model in a viewer has to know; empty if it is blended by alpha.

    form: the model file's ending.
    """
    if row["blend_mode"] == "alpha" or row["blend_mode"] == "smoe_eq7" and row.get("background_gate") == 1:
        return ""
    return (f"note: the {row['blend_mode']} .{form} holds gates; viewers of 3DGS blend them by alpha and show another "
            f"image, mostly too dark: use `{command()} render`")


def _number(value: Optional[float], digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
