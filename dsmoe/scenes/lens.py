"""Lens distortion: the camera models of COLMAP and of transforms.json, as OpenCV takes them."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, Optional, Tuple

from diff_smoe_rasterization import io

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
}
PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # the order of OpenCV's coefficients
FISHEYE = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class Lens:
    """How a lens bends what a pinhole camera would see; the coefficients are in OpenCV's order."""

    model: str  # its name
    is_fisheye: bool
    coefficients: Tuple[float, ...]


def lens_of(model: str, is_fisheye: bool, coefficients: Dict[str, float]) -> Optional[Lens]:
    """The lens with these coefficients, by name; None if it bends nothing."""
    values = tuple(coefficients.get(name, 0.0) for name in (FISHEYE if is_fisheye else PERSPECTIVE))
    return Lens(model, is_fisheye, values) if is_fisheye or any(values) else None


def colmap_intrinsics(camera: io.ColmapCamera) -> Tuple[float, float, float, float, Optional[Lens]]:
    """fx, fy, cx, cy and the lens of a COLMAP camera, whose model must be one of MODELS."""
    focals, is_fisheye, names = MODELS[camera.model]
    values = [float(value) for value in camera.params]
    fx, fy, (cx, cy) = values[0], values[focals - 1], values[focals:focals + 2]
    return fx, fy, cx, cy, lens_of(camera.model, is_fisheye, dict(zip(names, values[focals + 2:])))
