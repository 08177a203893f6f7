"""What commands offer, and what they take if nothing is said.

The command line shows these values, and the functions that do the work have them as defaults. Here because the command
line imports no function before it is called: torch takes seconds.
"""
from __future__ import annotations

import os
from typing import Optional, Tuple

from ..errors import TrainerError

DEVICES = ("auto", "cpu", "cuda")  # a run knows the last two
DEVICE_VARIABLE = "DSMOE_DEVICE"  # what `auto` means, if it is set

MATCHING = ("auto", "exhaustive", "sequential")  # of photographs; the first is the default
CAMERA_MODELS = ("PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE",
                 "EQUIRECTANGULAR")  # COLMAP's names
CAMERA_MODEL = "OPENCV"
LENSES = ("auto", "undistort", "native")  # what becomes of distorted images; the first is the default
MOST_EXHAUSTIVE = 200  # photographs, up to which `auto` compares all pairs

ORBIT_FRAMES = 120
VIDEO_FPS = 30.0

MODEL = "a .ply, .splat, .spz or .glb, an output folder of `dsmoe train`, or a model folder of 3DGS"
EXPORT_FORMATS = ("html", "ply", "splat", "spz", "glb")  # the first is the default
BAKE_ITERATIONS = 5000

VIEW_HOST, VIEW_PORT = "127.0.0.1", 8080
SIMPLIFY_ITERATIONS = 7000


def asked_device(asked: Optional[str] = None) -> Tuple[str, str]:
    """One of DEVICES, and who asks for it: `--device`, or for `auto`, which None is too, $DSMOE_DEVICE.

    Raises TrainerError if it is none.
    """
    device, source = asked or "auto", "--device"
    if device == "auto" and os.environ.get(DEVICE_VARIABLE):
        device, source = os.environ[DEVICE_VARIABLE], DEVICE_VARIABLE
    if device not in DEVICES:
        raise TrainerError(f"{source} is {device!r}; it must be one of {', '.join(DEVICES)}")
    return device, source
