"""What is rendered in a benchmark: a Gaussian model and cameras, from files or made up."""
from __future__ import annotations

import math
from typing import Dict, List, NamedTuple

import numpy as np
import torch

from diff_smoe_rasterization.settings import GaussianRasterizationSettings
from diff_smoe_rasterization.trainer.cameras import Camera
from diff_smoe_rasterization.trainer.config import TrainConfig
from diff_smoe_rasterization.trainer.modelfile import load_model
from diff_smoe_rasterization.trainer.scene import load_cameras

SH_DEGREE = 3


class Model(NamedTuple):
    """Activated Gaussians, by the argument names of `rasterize`, and views of them."""

    name: str
    inputs: Dict[str, torch.Tensor]  # means3D, opacities, shs, scales, rotations
    cameras: List[Camera]

    @property
    def num_gaussians(self):
        return len(self.inputs["means3D"])

    def settings(self, view: int, mode: str) -> GaussianRasterizationSettings:
        return self.cameras[view].settings(torch.zeros(3), SH_DEGREE, mode)


def from_files(ply: str, scene: str, resolution: int) -> Model:
    """A trained .ply and the test views of its scene folder."""
    model, _ = load_model(ply, "cpu")
    inputs = dict(means3D=model.raw["means3D"], opacities=model.opacities, scales=model.scales,
                  rotations=model.rotations, shs=torch.cat([model.raw["dc"], model.raw["shs"]], 1))
    cameras = load_cameras(TrainConfig(scene=scene, resolution=resolution), "test")
    return Model(ply, {name: tensor.detach().contiguous() for name, tensor in inputs.items()}, cameras)


def from_npz(path: str) -> Model:
    """A packed model: xyz, f_dc, f_rest, opacity (logit), scale (log), quat; cameras R, t, fx, fy, width, height."""
    packed = np.load(path)

    def tensor(name):
        return torch.tensor(packed[name], dtype=torch.float32)

    inputs = dict(means3D=tensor("xyz"), opacities=torch.sigmoid(tensor("opacity")), scales=torch.exp(tensor("scale")),
                  rotations=torch.nn.functional.normalize(tensor("quat")),
                  shs=torch.cat([tensor("f_dc"), tensor("f_rest")], 1))
    width, height = int(packed["width"]), int(packed["height"])
    cameras = [Camera(str(view), rotation.astype(np.float64), translation.astype(np.float64), float(packed["fx"]),
                      float(packed["fy"]), width / 2, height / 2, width, height)
               for view, (rotation, translation) in enumerate(zip(packed["R"], packed["t"]))]
    return Model(path, inputs, cameras)


def synthetic(num_gaussians: int, width: int = 800, height: int = 533, seed: int = 0) -> Model:
    """Gaussians scattered through the view of one camera, as sizes, shapes and opacities of trained models scatter.

    Depths are 2 to 10; on the image the median standard deviation is that of as many discs that tile it eight times,
    axes differ by a median factor of about 3, and half of the opacities are below 0.3.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    focal = float(width)
    depth = 2 + 8 * uniform(num_gaussians, 1)
    size = torch.tensor([width, height]) / focal
    means3D = torch.cat([(uniform(num_gaussians, 2) - 0.5) * 1.1 * size * depth, depth], 1)
    typical = math.sqrt(8 * width * height / (num_gaussians * math.pi)) / 3 / focal
    inputs = dict(means3D=means3D, opacities=torch.sigmoid(-0.85 + 2 * normal(num_gaussians, 1)),
                  scales=typical * depth * torch.exp(0.5 * normal(num_gaussians, 1) + 0.7 * normal(num_gaussians, 3)),
                  rotations=torch.nn.functional.normalize(normal(num_gaussians, 4)),
                  shs=torch.cat([normal(num_gaussians, 1, 3), 0.05 * normal(num_gaussians, 15, 3)], 1))
    camera = Camera("synthetic", np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height)
    return Model(f"synthetic, seed {seed}", inputs, [camera])
