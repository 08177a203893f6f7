"""LPIPS (Zhang et al. 2018, v0.1) by torchmetrics, or from a file of weights where there is no network connection."""
from __future__ import annotations

import os
from typing import Callable, Dict, List, NamedTuple, Sequence, Tuple

import numpy as np
import torch
import torch.nn.functional as F

from ..errors import BenchError

Distance = Callable[[torch.Tensor, torch.Tensor], float]  # of two images [3, H, W] in [0, 1]

LPIPS_KINDS = ("lpips_vgg_inria", "lpips_vgg_std", "lpips_alex")
# Files of weights, .npz: conv1.weight [outputs, inputs, h, w], conv1.bias, ..., lin0.weight, ..., lin4.weight.
VARIABLES = {"vgg": "DSMOE_LPIPS_VGG", "alex": "DSMOE_LPIPS_ALEX"}
# ImageNet's mean and standard deviation, in terms of images in [-1, 1].
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class Layout(NamedTuple):
    """The convolutional part of a network, as torchvision has it; a ReLU follows each convolution."""

    sides: Tuple[int, ...]  # of the convolutions' kernels
    strides: Tuple[int, ...]
    paddings: Tuple[int, ...]
    pooling: Tuple[int, int]  # side and stride of the maxima
    pooled: Tuple[int, ...]  # convolutions, from 0, that have a maximum pooling in front
    compared: Tuple[int, ...]  # convolutions whose outputs LPIPS compares


LAYOUTS = {
    # Krizhevsky 2014
    "alex": Layout(sides=(11, 5, 3, 3, 3), strides=(4, 1, 1, 1, 1), paddings=(2, 2, 1, 1, 1), pooling=(3, 2),
                   pooled=(1, 2), compared=(0, 1, 2, 3, 4)),
    # Simonyan and Zisserman 2014, configuration D
    "vgg": Layout(sides=(3,) * 13, strides=(1,) * 13, paddings=(1,) * 13, pooling=(2, 2),
                  pooled=(2, 4, 7, 10), compared=(1, 3, 6, 9, 12)),
}


def net_of(kind: str) -> str:
    """Which network a kind of LPIPS_KINDS is of: a key of LAYOUTS."""
    return "alex" if kind == "lpips_alex" else "vgg"


def lpips_network(kind: str, device: str) -> Distance:
    """LPIPS of two images; `kind` is one of LPIPS_KINDS.

    lpips_vgg_std, lpips_alex: images taken to [-1, 1], as the metric is defined. lpips_vgg_inria: [0, 1] goes into a
    network made for [-1, 1], as the code of 3DGS has it. Raises what the absence of weights raises.
    """
    net, normalise = net_of(kind), kind != "lpips_vgg_inria"
    if os.environ.get(VARIABLES[net]):
        return FileLpips(net, os.environ[VARIABLES[net]], normalise, device)
    try:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
    except ImportError as error:
        raise ImportError("torchmetrics with torchvision is not installed (pip install torchmetrics "
                          "torchvision)") from error
    network = LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=normalise).to(device)

    def distance(image: torch.Tensor, target: torch.Tensor) -> float:
        with torch.no_grad():
            return float(network(image[None], target[None]))

    return distance


class FileLpips:
    """LPIPS from a file of weights; see VARIABLES."""

    def __init__(self, net: str, path: str, normalise: bool, device: str) -> None:
        """net: a key of LAYOUTS. normalise: images in [0, 1] are taken to [-1, 1]. Raises OSError and ValueError."""
        self.layout, self.normalise, arrays = LAYOUTS[net], normalise, arrays_of(net, path)
        self.arrays = {name: torch.tensor(array, dtype=torch.float32, device=device) for name, array in arrays.items()}
        self.shift, self.scale = (torch.tensor(values, device=device)[:, None, None] for values in (SHIFT, SCALE))

    def features(self, image: torch.Tensor) -> List[torch.Tensor]:
        """The outputs that are compared [1, C, h, w], each position's channels of unit length."""
        layout, found = self.layout, []
        x = (((2 * image - 1 if self.normalise else image) - self.shift) / self.scale)[None]
        for index, (stride, padding) in enumerate(zip(layout.strides, layout.paddings)):
            x = F.max_pool2d(x, *layout.pooling) if index in layout.pooled else x
            weight, bias = (self.arrays[f"conv{index + 1}.{name}"] for name in ("weight", "bias"))
            x = F.relu(F.conv2d(x, weight, bias, stride, padding))
            if index in layout.compared:
                found.append(x / (x.pow(2).sum(dim=1, keepdim=True).sqrt() + 1e-10))  # 1e-10: as published
        return found

    @torch.no_grad()
    def __call__(self, image: torch.Tensor, target: torch.Tensor) -> float:
        pairs = enumerate(zip(self.features(image), self.features(target)))
        return float(sum((self.arrays[f"lin{index}.weight"].reshape(1, -1, 1, 1) * (a - b).pow(2)).sum(dim=1).mean()
                         for index, (a, b) in pairs))


def arrays_of(net: str, path: str) -> Dict[str, np.ndarray]:
    """The arrays of a network from a file, lin as [channels]. Raises OSError; ValueError where they are not that."""
    try:
        with np.load(path) as file:
            found = {name: file[name] for name in file.files}
    except OSError:
        raise
    except Exception as error:  # damaged files: numpy, zipfile and zlib raise many kinds
        raise ValueError(f"{path} is no .npz file that can be read ({type(error).__name__})") from error
    found = {name: array.reshape(-1) if name.startswith("lin") else array for name, array in found.items()}
    layout, inputs = LAYOUTS[net], 3
    for index, side in enumerate(layout.sides):
        weight = f"conv{index + 1}.weight"
        outputs = found[weight].shape[0] if weight in found and found[weight].shape else 1
        wanted = {weight: [outputs, inputs, side, side], f"conv{index + 1}.bias": [outputs]}
        if index in layout.compared:
            wanted[f"lin{layout.compared.index(index)}.weight"] = [outputs]
        for name, shape in wanted.items():
            there = list(found[name].shape) if name in found else None
            if there != shape:
                raise ValueError(f"{path}: {name} {'is missing' if there is None else f'has shape {there}'}; it must "
                                 f"have shape {shape}")
        inputs = outputs
    return found


def check_weights(kinds: Sequence[str]) -> None:
    """Raises BenchError where a variable names a file of weights that is wanted and not there."""
    for kind in kinds:
        variable = VARIABLES[net_of(kind)]
        if os.environ.get(variable) and not os.path.isfile(os.environ[variable]):
            raise BenchError(f"{variable}: {os.environ[variable]}: no such file, where the weights of {kind} must be; "
                             "name it, or unset the variable to have torchmetrics download them")


def files_of_weights() -> Dict[str, str]:
    """The variables that name files of weights, with absolute paths: cells run in another folder."""
    return {name: os.path.abspath(os.environ[name]) for name in VARIABLES.values() if os.environ.get(name)}
