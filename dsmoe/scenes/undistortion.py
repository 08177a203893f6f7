"""Images of bent lenses become those of a pinhole camera, by OpenCV; they are kept in a folder beside the scene."""
from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Sequence, Tuple

import numpy as np
from PIL import Image

from ..errors import SceneError
from ..system.files import is_file, remove_unfinished, write_atomically
from ..system.process import pip_install
from ..system.progress import progress_bar
from .cameras import Camera
from .images import (
    UNREADABLE,
    check_depth,
    is_transparent,
    open_image,
    read_content,
    read_mask,
    size_of,
    unreadable,
)
from .layout import Layout, PosedImage, each_lens
from .lens import NOT_UNDISTORTED, Lens

CACHE_VARIABLE = "DSMOE_CACHE"  # a folder for undistorted images, in place of the scene's own
CACHE_NAME = ".dsmoe_cache"  # of a scene's folder
VERSION = 2  # of what is done here; another one is another file


MOST_CUT = 0.1  # of an image's pixels, beyond which undistortion loses more than a resampled image is worth
GRID = 64  # places along a side of an image by which that is counted


@dataclass(frozen=True)
class _Plan:
    """What a bent image becomes: its files in the cache, named by what it is made of."""

    bent: PosedImage
    camera: Camera  # of the pinhole image: the file's size
    content: str  # checksum of the image's file
    mask_content: str  # and of its own mask's; empty if it has none
    path: str  # the pinhole image
    mask: str  # which of its pixels count; if all do, `_all(mask)` is there in its place

    @property
    def has_image(self) -> bool:
        return is_file(self.path)

    @property
    def has_mask(self) -> bool:
        return is_file(self.mask) or is_file(_all(self.mask))

    def done(self) -> PosedImage:
        """The pinhole image, which is there."""
        made_from = _checksum(repr((self.bent.lens, self.content, self.mask_content)).encode())
        return dataclasses.replace(self.bent, camera=self.camera, path=self.path, lens=None, made_from=made_from,
                                   mask=self.mask if is_file(self.mask) else None)


def cut_off(camera: Camera, lens: Lens) -> float:
    """The part of an image's pixels, 0 to 1, that undistortion cuts off: by the radial part of the distortion.

    camera: without the lens.
    """
    if lens.model in NOT_UNDISTORTED:
        return 1.0
    steps = (np.arange(GRID) + 0.5) / GRID
    x, y = np.meshgrid((steps * camera.width - camera.cx) / camera.fx, (steps * camera.height - camera.cy) / camera.fy)
    radii, distorted = lens.radii
    radius = np.hypot(x, y)
    shown = radius < distorted[-1]
    straight = np.interp(radius, distorted, radii)
    if lens.is_fisheye:
        straight = np.tan(np.minimum(straight, 0.499 * np.pi))
    stretch = straight / np.maximum(radius, 1e-9)
    columns, rows = x * stretch * camera.fx + camera.cx, y * stretch * camera.fy + camera.cy
    kept = (columns >= 0) & (columns <= camera.width) & (rows >= 0) & (rows <= camera.height)
    return float((shown & ~kept).sum() / max(1, shown.sum()))


def trains_natively(layout: Layout, lenses: str) -> bool:
    """Whether a scene's images keep their lens, by --lenses."""
    return lenses == "native" or lenses == "auto" and any(cut_off(*one) > MOST_CUT for one in each_lens(layout))


def undistorted(layout: Layout, scene: str, progress: bool) -> Tuple[Layout, str]:
    """The layout with pinhole images in place of bent ones, and a line about that; empty if none are bent.

    The pinhole camera has the focal lengths, the principal point and the size of the bent one. What lies beyond its
    borders is cut off, and pixels that the lens does not show are masked. Raises SceneError, also without OpenCV.
    """
    images = [*layout.train, *layout.test]
    bent = [image for image in images if image.lens]
    if not bent:
        return layout, ""
    models = ", ".join(sorted({image.lens.model for image in bent}))
    unknown = sorted({image.lens.model for image in bent} & NOT_UNDISTORTED)
    if unknown:
        raise SceneError(f"scene {scene}: OpenCV does not remove the distortion of camera model {unknown[0]}; "
                         "--lenses native trains through it")
    if not _opencv():
        raise SceneError(f"scene {scene}: {len(bent)} images have lens distortion (camera model {models}); OpenCV "
                         f"removes it: {pip_install('opencv-python-headless')}, then type the same command; or "
                         "--lenses native trains through it")
    folder = cache_folder(scene)
    os.makedirs(folder, exist_ok=True)
    remove_unfinished(folder)
    with ThreadPoolExecutor(min(8, 2 * (os.cpu_count() or 1))) as pool:
        plans = list(pool.map(lambda image: _plan(image, folder), bent))
        makes_image = {plan.path: plan for plan in plans if not plan.has_image}  # one plan for each file
        makes_mask = {plan.mask: plan for plan in plans if not plan.has_mask}
        new = sum(plan.path in makes_image or plan.mask in makes_mask for plan in plans)

        def work(plan: _Plan) -> None:
            if makes_mask.get(plan.mask) is plan:
                _make_mask(plan)
            if makes_image.get(plan.path) is plan:
                _make_image(plan)

        for _ in progress_bar(pool.map(work, plans), total=len(plans), desc="undistortion", unit="image", leave=False,
                              disable=not progress or not new):
            pass
    for kept in (_maps, _valid):  # they are as large as images
        kept.cache_clear()
    made = iter([plan.done() for plan in plans])
    done = [next(made) if image.lens else image for image in images]
    train, test = done[:len(layout.train)], done[len(layout.train):]
    masked = ", pixels beyond the lens are masked" if any(image.mask for image in done) else ""
    said = (f"{len(bent)} images of camera model {models} are undistorted by OpenCV ({new} of them now) in "
            f"{folder}{masked}")
    return dataclasses.replace(layout, train=train, test=test), said


def cache_folder(scene: str) -> str:
    """The folder of undistorted images: $DSMOE_CACHE, else a folder in the scene, else one of the user's cache."""
    scene = os.path.abspath(scene)
    own = os.path.join(scene, CACHE_NAME)
    if not os.environ.get(CACHE_VARIABLE) and os.access(own if os.path.isdir(own) else scene, os.W_OK):
        return own
    usual = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    root = os.environ.get(CACHE_VARIABLE) or os.path.join(usual, "dsmoe")
    return os.path.join(root, f"{os.path.basename(scene)}-{hashlib.sha256(scene.encode()).hexdigest()[:8]}")


def _opencv() -> Any:
    """The module cv2; None if it is not installed."""
    try:
        import cv2
    except ImportError:
        return None
    return cv2


def _plan(image: PosedImage, folder: str) -> _Plan:
    """Reads the image and its mask: a file may change and keep its size and time."""
    content = read_content(image.path)
    camera = image.camera.resized(*size_of(content, image.path))
    own = _checksum(content)
    own_mask = _checksum(read_content(image.mask)) if image.mask else ""
    pinhole = (VERSION, _intrinsics(camera), image.lens)
    # Images of one camera share the mask, unless they have masks of their own.
    return _Plan(image, camera, own, own_mask, os.path.join(folder, _name(*pinhole, own)),
                 os.path.join(folder, "mask-" + _name(*pinhole, own_mask)))


def _intrinsics(camera: Camera) -> Tuple[float, ...]:
    return (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)


def _name(*what: Any) -> str:
    return _checksum(repr(what).encode())[:20] + ".png"


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _all(mask: str) -> str:
    """The name of an empty file that says: all pixels count. A mask that is missing says nothing."""
    return os.path.splitext(mask)[0] + ".all"


def _make_image(plan: _Plan) -> None:
    content = _unchanged(plan.bent.path, plan.content)
    try:
        with open_image(io.BytesIO(content)) as file:
            check_depth(file)
            bent = file.convert("RGBA" if is_transparent(file) else "RGB")
    except UNREADABLE as error:
        raise unreadable(plan.bent.path, error) from error
    _write(_remapped(bent, plan.camera, plan.bent.lens), plan.path)


def _make_mask(plan: _Plan) -> None:
    valid = _valid(_intrinsics(plan.camera), plan.bent.lens)
    if plan.bent.mask:
        size = (plan.camera.width, plan.camera.height)
        own = read_mask(_unchanged(plan.bent.mask, plan.mask_content), plan.bent.mask, plan.bent.path, size)
        kept = np.asarray(_remapped(own.resize(size, Image.BILINEAR), plan.camera, plan.bent.lens))
        valid = np.where(valid, kept, 0).astype(np.uint8)
        if not valid.any():
            raise SceneError(f"{plan.bent.mask}: the mask keeps no pixel of {plan.bent.path} without lens distortion")
    else:
        valid = valid.astype(np.uint8) * 255
    if valid.min() == 255:
        write_atomically(_all(plan.mask), lambda file: None)
    else:
        _write(Image.fromarray(valid), plan.mask)


def _unchanged(path: str, checksum: str) -> bytes:
    """The content of a file, which must be as it was planned. Raises SceneError."""
    content = read_content(path)
    if _checksum(content) != checksum:
        raise SceneError(f"{path} has changed while the scene was loaded; type the same command again")
    return content


def _write(image: Image.Image, path: str) -> None:
    write_atomically(path, lambda file: image.save(file, "PNG", compress_level=1))


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
    last = lens.radii[0][-1]
    return inside & ((np.arctan(radius) if lens.is_fisheye else radius) < last)
