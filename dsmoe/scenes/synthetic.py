"""A small room, ray-traced by numpy in seconds, written as a COLMAP folder: a scene for first steps and tests.

It has what tells blend modes apart: straight edges (checkerboard, boxes, posters), curved ones (striped spheres),
hard shadows, and walls all around, so that no pixel sees the background.
"""
from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Callable, List, Sequence, Tuple

import numpy as np
from PIL import Image

from diff_smoe_rasterization import io

from ..system.progress import progress_bar
from .cameras import Camera, rotation_to_quaternion
from .orbit import look_at

Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (u [R], v [R]) -> colours [R, 3]

LIGHT = np.array([1.8, 3.6, -1.3], np.float32)  # a point light under the ceiling; y is up
AMBIENT = np.float32(0.45)
FAR = np.float32(1e9)
ROOM = 3.8  # half the side of the room
HEIGHT = 4.0  # of the room
SHADOW_GAP = 1e-3  # shadow rays start this far off their surface


def _pick(mask: np.ndarray, yes: Sequence[float], no: Sequence[float]) -> np.ndarray:
    return np.where(mask[:, None], np.asarray(yes, np.float32), np.asarray(no, np.float32))


def checkerboard(size: float, one: Sequence[float], other: Sequence[float]) -> Texture:
    """Squares of side `size` in two colours."""
    return lambda u, v: _pick((np.floor(u / size) + np.floor(v / size)) % 2 == 0, one, other)


def stripes(size: float, slope: float, one: Sequence[float], other: Sequence[float]) -> Texture:
    """Bands of width `size`, tilted by `slope`."""
    return lambda u, v: _pick(np.floor((u + slope * v) / size) % 2 == 0, one, other)


def rings(size: float, one: Sequence[float], other: Sequence[float]) -> Texture:
    """Concentric rings of width `size`."""
    return lambda u, v: _pick(np.floor(np.hypot(u, v) / size) % 2 == 0, one, other)


def plain(color: Sequence[float]) -> Texture:
    """One colour."""
    return lambda u, v: np.broadcast_to(np.asarray(color, np.float32), (len(u), 3))


def poster(inside: Texture, half_width: float, half_height: float, wall: Texture) -> Texture:
    """A picture with sharp borders on a wall, centred at (0, 0)."""

    def texture(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        within = (np.abs(u) < half_width) & (np.abs(v) < half_height)
        return np.where(within[:, None], inside(u, v), wall(u, v))

    return texture


@dataclass(frozen=True)
class Rectangle:
    """A flat textured rectangle: origin + u * axis_u + v * axis_v for |u|, |v| within the half sizes."""

    origin: np.ndarray  # [3]
    axis_u: np.ndarray  # [3] unit
    axis_v: np.ndarray  # [3] unit
    half_u: float
    half_v: float
    texture: Texture

    @property
    def frame(self) -> np.ndarray:
        """[3, 3] columns: the two axes and the normal."""
        return np.stack([self.axis_u, self.axis_v, np.cross(self.axis_u, self.axis_v)], axis=1)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """[R] distances along the rays, FAR if they miss."""
        frame = self.frame
        # einsum, not @: BLAS would start threads of its own inside each of ours.
        start = np.einsum("ij,jk->ki", origins - self.origin, frame)
        along = np.einsum("ij,jk->ki", directions, frame)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -start[2] / along[2]
            u, v = start[0] + distance * along[0], start[1] + distance * along[1]
        inside = (np.abs(u) <= self.half_u) & (np.abs(v) <= self.half_v) & (distance > 0)
        return np.where(inside, distance, FAR)

    def surface(self, points: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """Normals [R, 3] and colours [R, 3] at points on it."""
        frame = self.frame
        u, v, _ = np.einsum("ij,jk->ki", points - self.origin, frame)
        return np.broadcast_to(frame[:, 2], points.shape), self.texture(u, v)


@dataclass(frozen=True)
class Sphere:
    """A textured ball; u runs around it, v from pole to pole, both in radians."""

    center: np.ndarray  # [3]
    radius: float
    texture: Texture

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """[R] distances along the (unit) rays, FAR if they miss."""
        offset = origins - self.center
        half_b = np.einsum("ij,ij->i", offset, directions)
        discriminant = half_b**2 - (np.einsum("ij,ij->i", offset, offset) - self.radius**2)
        distance = -half_b - np.sqrt(np.maximum(discriminant, 0))
        return np.where((discriminant > 0) & (distance > 0), distance, FAR)

    def surface(self, points: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """Normals [R, 3] and colours [R, 3] at points on it."""
        normals = (points - self.center) / self.radius
        return normals, self.texture(np.arctan2(normals[:, 2], normals[:, 0]), np.arcsin(np.clip(normals[:, 1], -1, 1)))


def _box(center: Sequence[float], half: Sequence[float], turn: float, textures: Sequence[Texture]) -> List[Rectangle]:
    """Five faces (no bottom) of a box turned about the vertical; textures: sides x+, x-, z+, z-, top."""
    x = np.array([math.cos(turn), 0.0, math.sin(turn)], np.float32)
    y = np.array([0.0, 1.0, 0.0], np.float32)
    z = np.cross(x, y)
    c, (a, b, d) = np.asarray(center, np.float32), half
    return [
        Rectangle(c + a * x, y, z, b, d, textures[0]),
        Rectangle(c - a * x, z, y, d, b, textures[1]),
        Rectangle(c + d * z, x, y, a, b, textures[2]),
        Rectangle(c - d * z, y, x, b, a, textures[3]),
        Rectangle(c + b * y, z, x, d, a, textures[4]),
    ]


def room() -> List:
    """The objects of the scene; all lengths float32, which halves the time."""
    x, y, z = np.eye(3, dtype=np.float32)
    cream, grey = (0.86, 0.83, 0.76), (0.62, 0.66, 0.70)
    red, blue, green, yellow = (0.80, 0.15, 0.12), (0.12, 0.25, 0.70), (0.15, 0.52, 0.25), (0.93, 0.78, 0.18)
    dark, white = (0.10, 0.10, 0.12), (0.95, 0.95, 0.95)
    half, middle = HEIGHT / 2, HEIGHT / 2 * y
    low = -half + 1.2  # posters hang a little below the middle of their walls
    walls = [
        poster(rings(0.22, red, white), 1.1, 0.9, plain(cream)),
        poster(stripes(0.3, 1.0, blue, yellow), 1.2, 0.8, plain(grey)),
        poster(checkerboard(0.35, green, white), 1.05, 1.05, plain(cream)),
        stripes(0.5, 0.0, (0.70, 0.55, 0.50), (0.80, 0.70, 0.62)),
    ]
    lift = low * y
    return [
        Rectangle(0 * x, z, x, ROOM, ROOM, checkerboard(0.8, white, dark)),
        Rectangle(HEIGHT * y, x, z, ROOM, ROOM, plain(white)),
        Rectangle(middle + lift - ROOM * z, x, y, ROOM, HEIGHT, walls[0]),
        Rectangle(middle + lift + ROOM * z, y, x, HEIGHT, ROOM, walls[1]),
        Rectangle(middle + lift - ROOM * x, y, z, HEIGHT, ROOM, walls[2]),
        Rectangle(middle + lift + ROOM * x, z, y, ROOM, HEIGHT, walls[3]),
        *_box((-0.55, 0.45, -0.35), (0.45, 0.45, 0.45), 0.4,
              [plain(red), stripes(0.15, 0.0, white, red), checkerboard(0.225, yellow, blue), plain(yellow),
               plain(white)]),
        *_box((0.75, 0.30, 0.55), (0.30, 0.30, 0.55), -0.5,
              [plain(green), plain(blue), stripes(0.12, 1.0, dark, white), plain(green), rings(0.1, white, green)]),
        Sphere(np.array([0.70, 0.50, -0.75], np.float32), 0.50, stripes(math.pi / 8, 0.0, blue, white)),
        Sphere(np.array([-0.75, 0.30, 0.85], np.float32), 0.30, stripes(math.pi / 6, 2.0, yellow, red)),
        Sphere(np.array([-0.55, 1.20, -0.35], np.float32), 0.30, plain((0.30, 0.72, 0.75))),
    ]


def trace(objects: Sequence, origins: np.ndarray, directions: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
    """First hits [R, 3] of unit rays and their lit colours [R, 3]: Lambert with one hard-shadowed point light."""
    distances = np.stack([item.hit(origins, directions) for item in objects])
    nearest = distances.argmin(axis=0)
    points = origins + distances.min(axis=0)[:, None] * directions
    normals, colors = np.empty_like(points), np.empty_like(points)
    for index, item in enumerate(objects):
        mine = nearest == index
        if mine.any():
            normals[mine], colors[mine] = item.surface(points[mine])
    # A surface shows the side that faces the ray.
    normals *= -np.sign(np.einsum("ij,ij->i", normals, directions))[:, None]
    start = points + SHADOW_GAP * normals
    to_light = LIGHT - start
    reach = np.linalg.norm(to_light, axis=1)
    to_light /= reach[:, None]
    lit = np.ones(len(points), bool)
    for item in objects:
        lit &= item.hit(start, to_light) >= reach
    lambert = np.maximum(np.einsum("ij,ij->i", normals, to_light), 0) * lit
    return points, colors * (AMBIENT + (1 - AMBIENT) * lambert)[:, None]


def view_cameras(count: int, width: int, height: int) -> List[Camera]:
    """Cameras on two rings around the objects, looking inward."""
    cameras = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        radius, level = (2.7, 1.2) if index % 2 else (3.2, 2.1)
        eye = np.array([radius * math.cos(angle), level, radius * math.sin(angle)])
        target = np.array([0.25 * math.cos(3 * angle), 0.55, 0.25 * math.sin(3 * angle)])
        rotation, focal = look_at(eye, target, np.array([0.0, 1.0, 0.0])), 0.9 * width
        cameras.append(Camera(f"view_{index:03d}.png", rotation, -rotation @ eye, focal, focal, width / 2, height / 2,
                              width, height))
    return cameras


def camera_rays(camera: Camera, supersampling: int) -> np.ndarray:
    """[height * s, width * s, 3] float32 unit directions in the world through an s x s grid in each pixel."""
    columns = (np.arange(camera.width * supersampling) + 0.5) / supersampling
    rows = (np.arange(camera.height * supersampling) + 0.5) / supersampling
    u, v = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
    directions = np.stack([u, v, np.ones_like(u)], axis=2) @ camera.rotation
    return (directions / np.linalg.norm(directions, axis=2, keepdims=True)).astype(np.float32)


def render_view(objects: Sequence, camera: Camera, supersampling: int) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image [H, W, 3] in [0, 1]; and of every sample its point [R, 3] and colour [R, 3]."""
    directions = camera_rays(camera, supersampling).reshape(-1, 3)
    origins = np.broadcast_to(camera.center.astype(np.float32), directions.shape)
    points, colors = trace(objects, origins, directions)
    s = supersampling
    return colors.reshape(camera.height, s, camera.width, s, 3).mean(axis=(1, 3)), points, colors


def write_synthetic_scene(folder: str, views: int = 48, width: int = 200, height: int = 150, points: int = 8000,
                          supersampling: int = 2, seed: int = 0, progress: bool = False) -> None:
    """Writes the room as a COLMAP text model with images; the starting points are samples that the views see.

    views: every 8th becomes a test view when the folder is loaded. points: about so many, evenly over the views.
    """
    objects, cameras = room(), view_cameras(views, width, height)
    images = os.path.join(folder, "images")
    os.makedirs(images, exist_ok=True)

    def write_view(index: int) -> Tuple[np.ndarray, np.ndarray]:
        image, hits, colors = render_view(objects, cameras[index], supersampling)
        Image.fromarray((image * 255).round().astype(np.uint8)).save(os.path.join(images, cameras[index].name))
        chosen = np.random.RandomState(seed + index).choice(len(hits), max(1, points // views), replace=False)
        return hits[chosen], colors[chosen]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        samples = list(progress_bar(pool.map(write_view, range(views)), total=views, desc="views", unit="view",
                                    leave=False, disable=not progress))
    positions, colors = (np.concatenate(arrays) for arrays in zip(*samples))
    io.write_colmap(os.path.join(folder, "sparse", "0"), _colmap_model(cameras, positions, colors), text=True)


def _colmap_model(cameras: Sequence[Camera], positions: np.ndarray, colors: np.ndarray) -> io.ColmapModel:
    """All views share one PINHOLE camera."""
    first = cameras[0]
    intrinsics = np.array([first.fx, first.fy, first.cx, first.cy])
    images = []
    for index, camera in enumerate(cameras, start=1):
        images.append(io.ColmapImage(index, camera.name, 1, rotation_to_quaternion(camera.rotation),
                                     camera.translation))
    return io.ColmapModel(
        cameras={1: io.ColmapCamera(1, "PINHOLE", first.width, first.height, intrinsics)},
        images=images,
        points=io.Points(positions.astype(np.float64), (colors * 255).round().astype(np.uint8)),
    )
