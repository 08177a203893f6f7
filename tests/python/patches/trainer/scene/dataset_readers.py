import json
import os
from typing import NamedTuple

import numpy as np
import torch

WIDTH, HEIGHT = 32, 24
FOV_X = 0.9
FOV_Y = 2 * np.arctan(np.tan(FOV_X / 2) * HEIGHT / WIDTH)
NEAR, FAR = 0.01, 100.0


class View(NamedTuple):
    R: np.ndarray
    T: np.ndarray
    image: np.ndarray  # [3, H, W]
    image_name: str


class MadeUpScene(NamedTuple):
    hidden: list  # views that are left for tests
    shown: list  # views to train with
    points: np.ndarray  # [N, 3]
    colors: np.ndarray  # [N, 3]


def make_picture(random):
    """A smooth picture with one coloured disc."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    phases = random.uniform(0, 2 * np.pi, (3, 1, 1))
    picture = 0.5 + 0.3 * np.sin(x / 7 + phases) * np.cos(y / 9 + phases)
    disc = (x - random.uniform(8, 24)) ** 2 + (y - random.uniform(6, 18)) ** 2 < 30
    return np.where(disc, random.uniform(0, 1, (3, 1, 1)), picture).astype(np.float32)


def read_made_up_scene(path):
    """The scene that path/made_up.json describes: `points`, `views` and `seed`."""
    with open(os.path.join(path, "made_up.json")) as file:
        wanted = json.load(file)
    random = np.random.RandomState(wanted["seed"])
    views = []
    for index in range(wanted["views"]):
        angle = 2 * np.pi * index / wanted["views"]
        R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        views.append(View(R.astype(np.float32), np.array([0, 0, 2], dtype=np.float32), make_picture(random),
                          f"view{index}"))
    points, colors = (random.uniform(low, 1, (wanted["points"], 3)).astype(np.float32) for low in (-1, 0))
    return MadeUpScene(views[:1], views[1:], points, colors)


class Camera:
    """One view of the made-up scene: its matrices, transposed as the rasterizer wants them, and its picture."""

    def __init__(self, view: View, data_device):
        self.FoVx, self.FoVy, self.image_name = FOV_X, FOV_Y, view.image_name
        self.original_image = torch.tensor(view.image).to(data_device)
        _, self.image_height, self.image_width = view.image.shape
        to_view, projection = torch.eye(4), torch.zeros(4, 4)
        to_view[:3, :3], to_view[:3, 3] = torch.tensor(view.R.T.copy()), torch.tensor(view.T)
        projection[0, 0], projection[1, 1] = 1 / np.tan(FOV_X / 2), 1 / np.tan(FOV_Y / 2)
        depth = FAR / (FAR - NEAR)
        projection[2, 2], projection[2, 3], projection[3, 2] = depth, -depth * NEAR, 1
        self.world_view_transform = to_view.T.contiguous().to(data_device)
        self.full_proj_transform = self.world_view_transform @ projection.T.to(data_device)
        self.camera_center = torch.tensor(-view.R @ view.T).to(data_device)
