"""What a scene folder says before any image is read, and the train/test split."""
from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from typing import List, Optional, Sequence, Tuple

from ..errors import SceneError
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
    made_from: str = ""  # where image and mask are copies without distortion: a checksum of what they are made from


@dataclass(frozen=True)
class Layout:
    """What a scene folder says, images unread."""

    kind: str  # "colmap", "transforms" or "nerf-synthetic"
    train: Sequence[PosedImage]
    test: Sequence[PosedImage]
    points: PointCloud
    split: str  # how test images are chosen, for the protocol


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


def check_files(paths: Sequence[str]) -> None:
    """Raises SceneError naming the first missing image and how many are missing."""
    missing = [path for path in paths if not is_file(path)]
    if missing:
        raise SceneError(f"{missing[0]}: no such image ({len(missing)} of {len(paths)} images are missing)")


def with_masks(folder: str, layout: Layout) -> Layout:
    """The layout with each image's mask, where the scene has a folder of masks.

    A mask is named as its image, with .png behind the name or in place of its extension, in the same subfolder.
    Raises SceneError where an image has none.
    """
    masks = os.path.join(folder, MASKS)
    if any(image.mask for image in [*layout.train, *layout.test]):  # the scene's own file names them
        return layout
    if not is_folder(masks):
        if os.path.lexists(masks):
            raise SceneError(f"{masks} is no folder; masks must lie in one, one image each")
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
