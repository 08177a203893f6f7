"""NeRF-synthetic scenes: transforms_train.json and transforms_test.json, images with transparency."""
from __future__ import annotations

import json
import math
import os
import reprlib
from typing import Any, Dict, List

import numpy as np

from ... import io
from ..config import TrainConfig
from ..errors import SceneError
from ..model import SH_C0
from ..system.files import is_file
from .cameras import Camera
from .images import image_size
from .layout import Layout, PosedImage
from .pointcloud import PointCloud

RANDOM_POINTS = 100_000  # as 3DGS
HALF_SIDE = 1.3  # of the cube that random points fill: the extent of the NeRF-synthetic scenes
LARGEST = 1e9  # of all numbers, pixels or world units: with larger ones float32 overflows
MAX_SKEW = 1e-3  # of a rotation, as far as rounded json numbers may leave it
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# From OpenGL's camera axes (y up, z backward) to ours (y down, z forward).
FLIP = np.diag([1.0, -1.0, -1.0])


def read_nerf_layout(folder: str, config: TrainConfig) -> Layout:
    """Reads both json files and points3d.ply where there is one; else points are random. Raises SceneError."""
    train = _read_transforms(folder, "transforms_train.json")
    test = []
    if is_file(os.path.join(folder, "transforms_test.json")):
        test = _read_transforms(folder, "transforms_test.json")
    path = os.path.join(folder, "points3d.ply")
    if is_file(path):
        points = _read_points(path)
    else:
        points = random_points(config.init_points or RANDOM_POINTS, config.seed)
    return Layout("nerf-synthetic", train, test, points, "transforms_test.json lists the test images")


def random_points(count: int, seed: int) -> PointCloud:
    """Uniform points in a cube around the origin, all but grey, as 3DGS starts on NeRF-synthetic scenes."""
    random = np.random.RandomState(seed)
    positions = random.uniform(-HALF_SIDE, HALF_SIDE, (count, 3))
    return PointCloud(positions, 0.5 + SH_C0 * random.uniform(0, 1 / 255, (count, 3)))


def _read_points(path: str) -> PointCloud:
    try:
        points = io.read_points(path)
    except (OSError, ValueError) as error:
        raise SceneError(str(error)) from error
    colors = points.colors if points.colors is not None else np.full(points.positions.shape, 128, np.uint8)
    return PointCloud(np.asarray(points.positions, np.float64), colors / 255.0).checked(path)


def _read_transforms(folder: str, name: str) -> List[PosedImage]:
    path = os.path.join(folder, name)
    try:
        with open(path, encoding="utf-8") as file:
            content = json.load(file)
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not valid json ({error})") from error
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise SceneError(f"{path}: expected an object with a list `frames`")
    if not content["frames"]:
        raise SceneError(f"{path}: the list `frames` is empty")
    return [_posed_image(folder, path, content, index) for index in range(len(content["frames"]))]


def _posed_image(folder: str, json_path: str, content: Dict[str, Any], index: int) -> PosedImage:
    frame = content["frames"][index]
    where = f"{json_path}: frame {index}"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise SceneError(f"{where}: `file_path` is missing")
    bent = [key for key in DISTORTION if frame.get(key, content.get(key, 0))]
    if bent:
        raise SceneError(f"{where}: lens distortion ({', '.join(bent)}) is not supported; undistort the images first")
    try:
        matrix = np.array(frame.get("transform_matrix"), np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.abs(matrix).max() <= LARGEST:
        raise SceneError(f"{where}: `transform_matrix` must be 4 rows of 4 numbers of at most {LARGEST:g}")
    image_path = os.path.join(folder, frame["file_path"])
    if not os.path.splitext(image_path)[1]:
        image_path += ".png"
    if not is_file(image_path):
        raise SceneError(f"{image_path}: no such image (named by frame {index} of {json_path})")
    width, height = image_size(image_path)

    def number(key: str, default: float) -> float:
        value = frame.get(key, content.get(key, default))
        if not _is_number(value):
            raise SceneError(f"{where}: `{key}` is {reprlib.repr(value)}; it must be a number of at most {LARGEST:g}")
        return float(value)

    def positive(key: str, default: float) -> float:
        value = number(key, default)
        if value < 1 / LARGEST:
            raise SceneError(f"{where}: `{key}` is {value:g}; it must be positive, {1 / LARGEST:g} at least")
        return value

    def whole(key: str, default: int) -> int:
        value = positive(key, default)
        if not value.is_integer():
            raise SceneError(f"{where}: `{key}` is {value:g}; it must be a whole number of pixels")
        return int(value)

    if np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() > MAX_SKEW:
        raise SceneError(f"{where}: the left 3x3 block of `transform_matrix` must be a rotation")
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise SceneError(f"{where}: the left 3x3 block of `transform_matrix` mirrors (its determinant is -1); "
                         "it must be a rotation")
    camera_to_world = matrix[:3, :3] @ FLIP
    rotation = camera_to_world.T
    # Intrinsics in pixels refer to the size that the json gives, where it gives one.
    json_width, json_height = whole("w", width), whole("h", height)
    given = "fl_x" in frame or "fl_x" in content
    focal_x = positive("fl_x", 0) if given else _focal(content, frame, json_width, where)
    # The path below the scene folder, since train/r_0.png and test/r_0.png are two images.
    name = os.path.relpath(image_path, folder).replace(os.sep, "/")
    camera = Camera(name, rotation, -rotation @ matrix[:3, 3], focal_x, positive("fl_y", focal_x),
                    number("cx", json_width / 2), number("cy", json_height / 2), json_width, json_height)
    return PosedImage(camera, image_path)


def _focal(content: Dict[str, Any], frame: Dict[str, Any], width: int, where: str) -> float:
    """Focal length in pixels of an image that wide from `camera_angle_x`."""
    angle = frame.get("camera_angle_x", content.get("camera_angle_x"))
    if not _is_number(angle) or not 1 / LARGEST < angle < math.pi:
        raise SceneError(f"{where}: `camera_angle_x` is {reprlib.repr(angle)}; it must be an angle between "
                         f"{1 / LARGEST:g} and pi")
    return width / (2 * math.tan(angle / 2))


def _is_number(value: Any) -> bool:
    """Whether a json value is a number in range; true and false, which Python counts among the integers, are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST
