"""The images of a report: of each view the ground truth, and every blend's rendering with its error."""
from __future__ import annotations

import math
import os
from typing import Any, Dict, List, Sequence

import matplotlib
import numpy as np
from PIL import Image

from ..names import CELLS_FOLDER
from ..rows import ReportError, Row
from .groups import Group, grouped, safe_name
from .layouts import end_of

ERROR_FULL_SCALE = 0.25  # the mean absolute difference over channels, of 1, that takes the colour map's brightest end
ERROR_COLORS = "inferno"


def collect(results: str, suite: str, rows: Sequence[Row], output: str) -> List[Dict[str, Any]]:
    """Writes OUTPUT/images of a suite's cells and their errors; returns what there is of every scene and setting."""
    compared: Dict[Any, List[Group]] = {}
    for group in grouped(rows, end_of):
        compared.setdefault((group.scene, group.setting.pair), []).append(group)
    found = []
    for number, ((scene, setting), groups) in enumerate(compared.items()):
        amount = "" if setting.threshold is None and setting.budget is None else f", threshold {setting.amount()}"
        views = _views(_folders(results, groups), output, f"images/{safe_name(suite)}-{number}")
        found += [{"title": f"{scene}: {setting.label(blend=False)}{amount}", "views": views}] if views else []
    return found


def _folders(results: str, groups: Sequence[Group]) -> Dict[str, str]:
    """The images folder of each blend that has one, of the seed which the most blends have images of."""
    folders: Dict[int, Dict[str, str]] = {}
    for group in groups:
        for row in group.rows:
            path = os.path.join(results, CELLS_FOLDER, row["cell"], "images")
            if os.path.isdir(path):
                folders.setdefault(row["seed"], {})[group.setting.blend] = path
    return folders[max(sorted(folders), key=lambda seed: len(folders[seed]))] if folders else {}


def _views(folders: Dict[str, str], output: str, folder: str) -> List[Dict[str, Any]]:
    names = [set(os.listdir(os.path.join(path, "render"))) for path in folders.values()]
    common = sorted(set.intersection(*names)) if names else []
    if common:
        os.makedirs(os.path.join(output, folder))
    return [{"name": os.path.splitext(name)[0], "images": _images(folders, name, output, f"{folder}/{number:03d}")}
            for number, name in enumerate(common)]


def _images(folders: Dict[str, str], name: str, output: str, prefix: str) -> List[Dict[str, str]]:
    truths = {blend: _pixels(os.path.join(path, "gt", name)) for blend, path in folders.items()}
    truth = next(iter(truths.values()))
    found = {"ground truth": truth}
    for blend, path in folders.items():
        image = _pixels(os.path.join(path, "render", name))
        if not np.array_equal(truths[blend], truth) or image.shape != truth.shape:
            raise ReportError(f"{path}: view {name}: its ground truth, or its rendering's size, is not that of "
                              f"{next(iter(folders.values()))}: these cells cannot be compared")
        squares = np.square(image.astype(np.float64) - truth)
        decibels = 10 * math.log10(255 ** 2 / squares.mean()) if squares.any() else math.inf
        found.update({f"{blend}, {decibels:.2f} dB": image, f"error of {blend}": error_image(truth, image)})
    paths = [f"{prefix}-{number}.png" for number in range(len(found))]
    for path, pixels in zip(paths, found.values()):
        Image.fromarray(pixels).save(os.path.join(output, path))
    return [{"label": label, "path": path} for label, path in zip(found, paths)]


def error_image(truth: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Colours [H, W, 3] uint8 of the absolute difference of two images [H, W, 3] uint8, averaged over channels."""
    difference = np.abs(truth.astype(np.float32) - image.astype(np.float32)).mean(axis=2) / 255
    colors = matplotlib.colormaps[ERROR_COLORS](np.clip(difference / ERROR_FULL_SCALE, 0, 1))
    return (colors[..., :3] * 255 + 0.5).astype(np.uint8)


def _pixels(path: str) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
