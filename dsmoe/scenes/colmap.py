"""COLMAP scenes: a sparse model (binary or text) and a folder of images."""
from __future__ import annotations

import os

import numpy as np

from diff_smoe_rasterization import io

from ..errors import SceneError, said_of
from ..options.config import TrainConfig
from ..system.files import is_folder
from .cameras import Camera, quaternion_to_rotation
from .layout import Layout, PosedImage, hold_out
from .lens import MODELS, colmap_intrinsics
from .pointcloud import PointCloud


def read_colmap_layout(folder: str, config: TrainConfig) -> Layout:
    """Reads folder/sparse/0 (or folder/sparse); images are in folder/images. Raises SceneError."""
    try:
        model = io.read_colmap(folder)
    except (OSError, ValueError) as error:
        raise SceneError(said_of(error)) from error
    for camera in model.cameras.values():
        _refuse_other_models(model.folder, camera)
    image_folder = os.path.join(folder, config.images)
    if not is_folder(image_folder):
        raise SceneError(f"{image_folder}: no such folder of images (--images names another)")
    images = [_posed(image, model.cameras[image.camera_id], image_folder) for image in model.images]
    train, test, split = hold_out(images, config.test_every)
    positions = np.asarray(model.points.positions, np.float64)
    colors = model.points.colors
    if colors is None:
        colors = np.full(positions.shape, 128, np.uint8)
    points = PointCloud(positions, colors / 255.0).checked(model.folder)
    return Layout("colmap", train, test, points, split)


def _refuse_other_models(folder: str, camera: io.ColmapCamera) -> None:
    if camera.model not in MODELS:
        raise SceneError(
            f"{folder}: camera {camera.id} has the model {camera.model}; it must be one of {', '.join(MODELS)}. COLMAP "
            "makes PINHOLE images of it: colmap image_undistorter --image_path IMAGES --input_path SPARSE "
            "--output_path SCENE --output_type COLMAP")


def _posed(image: io.ColmapImage, intrinsics: io.ColmapCamera, folder: str) -> PosedImage:
    fx, fy, cx, cy, lens = colmap_intrinsics(intrinsics)
    camera = Camera(image.name, quaternion_to_rotation(image.qvec), np.asarray(image.tvec, np.float64),
                    fx, fy, cx, cy, int(intrinsics.width), int(intrinsics.height))
    return PosedImage(camera, os.path.join(folder, image.name), lens=lens)
