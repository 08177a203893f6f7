"""Ground-truth images: read in parallel, composited, downscaled as 3DGS does."""
from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import BinaryIO, List, Optional, Sequence, Tuple, Union

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError

from diff_smoe_rasterization.images import as_float

from ..errors import SceneError
from ..options.config import TrainConfig
from ..system.progress import progress_bar
from .cameras import Camera
from .layout import PosedImage

MAX_WIDTH = 1600  # of images at resolution -1
MAX_PIXELS = 2**27  # of an image to train on, beyond which --resolution is taken for a mistake
# An image may have another size than its camera (images_4 beside a full-size model) but not another shape.
MAX_ASPECT_ERROR = 0.02
# What Pillow raises for damaged files.
UNREADABLE = (OSError, ValueError, SyntaxError, NotImplementedError, Image.DecompressionBombError)
DOWNSCALER = "pillow bicubic"
# Of files of images, whatever their names end in. Pillow knows more, and runs Ghostscript on EPS.
FORMATS = ("PNG", "JPEG", "MPO", "JPEG2000", "TIFF", "WEBP", "AVIF", "HEIF", "BMP", "GIF", "PPM", "TGA")


@dataclass(frozen=True)
class View:
    """A camera and its ground truth."""

    camera: Camera
    image: torch.Tensor  # [3, H, W] uint8, over black or white
    opacity: Optional[torch.Tensor] = None  # [1, H, W] uint8; --random-background: the alpha plane, if there is one
    mask: Optional[torch.Tensor] = None  # [1, H, W] uint8: 255, the pixel counts, to 0; None: all count
    checksum: str = ""  # of the image's file and the mask's, if it was asked for; else empty

    def image_float(self) -> torch.Tensor:
        """[3, H, W] in [0, 1]"""
        return as_float(self.image)

    def image_over(self, color: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
        """[3, H, W] in [0, 1]: an image with opacity over another colour [3] than its `background` [3]."""
        clear = 1 - as_float(self.opacity)
        return (self.image_float() + clear * (color - background)[:, None, None]).clamp(0, 1)

    def mask_float(self) -> Optional[torch.Tensor]:
        """[1, H, W] in [0, 1]; None if every pixel counts."""
        return None if self.mask is None else as_float(self.mask)

    def to(self, device: str) -> View:
        """The same view with its images on `device`."""
        planes = {name: getattr(self, name) for name in ("image", "opacity", "mask")}
        return dataclasses.replace(self, **{name: plane.to(device) for name, plane in planes.items()
                                            if plane is not None})


def open_image(file: Union[str, BinaryIO]) -> Image.Image:
    """The image in a file of one of the FORMATS, not read yet. Raises one of UNREADABLE."""
    Image.init()
    return Image.open(file, formats=[name for name in FORMATS if name in Image.OPEN])


def unreadable(path: str, error: Exception, is_made: bool = False) -> SceneError:
    """The error for a file whose reading raised one of UNREADABLE. is_made: whether this program has written it."""
    reason = getattr(error, "strerror", None) or error
    if isinstance(error, UnidentifiedImageError):  # which names a buffer
        reason = f"it is none of {', '.join(FORMATS)}"
    remedy = "; it is a copy without lens distortion: remove it, and the same command makes it anew" if is_made else ""
    return SceneError(f"{path}: not a readable image ({reason}){remedy}")


def target_size(width: int, height: int, resolution: int) -> Tuple[int, int]:
    """Image size (width, height) for a --resolution, by the rule of 3DGS.

    1, 2, 4, 8 divide and round (half to even); -1 caps the width at 1600; any other value is the width. The latter
    two truncate.
    """
    if resolution in (1, 2, 4, 8):
        return max(1, round(width / resolution)), max(1, round(height / resolution))
    if resolution == -1:
        factor = width / MAX_WIDTH if width > MAX_WIDTH else 1.0
    else:
        factor = width / resolution
    return max(1, int(width / factor)), max(1, int(height / factor))


def load_views(images: Sequence[PosedImage], config: TrainConfig, progress: bool, checksums: bool) -> List[View]:
    """Reads images in parallel threads, in order, with a progress bar."""
    with ThreadPoolExecutor(min(16, 2 * (os.cpu_count() or 1))) as pool:
        loading = pool.map(lambda image: load_view(image, config, checksums), images)
        return list(progress_bar(loading, total=len(images), desc="images", unit="image", disable=not progress,
                                 leave=False))


def load_view(posed: PosedImage, config: TrainConfig, checksum: bool) -> View:
    """Reads one image: transparency composited, then resized; the camera follows the size."""
    # Of the files, not of the pixels: another release of Pillow may decode the same JPEG to other pixels.
    hashed = hashlib.sha256(posed.made_from.encode()) if checksum else None

    def read(path: str) -> bytes:
        content = read_content(path)
        if hashed and not posed.made_from:
            hashed.update(content)
        return content

    content = read(posed.path)
    try:
        with open_image(io.BytesIO(content)) as file:
            image = composited(file, config.white_background)
            opacity = _opacity(file) if config.random_background else None
    except UNREADABLE as error:
        raise unreadable(posed.path, error, bool(posed.made_from)) from error
    camera = fitted_camera(posed, image.size, config)
    mask = shown_by_lens(camera)
    if posed.mask is not None:
        own = read_mask(read(posed.mask), posed.mask, posed.path, image.size, bool(posed.made_from))
        mask = _fitted_mask(own, posed, camera, mask)
    try:
        return View(camera, _planes(image, camera), None if opacity is None else _planes(opacity, camera), mask,
                    hashed.hexdigest() if hashed else "")
    except MemoryError as error:  # Pillow's says nothing
        raise SceneError(f"{posed.path}: the machine is out of memory at {camera.width}x{camera.height}; take smaller "
                         "images (--resolution)") from error


def read_content(path: str) -> bytes:
    """The content of an image's file. Raises SceneError."""
    try:
        with open(path, "rb") as file:
            return file.read()
    except OSError as error:
        raise unreadable(path, error) from error


def _planes(image: Image.Image, camera: Camera, resample: int = Image.BICUBIC) -> torch.Tensor:
    """[C, H, W] uint8: the image in the camera's size."""
    if (camera.width, camera.height) != image.size:
        image = image.resize((camera.width, camera.height), resample)
    return torch.from_numpy(np.atleast_3d(np.array(image))).permute(2, 0, 1).contiguous()


def read_mask(content: bytes, path: str, image_path: str, size: Tuple[int, int], is_made: bool = False) -> Image.Image:
    """The mask in a file of that content, in grey, of an image file of that size (width, height). Raises SceneError."""
    try:
        with open_image(io.BytesIO(content)) as file:
            mask = composited(file, white=False).convert("L")
    except UNREADABLE as error:
        raise unreadable(path, error, is_made) from error
    if abs(mask.width * size[1] / (mask.height * size[0]) - 1) > MAX_ASPECT_ERROR:
        raise SceneError(f"{path}: the mask is {mask.width}x{mask.height}, its image {image_path} "
                         f"{size[0]}x{size[1]}: another shape")
    if mask.getextrema()[1] == 1:
        raise SceneError(f"{path}: the mask has the values 0 and 1; white, which counts, must be 255")
    return mask


def shown_by_lens(camera: Camera) -> Optional[torch.Tensor]:
    """[1, H, W] uint8: 255 where the camera's lens shows something, and 0 beyond; None if nothing is beyond."""
    return _reached(dataclasses.replace(camera, name="", rotation=None, translation=None)) if camera.lens else None


@functools.lru_cache(maxsize=4)
def _reached(camera: Camera) -> Optional[torch.Tensor]:
    """As `shown_by_lens`; without pose, so that images of one camera share it."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    reached = x**2 + y[:, None] ** 2 < camera.lens.reach**2
    return None if reached.all() else torch.from_numpy(reached.astype(np.uint8) * 255)[None]


def _fitted_mask(mask: Image.Image, posed: PosedImage, camera: Camera, shown: Optional[torch.Tensor]) -> torch.Tensor:
    """[1, H, W] uint8: the mask in the camera's size; 0 where `shown` [1, H, W] is 0."""
    planes = _planes(mask, camera, Image.BILINEAR)  # which does not overshoot at edges
    if shown is not None:
        planes = torch.minimum(planes, shown)
    if not bool(planes.any()):
        raise SceneError(f"{posed.mask}: the mask keeps no pixel of {posed.path}; white is what counts, black is "
                         "ignored")
    return planes


def fitted_camera(posed: PosedImage, size: Tuple[int, int], config: TrainConfig) -> Camera:
    """The camera of an image file of that size (width, height) after --resolution and --principal-point."""
    width, height = size
    camera = posed.camera
    if abs(width * camera.height / (height * camera.width) - 1) > MAX_ASPECT_ERROR:
        raise SceneError(f"{posed.path}: the image is {width}x{height}, "
                         f"its camera {camera.width}x{camera.height}: another shape")
    target_width, target_height = target_size(width, height, config.resolution)
    if target_width * target_height > MAX_PIXELS:
        raise SceneError(f"{posed.path}: --resolution {config.resolution} makes the {width}x{height} image "
                         f"{target_width}x{target_height}, more than {MAX_PIXELS:,} pixels")
    camera = camera.resized(target_width, target_height)
    return camera.centred() if config.principal_point == "centre" else camera


def check_depth(image: Image.Image) -> None:
    """Raises ValueError beyond 8 bits a channel."""
    if image.mode == "F" or image.mode.startswith("I"):
        raise ValueError(f"its pixels have more than 8 bits (Pillow's mode {image.mode}); convert it to 8 bits")


def composited(image: Image.Image, white: bool) -> Image.Image:
    """The image as RGB; if it has transparency, over white or black. Raises ValueError beyond 8 bits a channel."""
    check_depth(image)
    if not is_transparent(image):
        return image.convert("RGB")
    rgba = np.asarray(image.convert("RGBA"), np.float32) / 255
    color, alpha = rgba[..., :3], rgba[..., 3:]
    blended = color * alpha + (1.0 if white else 0.0) * (1 - alpha)
    return Image.fromarray((blended * 255).round().astype(np.uint8))


def is_transparent(image: Image.Image) -> bool:
    """Whether the file has an alpha plane, or a colour that stands for one."""
    return image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info


def _opacity(image: Image.Image) -> Optional[Image.Image]:
    return image.convert("RGBA").getchannel("A") if is_transparent(image) else None


def size_of_image(posed: PosedImage) -> Tuple[int, int]:
    """(width, height) of an image that is not read yet; of one that is to be rendered, its camera's. Raises SceneError.
    """
    return image_size(posed.path) if posed.path else (posed.camera.width, posed.camera.height)


def image_size(path: str) -> Tuple[int, int]:
    """(width, height) from an image's header. Raises SceneError."""
    return _size(path, path)


def size_of(content: bytes, path: str) -> Tuple[int, int]:
    """(width, height) of the image in a file of that content. Raises SceneError."""
    return _size(io.BytesIO(content), path)


def _size(source: Union[str, BinaryIO], path: str) -> Tuple[int, int]:
    try:
        with open_image(source) as file:
            return file.size
    except UNREADABLE as error:
        raise unreadable(path, error) from error
