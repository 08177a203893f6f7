"""The folder of a trained 3DGS model as a scene: the cameras of cameras.json, and what the model shows there."""
from __future__ import annotations

import ast
import collections
import dataclasses
import glob
import hashlib
import json
import os
import re
from typing import Any, Dict, List, Sequence

import numpy as np
import torch

from ..errors import SceneError
from ..options.config import TrainConfig
from ..options.early import CAMERAS
from ..system.files import is_file
from .cameras import Camera
from .images import View, fitted_camera, shown_by_lens, size_of_image
from .layout import Layout, PosedImage, hold_out
from .lens import lens_named

CFG_ARGS = "cfg_args"  # the options of its training
MAX_SKEW = 1e-3  # of a rotation, as far as rounded json numbers may leave it


def latest_model(folder: str) -> str:
    """The path of point_cloud/iteration_N/point_cloud.ply with the largest N; empty if there is none."""
    found = []
    for path in glob.glob(os.path.join(glob.escape(folder), "point_cloud", "iteration_*", "point_cloud.ply")):
        number = re.fullmatch(r"iteration_(\d+)", os.path.basename(os.path.dirname(path)))
        if number and is_file(path):
            found.append((int(number.group(1)), path))
    return max(found)[1] if found else ""


def cfg_args_of(folder: str) -> Dict[str, Any]:
    """The plain values in a model folder's cfg_args, a Namespace as text; none if there is no such file."""
    path = os.path.join(folder, CFG_ARGS)
    known: Dict[str, Any] = {}
    if not is_file(path):
        return known
    with open(path, encoding="utf-8", errors="replace") as file:
        text = file.read()
    for name, value in re.findall(r"[(, ](\w+)=('[^']*'|\"[^\"]*\"|[^,()]+)", text):
        try:
            known[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            continue  # an object of the trainer's own
    return known


def read_model_layout(folder: str, config: TrainConfig) -> Layout:
    """Reads cameras.json; the images are to be rendered. Raises SceneError."""
    from ..starting import read_start

    path = os.path.join(folder, CAMERAS)
    model = latest_model(folder)
    if not model:
        raise SceneError(f"scene {folder}: {CAMERAS} is there, but no point_cloud/iteration_N/point_cloud.ply, whose "
                         "renderings would be the images")
    try:
        with open(path, encoding="utf-8") as file:
            content = json.load(file)
        cameras = [_camera(entry) for entry in content]
        if not cameras:
            raise ValueError("it lists no camera")
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else getattr(error, "strerror", None) or error
        raise SceneError(f"{path}: not the cameras of a 3DGS model ({reason})") from error
    names = collections.Counter(camera.name for camera in cameras)
    cameras = [dataclasses.replace(camera, name=f"{camera.name}-{index}") if names[camera.name] > 1 else camera
               for index, camera in enumerate(cameras)]  # NeRF-synthetic's training and test views share names
    train, test, split = hold_out([PosedImage(camera, "") for camera in cameras], config.test_every)
    if not train:
        raise SceneError(f"{path}: no training camera is left after the split; --test-every 0 keeps none for testing")
    return Layout("model", train, test, read_start(model).points(), f"{split}; images are renderings of the model",
                  model)


def _camera(entry: Any) -> Camera:
    """Of one entry: `position` and the columns of `rotation` are the camera's place and axes in the world.

    The principal point is the image's centre, as in 3DGS, unless `cx` and `cy` say otherwise. Raises KeyError,
    TypeError or ValueError.
    """
    turn, place = np.asarray(entry["rotation"], np.float64), np.asarray(entry["position"], np.float64)
    width, height = int(entry["width"]), int(entry["height"])
    numbers = [float(entry["fx"]), float(entry["fy"]), float(entry.get("cx", width / 2)),
               float(entry.get("cy", height / 2))]
    if turn.shape != (3, 3) or place.shape != (3,) or not np.isfinite([*turn.flat, *place, *numbers]).all():
        raise ValueError(f"`rotation` and `position` of {entry['img_name']} must be finite, [3, 3] and [3]")
    if not (np.abs(turn @ turn.T - np.eye(3)).max() < MAX_SKEW and np.linalg.det(turn) > 0):
        raise ValueError(f"`rotation` of {entry['img_name']} is not a rotation")
    if not (min(numbers[:2]) > 0 and min(width, height) > 0):
        raise ValueError(f"`width`, `height`, `fx` and `fy` of {entry['img_name']} must be above 0")
    lens = lens_named(entry["camera_model"], entry.get("distortion", ())) if "camera_model" in entry else None
    if lens:
        lens.check(max(numbers[:2]), width, height)
    return Camera(str(entry["img_name"]), turn.T, -turn.T @ place, *numbers, width, height, lens)


def cameras_content(cameras: Sequence[Camera]) -> List[Dict[str, Any]]:
    """What `cameras.json` holds of cameras, for viewers of 3DGS and for `read_model_layout`."""
    return [{"id": index, "img_name": camera.name, "width": camera.width, "height": camera.height,
             "position": camera.center.tolist(), "rotation": camera.rotation.T.tolist(), "fx": camera.fx,
             "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
             **({"camera_model": camera.lens.camera_model, "distortion": camera.lens.coefficients} if camera.lens
                else {})} for index, camera in enumerate(cameras)]


@torch.no_grad()
def rendered_views(model: str, images: Sequence[PosedImage], config: TrainConfig) -> List[View]:
    """What a model shows at the cameras, in 8 bits, on config.device, by its own blend. Raises TrainerError."""
    from ..results.metrics import quantised
    from ..starting import read_start, start_renderer

    start = read_start(model)
    renderer = start_renderer(start, config)
    checksum = hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in (
        start.gaussians.means3D, start.gaussians.dc, start.gaussians.opacity_logits))).hexdigest()
    views = []
    for posed in images:
        camera = fitted_camera(posed, size_of_image(posed), config)
        image = (quantised(renderer(camera).color) * 255).round().to(torch.uint8)
        views.append(View(camera, image, mask=shown_by_lens(camera), checksum=checksum).to(config.device))
    return views
