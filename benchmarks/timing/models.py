"""What is rendered in a benchmark: a Gaussian model and cameras, from files or made up."""
from __future__ import annotations

import math
from typing import Dict, List, Mapping, NamedTuple, Optional, Tuple

import numpy as np
import torch

from diff_smoe_rasterization.settings import (
    GATED_MODES,
    GaussianRasterizationSettings,
    resolve_background_gate,
    resolve_blend_mode,
)
from dsmoe.options.config import TrainConfig
from dsmoe.results.modelfile import load_model
from dsmoe.scenes.cameras import Camera
from dsmoe.scenes.scene import load_cameras


def mode_and_gate(blend: str) -> Tuple[str, Optional[float]]:
    """The settings ("smoe", 0.05) of "smoe:0.05"; "smoe" alone has gate 0. Raises ValueError."""
    mode, _, text = blend.partition(":")
    gate = float(text) if text else 0.0 if mode in GATED_MODES else None
    resolve_background_gate(resolve_blend_mode(mode), gate)
    return mode, gate


class Model(NamedTuple):
    """Activated Gaussians, by the argument names of `rasterize`, and views of them."""

    name: str
    inputs: Dict[str, torch.Tensor]  # means3D, opacities, shs, scales, rotations
    cameras: List[Camera]

    @property
    def num_gaussians(self):
        return len(self.inputs["means3D"])

    @property
    def sh_degree(self):
        return math.isqrt(self.inputs["shs"].shape[1]) - 1

    def settings(self, view: int, blend: str) -> GaussianRasterizationSettings:
        """The settings of a view before a black background, on the device of the Gaussians."""
        background, (mode, gate) = torch.zeros(3, device=self.inputs["means3D"].device), mode_and_gate(blend)
        return self.cameras[view].settings(background, self.sh_degree, mode)._replace(background_gate=gate)

    def to(self, device: str) -> Model:
        return self._replace(inputs={name: tensor.to(device) for name, tensor in self.inputs.items()})

    def seen(self, num_views: int, width: Optional[int] = None, height: Optional[int] = None) -> Model:
        """The model with at most so many of its views, evenly chosen, at another size if one is given."""
        count = min(num_views, len(self.cameras))
        chosen = [self.cameras[index * len(self.cameras) // count] for index in range(count)]
        return self._replace(cameras=[camera.resized(width or camera.width, height or camera.height)
                                      for camera in chosen])


def from_files(ply: str, scene: str, resolution: int) -> Model:
    """A trained .ply and the test views of its scene folder."""
    model, _ = load_model(ply, "cpu")
    inputs = dict(means3D=model.raw["means3D"], opacities=model.opacities, scales=model.scales,
                  rotations=model.rotations, shs=torch.cat([model.raw["dc"], model.raw["shs"]], 1))
    cameras = [camera.pinhole() for camera in load_cameras(TrainConfig(scene=scene, resolution=resolution), "test")]
    return Model(ply, {name: tensor.detach().contiguous() for name, tensor in inputs.items()}, cameras)


def from_npz(path: str) -> Model:
    """A packed model: xyz, f_dc, f_rest, opacity (logit), scale (log), quat; cameras R, t, fx, fy, width, height."""
    packed = np.load(path)

    def tensor(name):
        return torch.tensor(packed[name], dtype=torch.float32)

    inputs = dict(means3D=tensor("xyz"), opacities=torch.sigmoid(tensor("opacity")), scales=torch.exp(tensor("scale")),
                  rotations=torch.nn.functional.normalize(tensor("quat")),
                  shs=torch.cat([tensor("f_dc"), tensor("f_rest")], 1))
    return Model(path, inputs, from_npz_cameras(packed))


def from_npz_cameras(packed: Mapping[str, np.ndarray]) -> List[Camera]:
    """The cameras of a packed model."""
    width, height = int(packed["width"]), int(packed["height"])
    views = zip(packed["R"], packed["t"], *(np.broadcast_to(packed[name], len(packed["R"])) for name in ("fx", "fy")))
    return [Camera(str(view), rotation.astype(np.float64), translation.astype(np.float64), float(fx), float(fy),
                   width / 2, height / 2, width, height)
            for view, (rotation, translation, fx, fy) in enumerate(views)]


def to_npz(model: Model, path: str) -> None:
    """Writes what `from_npz` reads; the principal points, which most public rasterizers cannot have, become centres."""
    inputs = {name: tensor.cpu() for name, tensor in model.inputs.items()}
    cameras = model.cameras
    if len({(camera.width, camera.height) for camera in cameras}) != 1:
        raise ValueError("the cameras differ in size; a packed model has one")
    np.savez(path, xyz=inputs["means3D"], f_dc=inputs["shs"][:, :1], f_rest=inputs["shs"][:, 1:],
             opacity=torch.logit(inputs["opacities"], 1e-6), scale=torch.log(inputs["scales"]),
             quat=inputs["rotations"], R=np.stack([camera.rotation for camera in cameras]).astype(np.float32),
             t=np.stack([camera.translation for camera in cameras]).astype(np.float32),
             fx=np.array([camera.fx for camera in cameras]), fy=np.array([camera.fy for camera in cameras]),
             width=cameras[0].width, height=cameras[0].height)


def synthetic(num_gaussians: int, width: int = 800, height: int = 533, seed: int = 0) -> Model:
    """Gaussians scattered through the view of one camera, as sizes, shapes and opacities of trained models scatter.

    Depths are 2 to 10. On the image the median standard deviation is the one of as many discs that tile it eight times.
    Axes differ by a median factor of about 3, and half of the opacities are below 0.3.
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
