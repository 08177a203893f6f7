"""What commands offer, and what they take if nothing is said.

The command line shows these values, and the functions that do the work have them as defaults. Here because the command
line imports no function before it is called: torch takes seconds.
"""
from __future__ import annotations

DEVICES = ("auto", "cpu", "cuda")  # a run knows the last two

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
