"""A small trainer with the commands of Deformable Beta Splatting: `write(folder, views)` makes a checkout of it.

With --eval it would never end by itself: whoever wants so many iterations must not pass it.
"""
from __future__ import annotations

import numpy as np

TRAIN = '''
from argparse import ArgumentParser
import torch
from tqdm import tqdm
from scene import BetaModel, Scene
from viewer import Shown

flags = ArgumentParser()
for name in ("-s", "-m", "--iterations", "--save_iterations", "--port", "--cap_max", "--sh_degree"):
    flags.add_argument(name)
flags.add_argument("--eval", action="store_true")
flags.add_argument("--disable_viewer", action="store_true")
flags.add_argument("--no-compress", action="store_true")
args = flags.parse_args()
assert args.disable_viewer and args.no_compress
model = BetaModel(int(args.cap_max))
world = Scene(args, model)
if args.eval:
    raise SystemExit("would choose its model on the test views")
bar = tqdm(range(int(args.iterations)), desc="Training progress")
model.level = torch.stack([view.original_image.mean() for view in world.getTrainCameras()]).mean()
for _ in range(int(args.iterations)):
    bar.update(1)
bar.close()
world.save(args.m, args.iterations)
'''
SCENE = '''
import os
import numpy as np
import torch


class BetaModel:
    def __init__(self, count):
        self.get_xyz = torch.zeros(count, 3)

    def render(self, view):
        return {"render": torch.zeros_like(view.original_image) + self.level}


class Camera:
    def __init__(self, name, image):
        self.image_name, self.original_image = name, torch.tensor(image)


class Scene:
    def __init__(self, args, beta_model):
        self.beta_model = beta_model
        with np.load(os.path.join(os.path.dirname(__file__), "views.npz")) as views:
            cameras = [Camera(name, views[name]) for name in sorted(views.files)]
        self.test = [camera for index, camera in enumerate(cameras) if args.eval and index % 8 == 0]
        self.train = [camera for camera in cameras if camera not in self.test]

    def getTrainCameras(self):
        return self.train

    def getTestCameras(self):
        return self.test

    def save(self, folder, iteration):
        path = os.path.join(folder, "point_cloud", "iteration_" + iteration)
        os.makedirs(path)
        np.savez(os.path.join(path, "point_cloud.npz"), level=self.beta_model.level)
'''
VIEWER = '''
import viser
from nerfview import Viewer
from plas import sort_with_plas
from turtle import color


class Shown(Viewer):
    def __init__(self):
        self.server = viser.ViserServer()
'''


TURTLE = '''
raise ImportError("a Python of a server: there is no tkinter")
'''


def write(folder, views):
    """Makes the checkout in `folder`. views: images [3, H, W] by name."""
    (folder / "scene").mkdir(parents=True)
    (folder / "train.py").write_text(TRAIN)
    (folder / "viewer.py").write_text(VIEWER)
    (folder / "turtle.py").write_text(TURTLE)
    (folder / "scene" / "__init__.py").write_text(SCENE)
    np.savez(folder / "scene" / "views.npz", **views)
    return folder
