"""Images of bent lenses become those of a pinhole camera, by OpenCV; they are kept in a folder beside the scene."""
from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from typing import Any, List, Sequence, Tuple

import numpy as np
from PIL import Image

from ..errors import SceneError
from ..system.files import is_file
from ..system.process import pip_install
from ..system.progress import progress_bar
from .cameras import Camera
from .images import UNREADABLE, image_size, open_image
from .layout import Layout, PosedImage
from .lens import Lens

CACHE_VARIABLE = "DSMOE_CACHE"  # a folder for undistorted images, in place of the scene's own
CACHE_NAME = ".dsmoe_cache"  # of a scene's folder
VERSION = 1  # of what is done here; another one is another file
SAMPLES = 4096  # of the distortion along a radius


def undistorted(layout: Layout, scene: str, progress: bool) -> Tuple[Layout, str]:
    """The layout with pinhole images in place of bent ones, and a line about that; empty where none are bent.

    The pinhole camera has the focal lengths, the principal point and the size of the bent one: what lies beyond its
    borders is cut off, and pixels that the lens does not show are masked. Raises SceneError, also without OpenCV.
    """
    images = [*layout.train, *layout.test]
    bent = [image for image in images if image.lens]
    if not bent:
        return layout, ""
    models = ", ".join(sorted({image.lens.model for image in bent}))
    if not _opencv():
        raise SceneError(f"scene {scene}: {len(bent)} images have lens distortion (camera model {models}); OpenCV "
                         f"removes it: {pip_install('opencv-python-headless')}, then type the same command")
    folder = cache_folder(scene)
    os.makedirs(folder, exist_ok=True)
    new = sum(not is_file(_image_path(image, folder)) for image in bent)
    with ThreadPoolExecutor(min(8, 2 * (os.cpu_count() or 1))) as pool:
        working = pool.map(lambda image: _undistorted_image(image, folder) if image.lens else image, images)
        done = list(progress_bar(working, total=len(images), desc="undistortion", unit="image", leave=False,
                                 disable=not progress or not new))
    for kept in (_maps, _valid):  # they are as large as images
        kept.cache_clear()
    train, test = done[:len(layout.train)], done[len(layout.train):]
    masked = ", pixels beyond the lens are masked" if any(image.mask for image in done) else ""
    said = (f"{len(bent)} images of camera model {models} are undistorted by OpenCV ({new} of them now) in "
            f"{folder}{masked}")
    return dataclasses.replace(layout, train=train, test=test), said


def cache_folder(scene: str) -> str:
    """Where undistorted images are kept: $DSMOE_CACHE, else a folder in the scene, else one of the user's cache."""
    scene = os.path.abspath(scene)
    own = os.path.join(scene, CACHE_NAME)
    if not os.environ.get(CACHE_VARIABLE) and os.access(own if os.path.isdir(own) else scene, os.W_OK):
        return own
    usual = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    root = os.environ.get(CACHE_VARIABLE) or os.path.join(usual, "dsmoe")
    return os.path.join(root, f"{os.path.basename(scene)}-{hashlib.sha256(scene.encode()).hexdigest()[:8]}")


def _opencv() -> Any:
    """The module cv2; None where it is not installed."""
    try:
        import cv2
    except ImportError:
        return None
    return cv2


def _image_path(image: PosedImage, folder: str) -> str:
    return os.path.join(folder, _name(_intrinsics(image.camera), image.lens, image.camera.name, _state(image.path)))


def _mask_path(image: PosedImage, folder: str, camera: Camera) -> str:
    """Images of one camera share the mask, but where they have masks of their own."""
    own = (image.camera.name, _state(image.mask)) if image.mask else ()
    return os.path.join(folder, "mask-" + _name(_intrinsics(camera), image.lens, *own))


def _intrinsics(camera: Camera) -> Tuple[float, ...]:
    return (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)


def _state(path: str) -> Tuple[int, int]:
    """What changes with the content of a file."""
    status = os.stat(path)
    return status.st_size, status.st_mtime_ns


def _name(*what: Any) -> str:
    return hashlib.sha256(repr((VERSION, what)).encode()).hexdigest()[:20] + ".png"


def _undistorted_image(image: PosedImage, folder: str) -> PosedImage:
    """The image without distortion; a mask is written before its image, which so tells that both are there."""
    path = _image_path(image, folder)
    camera = image.camera.resized(*image_size(image.path))
    mask = _mask_path(image, folder, camera)
    if not is_file(path):
        bent = _read(image.path)
        valid = _valid(_intrinsics(camera), image.lens)
        if image.mask:
            own = _read(image.mask).convert("L").resize(bent.size, Image.BILINEAR)
            valid = np.where(valid, np.asarray(_remapped(own, camera, image.lens)), 0).astype(np.uint8)
        if not valid.all() or image.mask:
            _write(Image.fromarray(valid.astype(np.uint8) * (1 if image.mask else 255)), mask)
        _write(_remapped(bent, camera, image.lens), path)
    return dataclasses.replace(image, camera=camera, path=path, lens=None, mask=mask if is_file(mask) else None)


def _read(path: str) -> Image.Image:
    try:
        with open_image(path) as file:
            if file.mode == "F" or file.mode.startswith("I"):
                raise ValueError(f"its pixels have more than 8 bits (Pillow's mode {file.mode}); convert it to 8 bits")
            has_alpha = file.mode in ("RGBA", "LA", "PA") or "transparency" in file.info
            return file.convert("RGBA" if has_alpha else "RGB")
    except UNREADABLE as error:
        raise SceneError(f"{path}: not a readable image ({error})") from error


def _write(image: Image.Image, path: str) -> None:
    """Writes a PNG that is whole or absent, whoever else writes the same."""
    handle, temporary = tempfile.mkstemp(dir=os.path.dirname(path), suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            image.save(file, "PNG", compress_level=1)
        os.replace(temporary, path)
    except BaseException:
        os.remove(temporary)
        raise


def _remapped(image: Image.Image, camera: Camera, lens: Lens) -> Image.Image:
    cv2 = _opencv()
    x, y = _maps(_intrinsics(camera), lens)
    return Image.fromarray(cv2.remap(np.asarray(image), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


@functools.lru_cache(maxsize=4)
def _maps(intrinsics: Sequence[float], lens: Lens) -> Tuple[np.ndarray, np.ndarray]:
    """[H, W] float32: where each pixel of the pinhole camera lies in the bent image, in columns and rows from 0."""
    cv2 = _opencv()
    fx, fy, cx, cy, width, height = intrinsics
    # OpenCV's pixel coordinates are 0 at the first pixel's centre, ours 0.5.
    K = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    make = cv2.fisheye.initUndistortRectifyMap if lens.is_fisheye else cv2.initUndistortRectifyMap
    return make(K, np.array(lens.coefficients), np.eye(3), K, (int(width), int(height)), cv2.CV_32FC1)


@functools.lru_cache(maxsize=4)
def _valid(intrinsics: Sequence[float], lens: Lens) -> np.ndarray:
    """[H, W] bool: the pixels of the pinhole camera that the lens shows.

    Beyond some radius a polynomial may fall again, and show parts of the image a second time.
    """
    fx, fy, cx, cy, width, height = intrinsics
    x, y = _maps(intrinsics, lens)
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    columns, rows = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    radius = np.hypot(columns, rows)
    return inside & (radius < _last_radius(lens, float(radius.max())))


def _last_radius(lens: Lens, largest: float) -> float:
    """Up to which radius, on the plane at depth 1, the distorted one grows with it; infinite if up to `largest`."""
    if lens.is_fisheye:
        angle = np.linspace(0, np.arctan(largest), SAMPLES)
        radius, square = np.tan(angle), angle**2
        k1, k2, k3, k4 = lens.coefficients
        distorted = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    else:
        radius = np.linspace(0, largest, SAMPLES)
        square = radius**2
        k1, k2, _, _, k3, k4, k5, k6 = lens.coefficients
        distorted = radius * (1 + square * (k1 + square * (k2 + square * k3))) / (
            1 + square * (k4 + square * (k5 + square * k6)))
    falls: List[int] = np.flatnonzero(np.diff(distorted) <= 0).tolist()
    return float(radius[falls[0]]) if falls else np.inf
