"""What is wrong with paths and options, said before torch is loaded, which takes seconds."""
from __future__ import annotations

import argparse
import os

from ..errors import ConfigError, SceneError, TrainerError
from ..system.files import check_output, check_place, is_file, is_folder
from ..system.process import command, typed
from .choices import DEVICES, MODEL, ORBIT_FRAMES, VIDEO_FPS
from .config import TrainConfig, holds_run
from .config_arguments import given_options

# One of these is in a scene's folder: a COLMAP model, or a file of cameras; the last is a trained model's.
SPARSE, TRANSFORMS, NERF_SYNTHETIC, CAMERAS = "sparse", "transforms.json", "transforms_train.json", "cameras.json"
VIDEO_ENDINGS = (".mp4", ".mov", ".avi", ".mkv", ".webm")
FILMED = (".mp4", ".gif", ".webp")  # what an orbit can be written as
FILMED_SAID = f"{', '.join(FILMED[:-1])} or {FILMED[-1]}"
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")  # nor is that a folder's name
FROM_VIDEO = "of a video take pictures first, such as: ffmpeg -i VIDEO -vf fps=2 PHOTOS/%04d.jpg"
MOST_FRAMES = 100_000  # 55 minutes
LEAST_FPS, MOST_FPS = 0.01, 1000.0  # a .gif shows a frame for at most 655 s


def check_early(arguments: argparse.Namespace) -> None:
    """Raises TrainerError as the command would, for what needs no torch to be seen. Not all of it is."""
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise TrainerError("the current folder has been removed; go to another one") from error
    command, scene = arguments.command, getattr(arguments, "scene", None)
    if command == "scene":
        check_photos(arguments.photos)
    elif command == "train" and not arguments.resume and scene and getattr(arguments, "output", ""):
        check_scene(scene)
        _check_options(arguments)
    elif command == "simplify":
        check_model(arguments.model)
    elif command == "eval":
        _check_run(arguments.output)
    elif command in ("render", "export", "view"):
        check_model(arguments.model)
        if holds_run(arguments.model):
            TrainConfig.load(arguments.model)
        _check_meant(arguments)
        if command == "render":
            check_ending(arguments.output, arguments.orbit)
        if command == "render" and arguments.orbit:
            check_orbit(getattr(arguments, "frames", ORBIT_FRAMES), getattr(arguments, "fps", VIDEO_FPS))
        if command == "export" and arguments.output:
            check_output(arguments.output, arguments.overwrite)
    if command in ("simplify", "eval", "render", "export", "view") and scene:
        check_scene(scene)
    if command in ("train", "simplify", "scene", "render", "export") and getattr(arguments, "output", None):
        check_place(arguments.output, command == "export" or command == "render" and arguments.orbit
                    and is_video(arguments.output))


def _check_meant(arguments: argparse.Namespace) -> None:
    """Raises TrainerError for an option that would do nothing."""
    for name, other, partner in (("frames", "orbit", "--orbit"), ("fps", "orbit", "--orbit"),
                                 ("bake_iterations", "bake", "--bake alpha")):
        if hasattr(arguments, name) and not getattr(arguments, other):
            raise TrainerError(f"--{name.replace('_', '-')} means something with {partner} alone; add that, or leave "
                               "it out")
    if arguments.command == "export" and arguments.device != DEVICES[0] and not arguments.bake:
        raise TrainerError("--device means something with --bake alpha alone; add that, or leave it out")
    if hasattr(arguments, "fps") and not is_video(arguments.output):
        raise TrainerError(f"--fps means something with a video alone; end -o in {FILMED_SAID}, or leave it out")
    if getattr(arguments, "orbit", False) and arguments.split:
        raise TrainerError("--split names cameras of the scene, and --orbit has its own; leave out one of the two")


def _check_options(arguments: argparse.Namespace) -> None:
    """Raises ConfigError for a number that no strategy and no preset takes."""
    if getattr(arguments, "init", ""):
        check_model(arguments.init)
        return  # that model says how it is blended
    given = {**given_options(arguments), "device": "cpu", "strategy": "steady", "strategy_options": ""}
    if "iterations" not in given:  # a preset has its own, and --batch divides them
        given.pop("batch", None)
    TrainConfig(**given).validate()


def _check_run(folder: str) -> None:
    """Raises ConfigError if it is not the output folder of a training; the error says what renders another model."""
    if is_file(folder) or is_folder(os.path.join(folder, "point_cloud")) and not holds_run(folder):
        raise ConfigError(f"{folder} is not the output folder of `dsmoe train`, whose scene and options eval takes; "
                          f"`dsmoe render {typed(folder)} --scene SCENE -o IMAGES` renders such a model")
    TrainConfig.load(folder)


def check_model(source: str) -> None:
    """Raises TrainerError if there is no such file or folder of a model."""
    if not is_file(source) and not is_folder(source):
        raise TrainerError(f"{source}: no such file or folder; name {MODEL}")


def check_scene(folder: str, program: str = "") -> None:
    """Raises SceneError if it is not a folder of a scene. program: what is typed for `dsmoe`, else `command()`."""
    if not is_folder(folder):
        is_one = "is a file; a scene is a folder" if is_file(folder) else "no such folder"
        raise SceneError(f"scene {folder}: {is_one}")
    if not is_folder(os.path.join(folder, SPARSE)) and not any(
            is_file(os.path.join(folder, name)) for name in (TRANSFORMS, NERF_SYNTHETIC, CAMERAS)):
        raise SceneError(f"scene {folder}: neither a folder `{SPARSE}` (COLMAP) nor {TRANSFORMS} (nerfstudio, "
                         f"instant-ngp, Polycam) nor {NERF_SYNTHETIC} (NeRF-synthetic) is in it. Of photographs "
                         f"`{program or command()} scene PHOTOS -o SCENE` makes a scene")


def check_photos(photos: str) -> None:
    """Raises SceneError if it is not a folder."""
    if is_folder(photos):
        return
    if not is_file(photos):
        raise SceneError(f"{photos}: no such folder of photographs")
    if photos.lower().endswith(VIDEO_ENDINGS):
        raise SceneError(f"{photos} is a file; {FROM_VIDEO}")
    raise SceneError(f"{photos} is a file; name the folder of the photographs, such as "
                     f"{os.path.dirname(photos) or '.'}")


def is_video(path: str) -> bool:
    """Whether an orbit is written as one file, by the path's ending."""
    return _ending(path) in FILMED


def check_ending(path: str, orbit: bool) -> None:
    """Raises TrainerError if a folder for images has the name of a file. orbit: whether a video could be made."""
    ending = _ending(path)
    if ending in FILMED and not orbit:
        raise TrainerError(f"{path}: a video is written with --orbit; without it -o names a folder")
    if ending in IMAGE_ENDINGS:
        raise TrainerError(f"{path}: -o names a folder for images")
    if ending in VIDEO_ENDINGS and ending not in FILMED:
        raise TrainerError(f"{path}: a video can end in {FILMED_SAID}; {ending} is not written")


def _ending(path: str) -> str:
    return os.path.splitext(path)[1].lower()


def check_orbit(frames: int, fps: float) -> None:
    """Raises TrainerError if no video has so many frames, or so many a second."""
    if not 1 <= frames <= MOST_FRAMES:
        raise TrainerError(f"--frames is {frames}; it must be from 1 to {MOST_FRAMES}")
    if not LEAST_FPS <= fps <= MOST_FPS:
        raise TrainerError(f"--fps is {fps:g}; it must be from {LEAST_FPS:g} to {MOST_FPS:g}")
