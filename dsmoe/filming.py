"""A way around a trained model, as a video or as images."""
from __future__ import annotations

from typing import Iterator, Sequence

import torch
from PIL import Image

from .errors import TrainerError
from .inspection import Trained, said_of_images, to_image, write_images
from .options.choices import ORBIT_FRAMES, VIDEO_FPS
from .options.early import check_ending, check_orbit, is_video
from .results.video import check_video, write_video
from .scenes.cameras import Camera
from .system.progress import progress_bar


def film(trained: Trained, path: str, frames: int = ORBIT_FRAMES, fps: float = VIDEO_FPS, outputs: Sequence[str] = (),
         overwrite: bool = False) -> str:
    """Goes once around the scene and writes what is seen; returns a line that says what was written.

    path: a file that ends in .mp4, .gif or .webp, else a folder for PNGs as `render_images` takes it. outputs: further
    images in such a folder. overwrite: files that are there may be replaced. Raises TrainerError.
    """
    check_orbit(frames, fps)
    check_ending(path, orbit=True)
    cameras = trained.orbit.cameras(frames, trained.cameras[0])
    if not is_video(path):
        of = f"{said_of_images(trained.config, trained.path, trained.renderer)}, an orbit of {frames}"
        return f"{len(write_images(trained.renderer, cameras, path, of, outputs, overwrite))} images in {path}"
    if outputs:
        raise TrainerError(f"{path}: a video has room for colours only; with --{outputs[0]} -o names a folder")
    check_video(path)
    write_video(path, _images(trained, cameras), fps, overwrite)
    return f"{path}: {frames} frames, {frames / fps:.3g} s"


def _images(trained: Trained, cameras: Sequence[Camera]) -> Iterator[Image.Image]:
    with torch.no_grad():
        for camera in progress_bar(cameras, desc="frames", unit="frame", leave=False):
            yield to_image(trained.renderer(camera).color)
