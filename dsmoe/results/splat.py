"""The .splat format of web viewers, written and read: 32 bytes a Gaussian, without view-dependent colour."""
from __future__ import annotations

import numpy as np

from diff_smoe_rasterization.io import Gaussians

from ..scenes.pointcloud import SH_C0
from .shown import logits, rotatable_rows, sigmoid

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def splat_bytes(gaussians: Gaussians) -> bytes:
    """The file's content: the largest and most opaque first, as viewers that show a file while it loads expect.

    Each has its position and its three standard deviations in world units, colour of degree 0 and opacity in 8 bits,
    and its quaternion (w, x, y, z) as 128 + 128 q in 8 bits. Left out are Gaussians that are not finite, and those
    whose quaternion is 0, which viewers cannot turn into a rotation. Raises TrainerError if none is left.
    """
    position, logit, log_scales, rotations, dc, _ = rotatable_rows(gaussians)
    opacity = sigmoid(logit)
    scale = np.exp(log_scales.astype(np.float64))
    colour = 0.5 + SH_C0 * dc.astype(np.float64)
    quaternion = rotations / np.linalg.norm(rotations.astype(np.float64), axis=1, keepdims=True)
    records = np.empty(len(opacity), RECORD)
    records["position"], records["scale"] = position, scale
    records["rgba"] = np.rint(np.hstack([colour, opacity]).clip(0, 1) * 255)
    records["rotation"] = np.rint(quaternion * 128 + 128).clip(0, 255)
    return records[np.argsort(-scale.prod(axis=1) * opacity[:, 0], kind="stable")].tobytes()


def splat_gaussians(content: bytes) -> Gaussians:
    """What a file holds. Raises ValueError if it is none."""
    if not content or len(content) % RECORD.itemsize:
        raise ValueError(f"{len(content)} bytes; a .splat has {RECORD.itemsize} for each Gaussian")
    records = np.frombuffer(content, RECORD)
    rgba = records["rgba"] / 255
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(records["scale"])
    arrays = {"means3D": records["position"], "dc": ((rgba[:, :3] - 0.5) / SH_C0)[:, None],
              "shs": np.zeros((len(records), 0, 3)), "opacity_logits": logits(rgba[:, 3:]), "log_scales": log_scales,
              "rotations": records["rotation"] / 128 - 1}
    return Gaussians(**{name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()})
