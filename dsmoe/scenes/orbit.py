"""An orbit: the point that a scene's cameras look at, and a ring of cameras about it."""
from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import List, Sequence

import numpy as np

from ..errors import SceneError
from .cameras import LARGEST, Camera

FIELD_OF_VIEW = 0.9  # radians, of a camera that no scene gives
SIZE = (800, 600)  # pixels of such a camera


@dataclass(frozen=True)
class Orbit:
    """A ring of cameras around a point; all look at the point."""

    target: np.ndarray  # [3] world
    up: np.ndarray  # [3] unit, world
    start: np.ndarray  # [3] the first position, from the target

    def eyes(self, count: int) -> np.ndarray:
        """[count, 3] positions in the world: once around, evenly, counter-clockwise seen from above."""
        along = self.up * (self.start @ self.up)
        out = self.start - along
        side = np.cross(self.up, out)
        angles = 2 * math.pi * np.arange(count)[:, None] / count
        return self.target + along + np.cos(angles) * out + np.sin(angles) * side

    def cameras(self, count: int, like: Camera) -> List[Camera]:
        """Pinhole cameras on the ring, with the size and the focal length of another and a centred principal point."""
        centred = like.centred().pinhole()
        cameras = []
        for index, eye in enumerate(self.eyes(count)):
            rotation = look_at(eye, self.target, self.up)
            cameras.append(dataclasses.replace(centred, name=f"orbit_{index:04d}", rotation=rotation,
                                               translation=-rotation @ eye))
        return cameras


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[3, 3] world to view of a camera at `eye` that sees `target` in its centre, upright."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # it looks straight up or down
        right = np.cross(forward, up[[1, 2, 0]])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def upright(camera: Camera, up: np.ndarray) -> Camera:
    """The camera without its roll: it looks in the same direction, and what is up [3] is up in its image.

    One that looks up or down within 8 degrees has no such direction, and stays.
    """
    forward = camera.rotation[2]
    if abs(forward @ up) > math.cos(math.radians(8)):
        return camera
    rotation = look_at(camera.center, camera.center + forward, up)
    return dataclasses.replace(camera, rotation=rotation, translation=-rotation @ camera.center)


def up_of_cameras(cameras: Sequence[Camera]) -> np.ndarray:
    """[3] unit: what is up in the world, if photographers hold their cameras level.

    It is perpendicular to the horizontal axes of the images, however high or low the cameras look. If these axes
    run parallel, or cameras are turned by 90 degrees, it is the mean of the images' vertical axes.
    """
    mean = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    mean = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-3 else np.array([0.0, 0.0, 1.0])
    sizes, axes = np.linalg.eigh(np.mean([np.outer(camera.rotation[0], camera.rotation[0]) for camera in cameras],
                                         axis=0))  # the sizes ascend
    level = axes[:, 0] * (1.0 if axes[:, 0] @ mean > 0 else -1.0)
    is_sure = sizes[1] > 0.01 and sizes[0] < sizes[1] / 4 and level @ mean > math.cos(math.radians(45))
    return level if is_sure else mean


def orbit_of_cameras(cameras: Sequence[Camera]) -> Orbit:
    """The orbit of a capture: as far from the target and as high above it as the cameras are on average.

    The target is the point nearest to all optical axes. If they run parallel, it lies in front of the cameras by
    twice their spread.
    """
    centers = np.stack([camera.center for camera in cameras])
    forwards = np.stack([camera.rotation[2] for camera in cameras])
    up = up_of_cameras(cameras)
    # Sum of (I - d d^T)(p - c) over the axes is 0.
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    matrix = across.sum(axis=0)
    if np.linalg.cond(matrix) < 1e4:
        target = np.linalg.solve(matrix, (across @ centers[:, :, None]).sum(axis=0)[:, 0])
    else:
        spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
        target = centers.mean(axis=0) + forwards.mean(axis=0) * 2 * (spread or 1.0)
    offsets = centers - target
    heights = offsets @ up
    outward = offsets - heights[:, None] * up
    first = outward[0] if np.linalg.norm(outward[0]) > 1e-9 else np.cross(up, up[[1, 2, 0]])
    radius = float(np.linalg.norm(outward, axis=1).mean())
    return Orbit(target, up, first / np.linalg.norm(first) * radius + heights.mean() * up)


def orbit_of_points(positions: np.ndarray) -> Orbit:
    """An orbit about the middle of points [N, 3], for a model without a scene; -y is up, as COLMAP mostly has it.

    Points that are not finite or too far away are left out. Without points it is about the origin. Raises SceneError
    if all of several are left out.
    """
    near = positions[(np.abs(positions) <= LARGEST).all(axis=1)]
    if len(near) < 1 <= len(positions):
        raise SceneError(f"none of the {len(positions):,} Gaussians lies within {LARGEST:g} of the origin: there is no "
                         "place to look at them from; name one with --scene")
    positions = near if len(near) else np.zeros((1, 3))
    target = np.median(positions, axis=0)
    size = float(np.percentile(np.linalg.norm(positions - target, axis=1), 90)) or 1.0
    distance = size / math.tan(FIELD_OF_VIEW / 2)
    return Orbit(target, np.array([0.0, -1.0, 0.0]), distance * np.array([0.0, -0.3, -1.0]))


def default_camera() -> Camera:
    """A camera at the origin, if no scene gives one; only its size and its intrinsics are meant."""
    width, height = SIZE
    focal = height / (2 * math.tan(FIELD_OF_VIEW / 2))
    return Camera("default", np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height)
