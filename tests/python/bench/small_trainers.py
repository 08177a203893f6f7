"""The small trainers of the patches' tests, and one with the commands of Deformable Beta Splatting."""
from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

PATCHES = Path(__file__).resolve().parents[1] / "patches"


def small_trainers():
    """The module that makes checkouts of them."""
    pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")
    sys.path.insert(0, str(PATCHES))
    try:
        return importlib.import_module("checkouts")
    finally:
        sys.path.remove(str(PATCHES))


# With --eval it would never end by itself: whoever wants so many iterations must not pass it.
TRAIN = '''
from argparse import ArgumentParser
import torch, viser
from nerfview import Viewer
from plas import sort_with_plas
from tqdm import tqdm
from turtle import color
from scene import BetaModel, Scene

class Shown(Viewer):
    def __init__(self):
        self.server = viser.ViserServer()

flags = ArgumentParser()
for name in ("-s", "-m", "--iterations", "--save_iterations", "--port", "--cap_max"):
    flags.add_argument(name)
for name in ("--eval", "--disable_viewer", "--no-compress"):
    flags.add_argument(name, action="store_true")
args = flags.parse_args()
assert args.disable_viewer and args.no_compress
world = Scene(args, BetaModel(int(args.cap_max)))
if args.eval:
    raise SystemExit("would choose its model on the test views")
bar = tqdm(range(int(args.iterations)), desc="Training progress")
world.beta_model.level = torch.stack([view.original_image.mean() for view in world.train]).mean()
bar.close()
world.save(args.m, args.iterations)
'''
SCENE = '''
import os
from types import SimpleNamespace
import numpy as np
import torch

class BetaModel:
    def __init__(self, count):
        self.get_xyz = torch.zeros(count, 3)

    def render(self, view):
        return {"render": torch.zeros_like(view.original_image) + self.level}

class Scene:
    def __init__(self, args, beta_model):
        self.beta_model = beta_model
        with np.load(os.path.join(os.path.dirname(__file__), "views.npz")) as views:
            cameras = [SimpleNamespace(image_name=name, original_image=torch.tensor(views[name]))
                       for name in sorted(views.files)]
        self.test = [camera for index, camera in enumerate(cameras) if args.eval and index % 8 == 0]
        self.train = [camera for camera in cameras if camera not in self.test]

    def getTestCameras(self):
        return self.test

    def save(self, folder, iteration):
        path = os.path.join(folder, "point_cloud", "iteration_" + iteration)
        os.makedirs(path)
        np.savez(os.path.join(path, "point_cloud.npz"), level=self.beta_model.level)
'''


def write_dbs(folder, views):
    """Makes a checkout of the small Deformable Beta Splatting. views: images [3, H, W] by name."""
    (folder / "scene").mkdir(parents=True)
    (folder / "train.py").write_text(TRAIN)
    (folder / "turtle.py").write_text('raise ImportError("a Python of a server: there is no tkinter")')
    (folder / "scene" / "__init__.py").write_text(SCENE)
    np.savez(folder / "scene" / "views.npz", **views)
    return folder
