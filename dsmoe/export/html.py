"""One self-contained page that shows a model in a browser, by the equations that it was trained with."""
from __future__ import annotations

import base64
import gzip
import html
import json
import os
import re
from dataclasses import dataclass
from typing import Any, Dict, Optional, Sequence, Tuple

import numpy as np

from diff_smoe_rasterization.io import Gaussians
from diff_smoe_rasterization.settings import trained_faint_below

from ..errors import TrainerError
from ..results.shown import finite_rows, sigmoid
from ..scenes.cameras import Camera
from ..scenes.orbit import Orbit
from ..system.process import command

PAGE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "page")
MODES = ("alpha", "smoe", "smoe_eq7")

# What renderer.js reads of each Gaussian. A rotation is the vector part of a unit quaternion whose real part is the
# largest, times sqrt(2) as a signed 16-bit fraction.
RECORD = np.dtype([("position", "<f4", 3), ("opacity", "<f2"), ("log_scales", "<f2", 3), ("rotation", "<i2", 3),
                   ("dc", "<f2", 3)])


@dataclass(frozen=True)
class Shown:
    """How a page shows its Gaussians."""

    title: str
    blend_mode: str  # one of MODES
    background_gate: float
    background: Tuple[float, float, float]
    antialiasing: bool
    cameras: Sequence[Camera]  # views to begin with; at least one
    orbit: Orbit  # what dragging turns about
    faint_below: Optional[float] = None  # of smoe; None: as usual


def page(gaussians: Gaussians, shown: Shown) -> str:
    """The page's text. Raises TrainerError for a blend mode that it cannot show."""
    if shown.blend_mode not in MODES:
        raise TrainerError(f"a page shows {', '.join(MODES[:-1])} and {MODES[-1]}, but the model was trained with "
                           f"{shown.blend_mode}; use `{command()} render` or `{command()} view`")
    count, first, second = pack(gaussians)
    facts: Dict[str, Any] = {
        "count": count, "degree": gaussians.sh_degree, "mode": shown.blend_mode, "gate": shown.background_gate,
        "faintBelow": trained_faint_below("smoe", shown.faint_below),
        "background": list(shown.background), "antialiasing": shown.antialiasing, "up": shown.orbit.up.tolist(),
        "target": shown.orbit.target.tolist(), "cameras": [_plain(camera) for camera in shown.cameras],
    }
    parts = {name: _read(file) for name, file in (("renderer", "renderer.js"), ("orbit", "orbit.js"),
                                                  ("sort", "sort.js"))}
    parts.update(title=html.escape(shown.title), facts=json.dumps(facts, allow_nan=False).replace("<", "\\u003c"),
                 gaussians=base64.b64encode(gzip.compress(first + second, 6, mtime=0)).decode("ascii"))
    return re.sub(r"{{(\w+)}}", lambda place: parts[place.group(1)], _read("page.html"))


def pack(gaussians: Gaussians) -> Tuple[int, bytes, bytes]:
    """The number of finite Gaussians, their records, and their spherical harmonics from degree 1 on.

    Harmonics have 8 bits each, and each Gaussian one scale: float16 scale, then coefficients as multiples of
    scale / 127. The three channels of each are together, in a whole number of texels of 16 bytes.
    """
    position, logit, log_scales, rotations, dc, harmonics = finite_rows(gaussians)
    records = np.zeros(len(position), RECORD)
    records["position"] = position
    records["opacity"] = sigmoid(logit[:, 0])
    records["log_scales"] = log_scales.clip(-65504)  # of float16
    records["rotation"] = np.rint(_rotation_vectors(rotations) * np.sqrt(2) * 32767)
    records["dc"] = dc.clip(-65504, 65504)

    coefficients = harmonics.shape[1]
    texels = -(-(coefficients + 2) // 16) if coefficients else 0
    packed = np.zeros((len(position), 16 * texels), np.uint8)
    if coefficients:
        scale = np.abs(harmonics).max(axis=1).clip(1e-6, 65504).astype("<f2").astype(np.float32)
        steps = np.rint(harmonics / scale[:, None] * 127).clip(-127, 127).astype(np.int8)
        packed[:, :2] = scale.astype("<f2")[:, None].view(np.uint8)
        packed[:, 2:2 + coefficients] = steps.view(np.uint8)
    return len(position), records.tobytes(), packed.tobytes()


def _rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """[N, 3] x, y, z of unit quaternions with w as the largest component, for [N, 4] quaternions (w, x, y, z).

    Times i, j or k a quaternion turns the Gaussian by half a turn about one of its own axes. That leaves it as it is,
    and another component becomes w.
    """
    w, x, y, z = (rotations / np.linalg.norm(rotations, axis=1, keepdims=True).clip(1e-12)).T
    turned = np.stack([(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)])  # q, q i, q j, q k
    largest = np.abs(turned[:, 0]).argmax(axis=0)
    chosen = turned[largest, :, np.arange(len(rotations))]
    return chosen[:, 1:] * np.where(chosen[:, :1] < 0, -1, 1)


def _plain(camera: Camera) -> Dict[str, Any]:
    values: Dict[str, Any] = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return {**values, "rotation": np.asarray(camera.rotation).tolist(),
            "translation": np.asarray(camera.translation).tolist()}


def _read(name: str) -> str:
    with open(os.path.join(PAGE, name), encoding="utf-8") as file:
        return file.read()

