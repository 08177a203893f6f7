"""Lens distortion: the camera models of COLMAP and of transforms.json, as OpenCV and the rasterizer take them."""
from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Dict, Optional, Sequence, Tuple

import numpy as np

from diff_smoe_rasterization import io
from diff_smoe_rasterization.settings import CAMERA_MODELS

# By camera model of COLMAP: how many focal lengths it has, whether it is a fisheye, and its coefficients.
MODELS: Dict[str, Tuple[int, bool, Tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (1, False, ()),
    "PINHOLE": (2, False, ()),
    "SIMPLE_RADIAL": (1, False, ("k1",)),
    "RADIAL": (1, False, ("k1", "k2")),
    "OPENCV": (2, False, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (2, False, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_FISHEYE": (1, True, ()),
    "FISHEYE": (2, True, ()),
    "SIMPLE_RADIAL_FISHEYE": (1, True, ("k1",)),
    "RADIAL_FISHEYE": (1, True, ("k1", "k2")),
    "OPENCV_FISHEYE": (2, True, ("k1", "k2", "k3", "k4")),
    "THIN_PRISM_FISHEYE": (2, True, ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")),
    "EQUIRECTANGULAR": (0, False, ()),
}
THIN_PRISM, AROUND = "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR"
NOT_UNDISTORTED = frozenset((THIN_PRISM, AROUND))  # by OpenCV
PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # the order of OpenCV's coefficients
FISHEYE = ("k1", "k2", "k3", "k4")
MAX_ASPECT_ERROR = 0.02  # of an image of all directions
LEAST_REACH = 0.1  # of the shorter side: what a lens shows around its principal point
SAMPLES = 4096  # of the distortion along a radius


@dataclass(frozen=True)
class Lens:
    """How a lens bends what a pinhole camera would see; the coefficients are in OpenCV's order."""

    model: str  # its name
    is_fisheye: bool
    coefficients: Tuple[float, ...]

    @property
    def camera_model(self) -> str:
        """Its name for the rasterizer, which takes the same coefficients."""
        other = {THIN_PRISM: "thin_prism_fisheye", AROUND: "equirectangular"}
        return other.get(self.model, "fisheye" if self.is_fisheye else "opencv")

    @property
    def reach(self) -> float:
        """The distorted radius, for a focal length of 1, up to which an image shows something; infinite if all does."""
        distorted = self.radii[1]
        return float(distorted[-1]) if len(distorted) else math.inf

    def check(self, focal: float, width: int, height: int) -> None:
        """Raises ValueError for a lens that cannot be that of such images.

        focal: the longer focal length, pixels.
        """
        if not self.reach * focal >= LEAST_REACH * min(width, height):
            raise ValueError(f"the lens folds the image back at {self.reach * focal:.2g} pixels from the principal "
                             f"point, and shows nothing beyond; its distortion is {list(self.coefficients)}")
        if self.model == AROUND and abs(width / (2 * height) - 1) > MAX_ASPECT_ERROR:
            raise ValueError(f"an image of all directions must be twice as wide as it is high, and is {width}x{height}")

    @functools.cached_property
    def radii(self) -> Tuple[np.ndarray, np.ndarray]:
        """[n] and [n], rising from 0: undistorted radii, and the distorted ones for a focal length of 1.

        The core has them, up to where the distorted radius stops rising. An undistorted radius is the angle to the axis
        of a fisheye, else its tangent. EQUIRECTANGULAR has none. Raises ValueError for coefficients that cannot be.
        """
        from diff_smoe_rasterization.core import _core  # which is not asked for before: it may not be built

        radii = _core.lens_radii(CAMERA_MODELS.index(self.camera_model), self.coefficients, SAMPLES)
        return np.array(radii[0]), np.array(radii[1])


def lens_of(model: str, is_fisheye: bool, coefficients: Dict[str, float]) -> Optional[Lens]:
    """The lens with these coefficients, by name; None if it bends nothing."""
    order = MODELS[THIN_PRISM][2] if model == THIN_PRISM else FISHEYE if is_fisheye else PERSPECTIVE
    values = tuple(coefficients.get(name, 0.0) for name in order)
    return Lens(model, is_fisheye, values) if is_fisheye or any(values) else None


def lens_named(camera_model: str, coefficients: Sequence[float]) -> Lens:
    """The lens by its name for the rasterizer. Raises ValueError if there is none of that name."""
    models = {"opencv": "FULL_OPENCV", "fisheye": "OPENCV_FISHEYE", "thin_prism_fisheye": THIN_PRISM,
              "equirectangular": AROUND}
    if camera_model not in models:
        raise ValueError(f"`camera_model` is {camera_model!r}; it must be one of {', '.join(models)}")
    return Lens(models[camera_model], camera_model.endswith("fisheye"), tuple(float(value) for value in coefficients))


def colmap_intrinsics(camera: io.ColmapCamera) -> Tuple[float, float, float, float, Optional[Lens]]:
    """fx, fy, cx, cy and the lens of a COLMAP camera, whose model must be one of MODELS."""
    focals, is_fisheye, names = MODELS[camera.model]
    values = [float(value) for value in camera.params]
    if camera.model == AROUND:  # its parameters are the image's size
        return camera.width / (2 * math.pi), camera.height / math.pi, camera.width / 2, camera.height / 2, lens_named(
            "equirectangular", ())
    fx, fy, (cx, cy) = values[0], values[focals - 1], values[focals:focals + 2]
    return fx, fy, cx, cy, lens_of(camera.model, is_fisheye, dict(zip(names, values[focals + 2:])))
