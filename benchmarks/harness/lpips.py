"""LPIPS (Zhang et al. 2018, v0.1) by torchmetrics, or from a file of weights if there is no network connection."""
from __future__ import annotations

import os
from typing import Callable, Dict, List, Sequence

import numpy as np
import torch

from ..errors import TrainerError
from ..system.process import pip_install
from .names import VARIABLES, net_of

Distance = Callable[[torch.Tensor, torch.Tensor], float]  # of two images [3, H, W] in [0, 1]

# ImageNet's mean and standard deviation, in terms of images in [-1, 1].
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Five blocks of convolutions (side, stride, padding), each followed by a ReLU; LPIPS compares what each block puts out.
# In front of every block but the first is a maximum pooling (side, stride). As torchvision has them:
BLOCKS = {"alex": [[(11, 4, 2)], [(5, 1, 2)], [(3, 1, 1)], [(3, 1, 1)], [(3, 1, 1)]],  # Krizhevsky 2014
          "vgg": [count * [(3, 1, 1)] for count in (2, 2, 3, 3, 3)]}  # Simonyan and Zisserman 2014, configuration D
POOLING = {"alex": [None, (3, 2), (3, 2), None, None], "vgg": [None, (2, 2), (2, 2), (2, 2), (2, 2)]}


LEAST_SIDE = {"alex": 31, "vgg": 16}  # pixels: with less a pooling has nothing left


def lpips_network(kind: str, device: str) -> Distance:
    """LPIPS of a kind of LPIPS_KINDS. lpips_vgg_inria feeds [0, 1] into a network made for [-1, 1], as 3DGS does.

    The distance raises TrainerError for images that are too small.
    """
    distance, least = _distance(kind, device), LEAST_SIDE[net_of(kind)]

    def checked(image: torch.Tensor, target: torch.Tensor) -> float:
        height, width = image.shape[-2:]
        if min(height, width) < least:
            raise TrainerError(f"LPIPS by {net_of(kind)} needs images of at least {least}x{least} pixels, and one has "
                               f"{width}x{height}")
        return distance(image, target)

    return checked


def _distance(kind: str, device: str) -> Distance:
    net, normalise = net_of(kind), kind != "lpips_vgg_inria"
    if os.environ.get(VARIABLES[net]):
        return FileLpips(net, os.environ[VARIABLES[net]], normalise, device)
    try:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
    except ImportError as error:
        raise ImportError(f"LPIPS needs torchmetrics and torchvision: {pip_install('torchmetrics', 'torchvision')}"
                          ) from error
    network = LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=normalise).to(device)
    return torch.no_grad()(lambda image, target: float(network(image[None], target[None])))


class FileLpips:
    def __init__(self, net: str, path: str, normalise: bool, device: str) -> None:
        """normalise: images in [0, 1] are taken to [-1, 1]. Raises OSError and ValueError."""
        arrays = arrays_of(path)
        self.normalise, self.linear, self.blocks = normalise, [], []
        self.shift, self.scale = (torch.tensor(values, device=device)[:, None, None] for values in (SHIFT, SCALE))
        inputs, number = 3, 0

        def array(name: str, shape: Sequence[int]) -> torch.Tensor:
            there = list(arrays[name].shape) if name in arrays else None
            if there != shape:
                raise ValueError(f"{path}: {name} {'is missing' if there is None else f'has shape {there}'}; it must "
                                 f"have shape {shape}")
            return torch.tensor(arrays[name], dtype=torch.float32, device=device)

        for index, (pooling, convolutions) in enumerate(zip(POOLING[net], BLOCKS[net])):
            layers: List[torch.nn.Module] = [torch.nn.MaxPool2d(*pooling)] if pooling else []
            for side, stride, padding in convolutions:
                number += 1
                weight, bias = f"conv{number}.weight", f"conv{number}.bias"
                outputs = (*np.shape(arrays.get(weight, ())), 1)[0]
                layer = torch.nn.Conv2d(inputs, outputs, side, stride, padding)
                layer.weight.data = array(weight, [outputs, inputs, side, side])
                layer.bias.data = array(bias, [outputs])
                layers += [layer, torch.nn.ReLU()]
                inputs = outputs
            self.blocks.append(torch.nn.Sequential(*layers))
            self.linear.append(array(f"lin{index}.weight", [inputs]).reshape(1, -1, 1, 1))

    def features(self, image: torch.Tensor) -> List[torch.Tensor]:
        """What the blocks put out [1, C, h, w], each position's channels of unit length."""
        x, found = (((2 * image - 1 if self.normalise else image) - self.shift) / self.scale)[None], []
        for block in self.blocks:
            x = block(x)
            found.append(x / (x.pow(2).sum(dim=1, keepdim=True).sqrt() + 1e-10))  # 1e-10: as published
        return found

    @torch.no_grad()
    def __call__(self, image: torch.Tensor, target: torch.Tensor) -> float:
        return float(sum((weight * (a - b).pow(2)).sum(dim=1).mean()
                         for weight, a, b in zip(self.linear, self.features(image), self.features(target))))


def arrays_of(path: str) -> Dict[str, np.ndarray]:
    """The arrays of a file, lin as [channels]. Raises OSError; ValueError if it holds others."""
    try:
        with np.load(path) as file:
            return {name: file[name].reshape(-1) if name.startswith("lin") else file[name] for name in file.files}
    except OSError:
        raise
    except Exception as error:  # damaged files: numpy, zipfile and zlib raise many kinds
        raise ValueError(f"{path} is not a .npz file that can be read ({type(error).__name__})") from error
