"""What a scene folder says before any image is read, and the train/test split."""
from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from typing import Dict, Hashable, List, Optional, Sequence, Tuple

from ..errors import SceneError, printable
from ..system.files import is_file, is_folder
from .cameras import Camera
from .lens import Lens
from .pointcloud import PointCloud

MASKS = "masks"  # folder of a scene, beside its images


@dataclass(frozen=True)
class PosedImage:
    """A camera and the file of its image, not yet read; the camera's size may differ from the file's."""

    camera: Camera
    path: str
    mask: Optional[str] = None  # the file that says which pixels count
    lens: Optional[Lens] = None  # what bends the image; the camera is the pinhole camera without it
    made_from: str = ""  # if image and mask are copies without distortion: a checksum of what they are made from


@dataclass(frozen=True)
class Layout:
    """What a scene folder says, images unread."""

    kind: str  # "colmap", "transforms", "nerf-synthetic" or "model"
    train: Sequence[PosedImage]
    test: Sequence[PosedImage]
    points: PointCloud
    split: str  # how test images are chosen, for the protocol
    model: str = ""  # the .ply whose renderings are the images; empty: these are files
    missing: Sequence[str] = ()  # images that the folder names and has not, by name; they are in neither list

    @property
    def warning(self) -> str:
        """A line about missing images; empty if there are none."""
        if not self.missing:
            return ""
        every = len(self.missing) + len(self.train) + len(self.test)
        more = ", ..." if self.missing[3:] else ""
        return (f"warning: {len(self.missing)} of {every} images are missing and left out: "
                f"{printable(', '.join(self.missing[:3]))}{more}; --strict refuses such a scene")


def hold_out(images: Sequence[PosedImage], every: int = 8) -> Tuple[List[PosedImage], List[PosedImage], str]:
    """Training and test images: sorted by name, every so many from the first on is a test image. And this in words.

    every: 0, no test images.
    """
    ordered = sorted(images, key=lambda image: image.camera.name)
    if every == 0:
        return ordered, [], "no image is kept for testing"
    train = [image for index, image in enumerate(ordered) if index % every != 0]
    ordinal = {2: "2nd", 3: "3rd"}.get(every, f"{every}th")
    return train, ordered[::every], f"sorted by name, every {ordinal} is a test image"


def without_missing(folder: str, layout: Layout, strict: bool) -> Layout:
    """The layout without images whose files are not there; what is a test image does not change by that.

    Raises SceneError if all training images are missing, with `strict` if any image is.
    """
    every = [*layout.train, *layout.test]
    missing = [image for image in every if not is_file(image.path)]
    train, test = ([image for image in images if is_file(image.path)] for images in (layout.train, layout.test))
    if missing and (strict or not train):
        rather = "; without --strict they are left out" if train else ""
        raise SceneError(f"{missing[0].path}: no such image ({len(missing)} of {len(every)} images of {folder} are "
                         f"missing{rather})")
    return dataclasses.replace(layout, train=train, test=test, missing=[image.camera.name for image in missing])


def check_lenses(folder: str, layout: Layout) -> None:
    """Raises SceneError for a lens that cannot be that of its image."""
    for camera, lens in each_lens(layout):
        try:
            lens.check(max(camera.fx, camera.fy), camera.width, camera.height)
        except ValueError as error:
            raise SceneError(f"scene {folder}: {camera.name}: {error}") from error


def each_lens(layout: Layout) -> List[Tuple[Camera, Lens]]:
    """The lenses of the images, each with the camera of its first image; other intrinsics count as another lens."""
    found: Dict[Hashable, Tuple[Camera, Lens]] = {}
    for image in [*layout.train, *layout.test]:
        camera, lens = image.camera, image.lens
        if lens:
            of_size = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
            found.setdefault((lens, of_size), (camera, lens))
    return [*found.values()]


def with_lenses(layout: Layout) -> Layout:
    """The layout with each image's lens in its camera, so that nothing is to be undistorted."""
    def native(image: PosedImage) -> PosedImage:
        return dataclasses.replace(image, camera=dataclasses.replace(image.camera, lens=image.lens), lens=None)

    return dataclasses.replace(layout, train=[native(image) if image.lens else image for image in layout.train],
                               test=[native(image) if image.lens else image for image in layout.test])


def with_masks(folder: str, layout: Layout) -> Layout:
    """The layout with each image's mask, if the scene has a folder of masks.

    A mask is named as its image, with .png behind the name or in place of its extension, in the same subfolder.
    Raises SceneError if an image has none.
    """
    masks = os.path.join(folder, MASKS)
    if any(image.mask for image in [*layout.train, *layout.test]):  # the scene's own file names them
        return layout
    if not is_folder(masks):
        if os.path.lexists(masks):
            raise SceneError(f"{masks} is not a folder; masks must lie in one, one image each")
        return layout

    def with_mask(image: PosedImage) -> PosedImage:
        names = [image.camera.name + ".png", os.path.splitext(image.camera.name)[0] + ".png"]
        for name in names:
            if is_file(os.path.join(masks, name)):
                return dataclasses.replace(image, mask=os.path.join(masks, name))
        raise SceneError(f"{masks}: the image {image.camera.name} has no mask there; it must be {names[0]} or "
                         f"{names[1]} (without masks, every pixel counts: rename the folder)")

    return dataclasses.replace(layout, train=[with_mask(image) for image in layout.train],
                               test=[with_mask(image) for image in layout.test])
