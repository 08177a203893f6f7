"""Cameras and the matrices that a 3DGS rasterizer takes."""
from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Dict, Optional, Sequence

import numpy as np
import torch

from diff_smoe_rasterization.camera import settings_from_camera
from diff_smoe_rasterization.settings import GaussianRasterizationSettings

from .lens import AROUND, Lens

LARGEST = 1e9  # of all numbers of a camera, pixels or world units: with larger ones float32 overflows


@dataclass(frozen=True)
class Camera:
    """A camera; view axes are x right, y down, z forward, in world units.

    Pixel coordinates are COLMAP's: the centre of the top left pixel is (0.5, 0.5).
    """

    name: str
    rotation: np.ndarray  # [3, 3] world to view: x_view = rotation @ x_world + translation
    translation: np.ndarray  # [3]
    fx: float  # pixels
    fy: float
    cx: float  # principal point, pixels
    cy: float
    width: int
    height: int
    lens: Optional[Lens] = None  # None: a pinhole

    @property
    def center(self) -> np.ndarray:
        """[3] the camera's position in the world."""
        return -self.rotation.T @ self.translation

    @property
    def is_panorama(self) -> bool:
        """Whether the image has all directions, and so a seam."""
        return self.lens is not None and self.lens.model == AROUND

    @property
    def padding(self) -> str:
        """Of SSIM's windows at the image's borders, as `fused_ssim` takes it."""
        return "around" if self.is_panorama else "same"

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another image size; intrinsics scale with the axes."""
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(self, fx=self.fx * sx, cx=self.cx * sx, fy=self.fy * sy, cy=self.cy * sy,
                                   width=width, height=height)

    def centred(self) -> Camera:
        """The same view with the principal point moved to the image centre."""
        return dataclasses.replace(self, cx=self.width / 2, cy=self.height / 2)

    def pinhole(self) -> Camera:
        """The same view by a pinhole; in place of a lens, whose image it may not have, of 90 degrees across at most."""
        if not self.lens:
            return self
        factor = max(1.0, self.width / 2 / self.fx)
        return dataclasses.replace(self, lens=None, fx=factor * self.fx, fy=factor * self.fy)

    def settings(self, background: torch.Tensor, sh_degree: int, blend_mode: str,
                 antialiasing: bool = False) -> GaussianRasterizationSettings:
        """Rasterization settings of this camera, with matrices of the background's type and on its device.

        background: [3].
        """
        K: Any = [[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]]
        lens: Dict[str, Any] = {}
        if self.lens:
            lens = {"camera_model": self.lens.camera_model, "distortion": self.lens.coefficients}
            K = None if lens["camera_model"] == "equirectangular" else K
        return settings_from_camera(K, self.rotation, self.translation, self.width, self.height, background, sh_degree,
                                    antialiasing=antialiasing, blend_mode=blend_mode, **lens)


def quaternion_to_rotation(quaternion: Sequence[float]) -> np.ndarray:
    """[3, 3] float64 for a quaternion (w, x, y, z), normalised here. Raises ValueError if all of it is 0."""
    w, x, y, z = np.asarray(quaternion, np.float64)
    length = np.sqrt(x * x + y * y + z * z + w * w)
    if length == 0:
        raise ValueError("the quaternion is 0, which is not a rotation; one of its numbers must not be 0")
    w, x, y, z = w / length, x / length, y / length, z / length
    return np.array([[x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w]])


def rotation_to_quaternion(rotation: np.ndarray) -> np.ndarray:
    """[4] float64: a unit quaternion (w, x, y, z) of a rotation [3, 3]."""
    m, trace = rotation, rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    # 4 q q^T for q = (x, y, z, w): each column is a multiple of q. That of the largest diagonal element rounds least.
    products = np.empty((4, 4))
    products[:3, :3] = m + m.T
    products[range(3), range(3)] = 1 - trace + 2 * np.diag(m)
    products[:3, 3] = products[3, :3] = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
    products[3, 3] = 1 + trace
    x, y, z, w = products[np.argmax(np.diag(products))]
    return np.array([w, x, y, z]) / np.sqrt(x * x + y * y + z * z + w * w)


def scene_extent(centers: np.ndarray) -> float:
    """The scale of a scene as 3DGS takes it: 1.1 times the largest distance of a camera from their mean.

    centers: [V, 3] positions of the training cameras. A single camera (or several in one place) gives 1.0,
    if the formula would give 0 and stop all positions.
    """
    radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) * 1.1
    # Centres computed from poses differ by rounding even if they are one place.
    return radius if radius > 1e-6 * max(1.0, float(np.abs(centers).max())) else 1.0
