"""The images of a report: ground truth, renderings and their errors, of every scene, setting and view that has them."""
from __future__ import annotations

import math
import os
import shutil
from typing import Any, Dict, List, Sequence

import matplotlib
import numpy as np
from PIL import Image

from ..names import CELLS_FOLDER
from ..rows import ReportError, Row
from .groups import Group, grouped, safe_name
from .layouts import end_of

IMAGES_FOLDER = "images"
TRUTH = "ground truth"
ERROR_FULL_SCALE = 0.25  # the mean absolute difference over channels, of 1, that takes the colour map's brightest end
ERROR_COLORS = "inferno"


def collect(results: str, suite: str, rows: Sequence[Row], output: str) -> List[Dict[str, Any]]:
    """Copies the images of a suite's cells to OUTPUT/images and draws their errors.

    Of several seeds that is taken which the most blends have images of. Returns for every scene, with paths
    relative to OUTPUT:
      {"scene", "settings": [{"label", "views": [{"name", "width", "height", "layers": [{"label", "path", "note"}]}]}]}
    """
    found: Dict[str, Dict[Any, List[Group]]] = {}
    for group in grouped(rows, end_of):
        if _images_of(results, group):
            found.setdefault(group.scene, {}).setdefault(group.setting.pair, []).append(group)
    scenes = []
    for scene, pairs in found.items():
        settings = []
        for number, groups in enumerate(pairs.values()):
            folder = os.path.join(IMAGES_FOLDER, safe_name(f"{suite}-{scene}-{number}"))
            label = groups[0].setting.label(blend=False)
            settings.append({"label": f"{label}, threshold {groups[0].setting.amount()}"
                                      if groups[0].setting.threshold is not None or groups[0].setting.budget is not None
                                      else label,
                             "views": _views(results, groups, output, folder)})
        scenes.append({"scene": scene, "settings": [setting for setting in settings if setting["views"]]})
    return [scene for scene in scenes if scene["settings"]]


def error_image(truth: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Colours [H, W, 3] uint8 of the absolute difference of two images [H, W, 3] uint8, averaged over channels."""
    difference = np.abs(truth.astype(np.float32) - image.astype(np.float32)).mean(axis=2) / 255
    colors = matplotlib.colormaps[ERROR_COLORS](np.clip(difference / ERROR_FULL_SCALE, 0, 1))
    return (colors[..., :3] * 255 + 0.5).astype(np.uint8)


def _images_of(results: str, group: Group) -> Dict[int, str]:
    """The images folder of each seed that has one."""
    folders = {row["seed"]: os.path.join(results, CELLS_FOLDER, row["cell"], "images") for row in group.rows}
    return {seed: folder for seed, folder in folders.items()
            if all(os.path.isdir(os.path.join(folder, kind)) for kind in ("gt", "render"))}


def _views(results: str, groups: Sequence[Group], output: str, folder: str) -> List[Dict[str, Any]]:
    """The views that every blend of a setting has, of one seed: the first of those that the most have."""
    by_blend = {group.setting.blend: _images_of(results, group) for group in groups}
    seeds = sorted({seed for found in by_blend.values() for seed in found})
    seed = max(seeds, key=lambda seed: sum(seed in found for found in by_blend.values()))
    folders = {blend: found[seed] for blend, found in by_blend.items() if seed in found}
    names = set.intersection(*(set(os.listdir(os.path.join(source, kind))) for source in folders.values()
                               for kind in ("gt", "render")))
    views = []
    for number, name in enumerate(sorted(name for name in names if name.lower().endswith(".png"))):
        stem = f"{number:03d}-{safe_name(os.path.splitext(name)[0])}"
        os.makedirs(os.path.join(output, folder), exist_ok=True)
        first = os.path.join(next(iter(folders.values())), "gt", name)
        truth = _pixels(first)
        layers = [{"label": TRUTH, "path": _copied(first, output, folder, f"{stem}-truth.png"), "note": ""}]
        errors = []
        for blend, source in folders.items():
            own_truth = _pixels(os.path.join(source, "gt", name))
            image = _pixels(os.path.join(source, "render", name))
            if own_truth.shape != truth.shape or (own_truth != truth).any() or image.shape != truth.shape:
                raise ReportError(f"{source}: view {name}: its ground truth or its rendering's size {image.shape} is "
                                  f"not that of {first} {truth.shape}: these cells cannot be compared")
            squares = np.square(image.astype(np.float64) - truth)
            decibels = 10 * math.log10(255 ** 2 / squares.mean()) if squares.any() else math.inf
            path = _copied(os.path.join(source, "render", name), output, folder, f"{stem}-{safe_name(blend)}.png")
            layers.append({"label": blend, "path": path, "note": f"{decibels:.2f} dB"})
            path = os.path.join(folder, f"{stem}-{safe_name(blend)}-error.png")
            Image.fromarray(error_image(truth, image)).save(os.path.join(output, path))
            errors.append({"label": f"error of {blend}", "path": _url(path), "note": f"{decibels:.2f} dB"})
        views.append({"name": os.path.splitext(name)[0], "width": truth.shape[1], "height": truth.shape[0],
                      "layers": layers + errors})
    return views


def _pixels(path: str) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def _copied(source: str, output: str, folder: str, name: str) -> str:
    shutil.copyfile(source, os.path.join(output, folder, name))
    return _url(os.path.join(folder, name))


def _url(path: str) -> str:
    return path.replace(os.sep, "/")

