"""Images one after the other as one file: .mp4 by imageio-ffmpeg, .gif and .webp by Pillow."""
from __future__ import annotations

from typing import Iterable

import numpy as np
from PIL import Image, features

from ..errors import TrainerError
from ..system.files import new_file
from ..system.process import pip_install

WEBP_QUALITY = 50  # of 100; 120 frames of a room, 480x320, take 1.9 MB


def check_video(path: str) -> None:
    """Raises TrainerError if this environment cannot write such a file."""
    if path.lower().endswith(".webp") and not features.check("webp"):
        raise TrainerError(f"{path}: this Pillow was built without WebP; .gif and a folder of PNGs need nothing")
    if path.lower().endswith(".mp4"):
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            raise TrainerError(f"{path}: for .mp4 imageio-ffmpeg is needed: {pip_install('imageio-ffmpeg')}; .gif, "
                               ".webp and a folder of PNGs need nothing") from error


def write_video(path: str, images: Iterable[Image.Image], fps: float, overwrite: bool = False) -> None:
    """Writes RGB images of one size, with so many a second. The file is whole or absent.

    overwrite: a file that is there may be replaced. Raises OSError, and TrainerError as `check_output`.
    """
    with new_file(path, overwrite) as temporary:
        if path.lower().endswith(".mp4"):
            _write_mp4(temporary, images, fps)
        else:
            _write_loop(temporary, images, fps)


def _write_loop(path: str, images: Iterable[Image.Image], fps: float) -> None:
    """A picture that moves, and begins again at its end."""
    first, *others = images
    first.save(path, save_all=True, append_images=others, duration=max(20, round(1000 / fps)), loop=0,
               quality=WEBP_QUALITY)  # .gif has none


def _write_mp4(path: str, images: Iterable[Image.Image], fps: float) -> None:
    """H.264 as every player reads it, which takes even sizes only: an odd last row or column is left out."""
    import imageio_ffmpeg

    writer = None
    for image in images:
        size = image.width // 2 * 2, image.height // 2 * 2
        if writer is None:
            writer = imageio_ffmpeg.write_frames(path, size, fps=fps, codec="libx264", pix_fmt_out="yuv420p",
                                                 quality=8, macro_block_size=1, ffmpeg_log_level="error")
            writer.send(None)
        writer.send(np.ascontiguousarray(np.asarray(image)[:size[1], :size[0]]))
    if writer is not None:
        writer.close()
