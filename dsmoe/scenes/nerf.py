"""Scenes by json: transforms.json of nerfstudio, instant-ngp and Polycam; NeRF-synthetic's transforms_train.json.

Both have frames with a matrix from OpenGL's camera axes to the world, and intrinsics of all frames or of each.
"""
from __future__ import annotations

import json
import math
import os
import reprlib
from typing import Any, Dict, List, Optional, Tuple

import numpy as np

from diff_smoe_rasterization import io

from ..errors import SceneError, said_of
from ..options.config import TrainConfig
from ..options.early import NERF_SYNTHETIC, TRANSFORMS
from ..system.files import is_file
from .cameras import LARGEST, Camera
from .images import image_size
from .layout import Layout, PosedImage, hold_out
from .lens import AROUND, FISHEYE, PERSPECTIVE, Lens, lens_of
from .orbit import orbit_of_cameras
from .pointcloud import SH_C0, PointCloud

RANDOM_POINTS = 100_000  # as 3DGS
HALF_SIDE = 1.3  # of the cube that random points fill: the extent of the NeRF-synthetic scenes
DISTANCES = 1.5  # half the side of that cube in a capture, times the distance of its farthest camera
MAX_SKEW = 1e-3  # of a rotation, as far as rounded json numbers may leave it
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
PERSPECTIVE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
# From OpenGL's camera axes (y up, z backward) to ours (y down, z forward).
FLIP = np.diag([1.0, -1.0, -1.0])


def read_nerf_layout(folder: str, config: TrainConfig) -> Layout:
    """Reads both json files and points3d.ply if there is one; else points are random. Raises SceneError."""
    train = _read_transforms(folder, NERF_SYNTHETIC)
    test = []
    if is_file(os.path.join(folder, "transforms_test.json")):
        test = _read_transforms(folder, "transforms_test.json")
    path = os.path.join(folder, "points3d.ply")
    if is_file(path):
        points = _read_points(path)
    else:
        points = random_points(config.init_points or RANDOM_POINTS, config.seed)
    return Layout("nerf-synthetic", train, test, points, "transforms_test.json lists the test images")


def read_transforms_layout(folder: str, config: TrainConfig) -> Layout:
    """Reads transforms.json, and the points that its `ply_file_path` names; else points are random. Raises SceneError.

    Test images are those that it lists, else every so many by --test-every.
    """
    path = os.path.join(folder, TRANSFORMS)
    content = _read_json(path)
    images = [_posed_image(folder, path, content, index) for index in range(len(content["frames"]))]
    train, test, split = _listed_split(folder, path, content, images) or hold_out(images, config.test_every)
    points = content.get("ply_file_path")
    if points is not None and not isinstance(points, str):
        raise SceneError(f"{path}: `ply_file_path` is {reprlib.repr(points)}; it must be the name of a file")
    if points is not None:
        return Layout("transforms", train, test, _read_points(_below(folder, points)), split)
    cameras = [image.camera for image in images]
    middle = orbit_of_cameras(cameras).target
    farthest = max(float(np.linalg.norm(camera.center - middle)) for camera in cameras)
    cloud = random_points(config.init_points or RANDOM_POINTS, config.seed, middle, DISTANCES * farthest or HALF_SIDE)
    return Layout("transforms", train, test, cloud, split)


def _listed_split(folder: str, path: str, content: Dict[str, Any], images: List[PosedImage]) -> Optional[
        Tuple[List[PosedImage], List[PosedImage], str]]:
    """The split that nerfstudio's lists of file names make; None without such lists.

    If only one list is there, all other frames are of the other kind. Raises SceneError.
    """
    lists: Dict[str, List[str]] = {}
    for kind in ("train", "test", "val"):
        names = content.get(f"{kind}_filenames")
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise SceneError(f"{path}: `{kind}_filenames` must be a list of file names")
        lists[kind] = [_name_of(folder, _image_path(folder, name)) for name in names]
        unknown = sorted({*lists[kind]} - {image.camera.name for image in images})
        if unknown:
            raise SceneError(f"{path}: `{kind}_filenames` names {unknown[0]}, which is not a frame")
    if not lists:
        return None
    test_kind = "test" if "test" in lists or "val" not in lists else "val"
    chosen = {kind: {*lists[kind]} for kind in ("train", test_kind) if kind in lists}
    train = [image for image in images if image.camera.name in chosen.get("train", ())
             or "train" not in chosen and image.camera.name not in chosen[test_kind]]
    test = [image for image in images if image.camera.name in chosen.get(test_kind, ())
            or test_kind not in chosen and image.camera.name not in chosen["train"]]
    unused = len(images) - len({image.camera.name for image in [*train, *test]})
    said = f", {unused} images are in neither list" if unused else ""
    return train, test, f"{TRANSFORMS} lists the {test_kind if test_kind in lists else 'training'} images{said}"


def random_points(count: int, seed: int, middle: Any = (0.0, 0.0, 0.0), half_side: float = HALF_SIDE) -> PointCloud:
    """Uniform points in a cube, all but grey, as 3DGS starts on NeRF-synthetic scenes."""
    random = np.random.RandomState(seed)
    positions = random.uniform(-half_side, half_side, (count, 3)) + np.asarray(middle)
    return PointCloud(positions, 0.5 + SH_C0 * random.uniform(0, 1 / 255, (count, 3)), measured=False)


def _read_points(path: str) -> PointCloud:
    try:
        points = io.read_points(path)
    except (OSError, ValueError) as error:
        raise SceneError(said_of(error)) from error
    colors = points.colors if points.colors is not None else np.full(points.positions.shape, 128, np.uint8)
    return PointCloud(np.asarray(points.positions, np.float64), colors / 255.0).checked(path)


def _read_transforms(folder: str, name: str) -> List[PosedImage]:
    path = os.path.join(folder, name)
    content = _read_json(path)
    return [_posed_image(folder, path, content, index) for index in range(len(content["frames"]))]


def _read_json(path: str) -> Dict[str, Any]:
    """What the file says, with at least one frame. Raises SceneError."""
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
    return content


def _below(folder: str, name: str) -> str:
    """The path of a name in the file, which a program on Windows may have written."""
    path = os.path.join(folder, name)
    return path if is_file(path) else os.path.join(folder, name.replace("\\", "/"))


def _image_path(folder: str, name: str) -> str:
    """A path without an ending gets the ending of the file that is there, else .png."""
    path = _below(folder, name)
    if os.path.splitext(path)[1]:
        return path
    return next((path + ending for ending in (".png", ".jpg", ".jpeg") if is_file(path + ending)), path + ".png")


def _name_of(folder: str, path: str) -> str:
    """The path below the scene folder, since train/r_0.png and test/r_0.png are two images."""
    return os.path.relpath(path, folder).replace(os.sep, "/")


def _posed_image(folder: str, json_path: str, content: Dict[str, Any], index: int) -> PosedImage:
    frame = content["frames"][index]
    where = f"{json_path}: frame {index}"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise SceneError(f"{where}: `file_path` is missing")
    try:
        matrix = np.array(frame.get("transform_matrix"), np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.abs(matrix).max() <= LARGEST:
        raise SceneError(f"{where}: `transform_matrix` must be 4 rows of 4 numbers of at most {LARGEST:g}")
    image_path = _image_path(folder, frame["file_path"])
    is_there = is_file(image_path)  # else `without_missing` takes it out again
    width, height = image_size(image_path) if is_there else (1, 1)

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

    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > MAX_SKEW:  # as of a transposed matrix
        raise SceneError(f"{where}: the last row of `transform_matrix` is {matrix[3].tolist()}; it must be 0, 0, 0, 1")
    if np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() > MAX_SKEW:
        raise SceneError(f"{where}: the left 3x3 block of `transform_matrix` must be a rotation")
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise SceneError(f"{where}: the left 3x3 block of `transform_matrix` mirrors (its determinant is -1); "
                         "it must be a rotation")
    camera_to_world = matrix[:3, :3] @ FLIP
    rotation = camera_to_world.T
    # Intrinsics in pixels refer to the size that the json gives, if it gives one.
    json_width, json_height = whole("w", width), whole("h", height)
    given = "fl_x" in frame or "fl_x" in content
    model = frame.get("camera_model", content.get("camera_model"))
    if model == AROUND:
        focal_x = json_width / (2 * math.pi)  # nothing reads it
    else:
        focal_x = positive("fl_x", 0) if given else _focal(content, frame, json_width, where)
    camera = Camera(_name_of(folder, image_path), rotation, -rotation @ matrix[:3, 3], focal_x,
                    positive("fl_y", focal_x), number("cx", json_width / 2), number("cy", json_height / 2),
                    json_width, json_height)
    lens = _lens(model, content.get("is_fisheye") is True,
                 {key: number(key, 0) for key in DISTORTION}, where)
    mask = frame.get("mask_path")
    if mask is None or not is_there:
        return PosedImage(camera, image_path, lens=lens)
    mask_path = _below(folder, mask) if isinstance(mask, str) else None
    if mask_path is None or not is_file(mask_path):
        raise SceneError(f"{where}: `mask_path` is {reprlib.repr(mask)}: no such file")
    return PosedImage(camera, image_path, mask_path, lens)


def _lens(model: Any, is_fisheye: bool, coefficients: Dict[str, float], where: str) -> Optional[Lens]:
    """The lens of a frame by its `camera_model`, which instant-ngp's `is_fisheye` stands for. Raises SceneError."""
    if model is None:
        model = "OPENCV_FISHEYE" if is_fisheye else "OPENCV"
    if model not in (*PERSPECTIVE_MODELS, "OPENCV_FISHEYE", AROUND):
        raise SceneError(f"{where}: `camera_model` is {reprlib.repr(model)}; it must be one of "
                         f"{', '.join(PERSPECTIVE_MODELS)}, OPENCV_FISHEYE, {AROUND}")
    known = () if model == AROUND else FISHEYE if model == "OPENCV_FISHEYE" else PERSPECTIVE[:5]
    unknown = next((key for key, value in coefficients.items() if value and key not in known), None)
    if unknown:
        raise SceneError(f"{where}: `{unknown}` is {coefficients[unknown]:g}; a lens of `camera_model` {model} has "
                         f"{' '.join(known) or 'no distortion'}, so it must be 0")
    return Lens(AROUND, False, ()) if model == AROUND else lens_of(model, model == "OPENCV_FISHEYE", coefficients)


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
