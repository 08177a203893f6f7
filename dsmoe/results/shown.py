"""The Gaussians of a model that can be shown."""
from __future__ import annotations

import dataclasses
from typing import Dict, List

import numpy as np
import torch

from diff_smoe_rasterization.io import Gaussians

from ..errors import TrainerError
from ..model import finite_rows as are_finite

# What half a turn about x makes of x, y, z, and of the real spherical harmonics of degrees 1 to 3 (y, z, x; xy, ...).
TURNED_AXES = np.array([1, -1, -1], np.float32)
TURNED_HARMONICS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)

FAINT_BELOW = "faint_below"  # in comments
LEAST_OPACITY = 1e-5  # and the greatest is as far from 1: of formats that hold no logits


def faint_comment(faint_below: float) -> str:
    """What a .ply records of it, to the last digit: a rounded one would be another rendering's."""
    return f"{FAINT_BELOW} {float(faint_below)!r}"


def raw_of(gaussians: Gaussians, device: str = "cpu") -> Dict[str, torch.Tensor]:
    """The raw parameters in a file, float32."""
    arrays = {"means3D": gaussians.means3D, "dc": gaussians.dc, "shs": gaussians.shs,
              "opacities": gaussians.opacity_logits, "scales": gaussians.log_scales, "rotations": gaussians.rotations}
    return {name: torch.tensor(array, dtype=torch.float32, device=device) for name, array in arrays.items()}


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Opacities of logits, in float64."""
    with np.errstate(over="ignore"):  # exp(1000) is infinite, and the opacity 0
        return 1 / (1 + np.exp(-logits.astype(np.float64)))


def logits(opacities: np.ndarray) -> np.ndarray:
    """Of opacities in 8 bits or float32, among which 0 and 1 have infinite ones."""
    clipped = opacities.astype(np.float64).clip(LEAST_OPACITY, 1 - LEAST_OPACITY)
    return np.log(clipped / (1 - clipped))


def finite_rows(gaussians: Gaussians) -> List[np.ndarray]:
    """Positions [M, 3], opacity logits [M, 1], log scales [M, 3], quaternions [M, 4], dc [M, 3] and the other harmonics
    [M, 3 (K - 1)] of the M Gaussians all of whose numbers are finite."""
    arrays = [gaussians.means3D, gaussians.opacity_logits, gaussians.log_scales, gaussians.rotations,
              gaussians.dc[:, 0], gaussians.shs.reshape(len(gaussians.shs), 3 * gaussians.shs.shape[1])]
    finite = are_finite(raw_of(gaussians)).numpy()
    return [array[finite] for array in arrays]


def rotatable_rows(gaussians: Gaussians) -> List[np.ndarray]:
    """`finite_rows` without those whose quaternion is 0, which viewers cannot turn into a rotation.

    Raises TrainerError if none is left.
    """
    rows = finite_rows(gaussians)
    turned = rows[3].any(axis=1)
    if not turned.any():
        raise TrainerError("the model has no Gaussian that can be shown; a .splat, .spz or .glb holds one at least")
    return [array[turned] for array in rows]


def y_up(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians after half a turn about x: from COLMAP's axes (y down, z forward) to OpenGL's."""
    signs = np.concatenate([[1], TURNED_AXES]).astype(np.float32)  # of w, x, y, z: R becomes D R D, with D = its turn
    harmonics = TURNED_HARMONICS[:gaussians.shs.shape[1], None]
    return dataclasses.replace(gaussians, means3D=gaussians.means3D * TURNED_AXES,
                               rotations=gaussians.rotations * signs, shs=gaussians.shs * harmonics)
