"""Loads a scene folder: cameras, images, the train/test split and the points to start from.

Four kinds are known: COLMAP (a sparse model beside a folder of images), transforms.json, NeRF-synthetic
(transforms_train.json), and the folder of a trained model (cameras.json), whose images are its renderings.
Everything that can be wrong with a folder is a SceneError here, before training starts.
"""
from __future__ import annotations

import dataclasses
import hashlib
import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Callable, Dict, Hashable, Iterable, List, Mapping, Optional, Sequence

import numpy as np

from ..errors import SceneError
from ..options.config import IMAGES, TrainConfig
from ..options.early import NERF_SYNTHETIC, SPARSE, TRANSFORMS, check_scene
from ..system.files import is_file, is_folder
from .cameras import LARGEST, Camera, scene_extent
from .colmap import read_colmap_layout
from .images import MAX_WIDTH, View, fitted_camera, load_views, shown_by_lens, size_of_image
from .layout import Layout, PosedImage, check_lenses, with_lenses, with_masks, without_missing
from .lens import NOT_UNDISTORTED
from .modelfolder import read_model_layout, rendered_views
from .nerf import read_nerf_layout, read_transforms_layout
from .pointcloud import PointCloud
from .straight import pinhole_every
from .undistortion import trains_natively, undistorted

if TYPE_CHECKING:
    from ..starting import Start


@dataclass(frozen=True)
class Scene:
    """A loaded scene."""

    kind: str
    train: Sequence[View]
    test: Sequence[View]
    points: PointCloud
    extent: float  # world units
    split: str
    note: str = ""  # what was done to its images, in a line
    missing: int = 0  # images that were left out
    start: Optional[Start] = None  # a model to start from, whose places are then the points

    def to(self, device: str) -> Scene:
        """The same scene with its images on `device`."""

        return self._map(lambda view: view.to(device))

    def centred(self) -> Scene:
        """The same scene as --principal-point centre loads it."""
        return self._map(lambda view: dataclasses.replace(view, camera=view.camera.centred()))

    def starting_with(self, start: Start) -> Scene:
        """The same scene with a model to start from."""
        return dataclasses.replace(self, start=start, points=start.points())

    def _map(self, change: Callable[[View], View]) -> Scene:
        return dataclasses.replace(self, train=[change(view) for view in self.train],
                                   test=[change(view) for view in self.test])


def load_scene(config: TrainConfig, progress: bool = True, layout: Optional[Layout] = None,
               checksums: bool = True) -> Scene:
    """Reads the folder config.scene with the config's resolution, background, principal point and initial points.

    layout: what `read_layout` gave, if it is at hand. checksums: whether `scene_fingerprint` is to know the images'
    content, as a training must, which can be resumed. Raises SceneError naming the file and the reason.
    """
    layout, note = undistorted(layout or read_layout(config), config.scene, progress)
    posed = [*layout.train, *layout.test]
    images = rendered_views(layout.model, posed, config) if layout.model else load_views(
        posed, config, progress, checksums)
    train, test = images[:len(layout.train)], images[len(layout.train):]
    points = layout.points.subset(config.init_points, config.seed).subset(config.most_points, config.seed)
    extent = scene_extent(np.stack([view.camera.center for view in train]))
    scene = Scene(layout.kind, train, test, points, extent, layout.split, note, len(layout.missing))
    if not config.init:
        return scene
    from ..starting import read_start  # late: what makes scenes needs no extension

    return scene.starting_with(read_start(config.init))


def read_layout(config: TrainConfig) -> Layout:
    """Reads everything of a scene folder but its images, whose presence it checks."""
    folder = config.scene
    check_scene(folder)
    if is_file(os.path.join(folder, NERF_SYNTHETIC)):
        layout = read_nerf_layout(folder, config)
    elif is_folder(os.path.join(folder, SPARSE)):
        layout = read_colmap_layout(folder, config)
    elif is_file(os.path.join(folder, TRANSFORMS)):
        layout = read_transforms_layout(folder, config)
    else:
        return _checked(folder, read_model_layout(folder, config))
    if layout.kind != "colmap" and config.images != IMAGES:
        raise SceneError(f"scene {folder}: --images is {config.images!r}, which is for a COLMAP scene; "
                         f"{NERF_SYNTHETIC if layout.kind == 'nerf-synthetic' else TRANSFORMS} says where its "
                         "images are")
    layout = without_missing(folder, layout, config.strict)
    if not layout.train:
        raise SceneError(f"scene {folder}: no training image is left after the split ({layout.split}); "
                         "--test-every 0 keeps none for testing")
    layout = with_masks(folder, _checked(folder, layout))
    check_lenses(folder, layout)
    return with_lenses(layout) if trains_natively(layout, config.lenses) else layout


def describe_scene(scene: Scene, layout: Layout, config: TrainConfig) -> str:
    """What was loaded, in a line, and what is to be known of it, in further ones; layout: what it was loaded from."""
    views = [*scene.train, *scene.test]
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    size = " to ".join(f"{width}x{height}" for width, height in sizes[::max(1, len(sizes) - 1)])
    first, file_size = scene.train[0].camera, size_of_image(layout.train[0])
    if (first.width, first.height) != file_size:
        why = f", at most {MAX_WIDTH} wide" if config.resolution == -1 else ""
        size += f" (scaled from {file_size[0]}x{file_size[1]} by --resolution {config.resolution}{why})"
    count, there = len(scene.points.positions), len(layout.points.positions)
    points = f"{count:,} points" if count == there else f"{count:,} of {there:,} points"
    if scene.start:
        points = f"{count:,} Gaussians of a model"
    lines = [layout.warning, scene.note]
    models = sorted({view.camera.lens.model for view in views if view.camera.lens})
    if models:
        chosen = config.lenses == "auto" and layout.kind != "model"  # whose renderings keep any lens
        cannot = ", since OpenCV cannot undistort them" if set(models) <= NOT_UNDISTORTED else ""
        why = (cannot or ", since undistortion would cut off much of them") if chosen else ""
        masked = any(shown_by_lens(view.camera) is not None for view in views)
        every = pinhole_every(scene.train, config.iterations)
        lines.append(f"images of camera model {', '.join(models)} stay as they are{why}; Gaussians are projected "
                     f"through it{f', in a training each {every}th time by a pinhole camera' * (every > 0)}"
                     f"{', pixels beyond the lens are masked' * masked}")
    if config.batch > len(scene.train):
        lines.append(f"note: a step of --batch {config.batch} shows some of the {len(scene.train)} training images "
                     "more than once")
    return (f"{len(scene.train)} training and {len(scene.test)} test images ({scene.split}), {size} pixels, {points} "
            "to start from" + "".join(f"\n{line}" for line in lines if line))


def scene_fingerprint(scene: Scene) -> Dict[str, Any]:
    """Plain values that differ between scenes and stay when a folder is moved: what a resumed run must find again."""

    def lines(texts: Iterable[str]) -> str:
        return _checksum("\n".join(sorted(texts)).encode("utf-8", "surrogateescape"))  # a name may not be UTF-8

    def names_and_sizes(views: Sequence[View]) -> str:
        return lines(f"{view.camera.name} {view.camera.width}x{view.camera.height}" for view in views)

    def files(views: Sequence[View]) -> str:
        return lines(f"{view.camera.name} {view.checksum}" for view in views)

    views = [*scene.train, *scene.test]
    return {
        "number of training views": len(scene.train),
        "number of test views": len(scene.test),
        "number of masks": sum(view.mask is not None for view in views),
        "number of points": len(scene.points.positions),
        # Six digits, since another numpy may sum in another order.
        "extent": f"{scene.extent:.6g}",
        "checksum of the training views' names and sizes": names_and_sizes(scene.train),
        "checksum of the test views' names and sizes": names_and_sizes(scene.test),
        "checksum of the points": _checksum(scene.points.positions.tobytes() + scene.points.colors.tobytes()),
        "checksum of the poses": _checksum(b"".join(_pose(view.camera, scene.extent) for view in views)),
        "checksum of the intrinsics": _checksum(b"".join(_intrinsics(view.camera) for view in views)),
        "checksum of the training images": files(scene.train),
        "checksum of the test images": files(scene.test),
    }


def difference_of(scene: Scene, recorded: Mapping[str, Any]) -> str:
    """The first difference from a recorded `scene_fingerprint`, as "NAME X there and Y"; "" if there is none."""
    for name, here in scene_fingerprint(scene).items():
        there = recorded.get(name)
        if here != there:
            return f"{name} {there} there and {here}"
    return ""


def _pose(camera: Camera, extent: float) -> bytes:
    """A camera's pose, to a millionth of the scene's extent: another version may round the last digits otherwise."""
    return _rounded([*camera.rotation.reshape(-1), *(camera.translation / extent)], 6)


def _intrinsics(camera: Camera) -> bytes:
    """To a 10,000th of a pixel."""
    lens = repr((camera.lens.camera_model, camera.lens.coefficients)).encode() if camera.lens else b""
    return _rounded([camera.fx, camera.fy, camera.cx, camera.cy], 4) + lens


def _rounded(values: Sequence[float], digits: int) -> bytes:
    return (np.round(np.asarray(values, "<f8"), digits) + 0.0).tobytes()  # + 0.0 makes 0 of -0


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def load_cameras(config: TrainConfig, split: str) -> List[Camera]:
    """The cameras of "train", "test" or "all" images at the config's resolution; images are not decoded."""
    layout = read_layout(config)
    if layout.warning:
        print(layout.warning, file=sys.stderr)
    posed = {"train": layout.train, "test": layout.test, "all": list(layout.train) + list(layout.test)}[split]
    return [fitted_camera(image, size_of_image(image), config) for image in posed]


def _identity(image: PosedImage) -> Hashable:
    """What two paths to one file have in common, also by links."""
    status = os.stat(image.path)
    return (status.st_dev, status.st_ino) if status.st_ino else os.path.realpath(image.path)


def _checked(folder: str, layout: Layout) -> Layout:
    """The layout, with what its split leaves unsaid.

    Raises SceneError for an image that is there twice, by whatever path, and for a camera that float32 cannot hold.
    """
    every = [*layout.train, *layout.test]
    both = set() if layout.model else {*map(_identity, layout.train)} & {*map(_identity, layout.test)}
    if both and layout.kind == "nerf-synthetic":  # each of its files may list any images
        layout = dataclasses.replace(layout, split=f"{layout.split}, {len(both)} of which are training images too")
    for images in () if layout.model else (layout.train, layout.test) if layout.kind == "nerf-synthetic" else (every,):
        seen: Dict[Hashable, str] = {}
        for image in images:
            name, file = image.camera.name, _identity(image)
            if file in seen:
                also = f" (also as {seen[file]})" if seen[file] != name else ""
                raise SceneError(f"scene {folder}: the image {name} is listed twice{also}; each must be listed once, "
                                 "to train on or to test")
            seen[file] = name
    for image in every:
        camera = image.camera
        numbers = [*camera.translation, camera.fx, camera.fy, camera.cx, camera.cy]
        if not (np.abs(numbers).max() <= LARGEST and min(camera.fx, camera.fy) >= 1 / LARGEST):
            raise SceneError(f"scene {folder}: the camera of {camera.name} has the translation "
                             f"{camera.translation.tolist()} and fx, fy, cx, cy {numbers[3:]}; no number may be above "
                             f"{LARGEST:g}, and no focal length below {1 / LARGEST:g}")
    return layout
