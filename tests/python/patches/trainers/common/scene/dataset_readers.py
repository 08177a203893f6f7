import json
import os
from typing import NamedTuple

import numpy as np

from utils.graphics_utils import Cloud

WIDTH, HEIGHT = 32, 24
FOV_X = 0.9
FOV_Y = 2 * np.arctan(np.tan(FOV_X / 2) * HEIGHT / WIDTH)


class View(NamedTuple):
    R: np.ndarray
    T: np.ndarray
    FovX: float
    FovY: float
    image: np.ndarray  # [3, H, W]
    image_name: str


class MadeUpScene(NamedTuple):
    radius: float
    hidden: list  # views that are left for tests
    shown: list  # views to train with
    point_cloud: Cloud


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
    cameras = []
    for index in range(wanted["views"]):
        angle = 2 * np.pi * index / wanted["views"]
        R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        cameras.append(View(R.astype(np.float32), np.array([0, 0, 2], dtype=np.float32), FOV_X, FOV_Y,
                            make_picture(random), f"view{index}"))
    cloud = Cloud(random.uniform(-1, 1, (wanted["points"], 3)).astype(np.float32),
                  random.uniform(0, 1, (wanted["points"], 3)).astype(np.float32))
    return MadeUpScene(3.3, cameras[:1], cameras[1:], cloud)
