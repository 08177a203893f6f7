"""Lens distortion: the camera models of COLMAP and of transforms.json, as OpenCV and the rasterizer take them."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, Optional, Sequence, Tuple

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
    "THIN_PRISM_FISHEYE": (2, True, ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")),
}
THIN_PRISM, AROUND = "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR"  # which OpenCV does not undistort
PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # the order of OpenCV's coefficients
FISHEYE = ("k1", "k2", "k3", "k4")


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
    fx, fy, (cx, cy) = values[0], values[focals - 1], values[focals:focals + 2]
    return fx, fy, cx, cy, lens_of(camera.model, is_fisheye, dict(zip(names, values[focals + 2:])))
