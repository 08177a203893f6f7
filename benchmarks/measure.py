"""What is measured of a rendering: PSNR, SSIM, PSNR near edges and LPIPS, the same way whatever program rendered.

Every metric is one number of one image; a scene's figure is the mean over its test views (trainer/evaluation.py).
"""
from __future__ import annotations

import os
from typing import Callable, Dict, List, Optional, Sequence

import numpy as np
import torch
import torch.nn.functional as F

from ..trainer.metrics import image_metrics, psnr, quantised
from .errors import BenchError

LPIPS_KINDS = ("lpips_vgg_inria", "lpips_vgg_std", "lpips_alex")
ALEX_VARIABLE = "DSMOE_LPIPS_ALEX"  # AlexNet's LPIPS weights as .npz: conv1.weight, ..., lin4.weight

STRONG_GRADIENT = 0.05  # of luminance in [0, 1], per pixel: 13 grey levels from one pixel to the next
EDGE_REACH = 3  # pixels in x and y
LUMINANCE = (0.299, 0.587, 0.114)  # Rec. 601
EDGE_RULE = (f"8-bit images, pixels within {EDGE_REACH} px (in x and y) of a pixel of the ground truth whose Rec. 601 "
             f"luminance has a Sobel gradient of at least {STRONG_GRADIENT} per pixel; mean over test views that have "
             "such pixels")


def edge_mask(target: torch.Tensor) -> torch.Tensor:
    """[H, W] bool: pixels near the strong gradients of a ground truth [3, H, W] in [0, 1]; see EDGE_RULE."""
    luminance = (target * target.new_tensor(LUMINANCE)[:, None, None]).sum(dim=0)
    padded = F.pad(luminance[None, None], (1, 1, 1, 1), mode="replicate")
    sobel = target.new_tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8  # of a ramp: its slope
    gradient = F.conv2d(padded, torch.stack([sobel, sobel.T])[:, None])[0]
    strong = (gradient.norm(dim=0) >= STRONG_GRADIENT).to(target.dtype)
    return F.max_pool2d(strong[None, None], 2 * EDGE_REACH + 1, stride=1, padding=EDGE_REACH)[0, 0] > 0


def edge_psnr(image: torch.Tensor, target: torch.Tensor) -> Optional[float]:
    """PSNR in dB of two images [3, H, W] over the pixels of `edge_mask(target)`; None where there are none."""
    mask = edge_mask(target)
    return psnr(image[:, mask], target[:, mask]) if bool(mask.any()) else None


class Measures:
    """All metrics of one rendering; LPIPS of each kind whose weights are at hand."""

    def __init__(self, device: str, lpips: Sequence[str] = ()) -> None:
        """lpips: names of LPIPS_KINDS. Raises BenchError for another name."""
        self.reasons: Dict[str, Optional[str]] = {}  # why a kind of LPIPS is absent; None where it is measured
        self._networks: Dict[str, Callable[[torch.Tensor, torch.Tensor], float]] = {}
        for kind in lpips:
            if kind not in LPIPS_KINDS:
                raise BenchError(f"lpips is {kind!r}; it must be one of {', '.join(LPIPS_KINDS)}")
            try:
                self._networks[kind] = lpips_network(kind, device)
                self.reasons[kind] = None
            except (ImportError, OSError, KeyError, ValueError, RuntimeError) as error:
                first, *_ = f"no weights at hand: {type(error).__name__}: {error}".splitlines()
                hint = f" (${ALEX_VARIABLE} may name a file of them)" if kind == "lpips_alex" else ""
                self.reasons[kind] = first + hint

    def __call__(self, color: torch.Tensor, target: torch.Tensor) -> Dict[str, Optional[float]]:
        """color: a rendering [3, H, W]; target: its ground truth in [0, 1]."""
        png = quantised(color)
        metrics: Dict[str, Optional[float]] = {**image_metrics(color, target), "psnr_edge": edge_psnr(png, target)}
        for kind, network in self._networks.items():
            try:
                metrics[kind] = network(png, target)
            except (RuntimeError, ValueError) as error:  # an image too small for the network's strides
                metrics[kind] = None
                self.reasons[kind] = f"{type(error).__name__}: {error}".splitlines()[0]
        return metrics

    def lpips_of(self, metrics: Dict[str, Optional[float]]) -> List[Dict[str, object]]:
        """Each kind asked for, with its mean or the reason why there is none."""
        return [{"value": metrics.get(kind), "kind": kind, "reason": reason} for kind, reason in self.reasons.items()]


def headline_lpips(rows: Sequence[Dict[str, object]]) -> Dict[str, object]:
    """The first kind that has a value, else the first."""
    if not rows:
        return {"value": None, "kind": None, "reason": "the suite asks for none"}
    return next((row for row in rows if row["value"] is not None), rows[0])


def lpips_network(kind: str, device: str) -> Callable[[torch.Tensor, torch.Tensor], float]:
    """LPIPS (Zhang et al. 2018, v0.1) of two images [3, H, W] in [0, 1]; `kind` is one of LPIPS_KINDS.

    lpips_vgg_std, lpips_alex: images taken to [-1, 1], as the metric is defined. lpips_vgg_inria: [0, 1] goes into a
    network made for [-1, 1], as the code of 3DGS has it. Raises what the absence of weights raises.
    """
    if kind == "lpips_alex" and os.environ.get(ALEX_VARIABLE):
        return AlexLpips(os.environ[ALEX_VARIABLE], device)
    try:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
    except ImportError as error:
        raise ImportError("torchmetrics with torchvision is not installed (pip install torchmetrics "
                          "torchvision)") from error
    net = "alex" if kind == "lpips_alex" else "vgg"
    network = LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=kind != "lpips_vgg_inria").to(device)

    def distance(image: torch.Tensor, target: torch.Tensor) -> float:
        with torch.no_grad():
            return float(network(image[None], target[None]))

    return distance


class AlexLpips:
    """LPIPS v0.1 over AlexNet from a file of weights, for machines without a network connection."""

    # Stride, padding and whether a 3x3 max pooling of stride 2 comes first, of AlexNet's five convolutions
    # (Krizhevsky 2014, torchvision's layout).
    LAYERS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
    # ImageNet's mean and standard deviation, in terms of images in [-1, 1].
    SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

    def __init__(self, path: str, device: str) -> None:
        with np.load(path) as file:
            def tensor(name: str) -> torch.Tensor:
                return torch.tensor(file[name], dtype=torch.float32, device=device)

            names = alex_names(file.files)
            self.convolutions = [(tensor(weight), tensor(bias)) for weight, bias, _ in names]
            self.weights = [tensor(linear).reshape(1, -1, 1, 1) for _, _, linear in names]
        self.shift, self.scale = (torch.tensor(values, device=device)[:, None, None]
                                  for values in (self.SHIFT, self.SCALE))

    def features(self, image: torch.Tensor) -> List[torch.Tensor]:
        """The outputs of the five layers [1, C, h, w], each position's channels of unit length."""
        x = ((2 * image - 1 - self.shift) / self.scale)[None]
        found = []
        for (weight, bias), (stride, padding, pools) in zip(self.convolutions, self.LAYERS):
            x = F.max_pool2d(x, 3, 2) if pools else x
            x = F.relu(F.conv2d(x, weight, bias, stride, padding))
            found.append(x / (x.pow(2).sum(dim=1, keepdim=True).sqrt() + 1e-10))  # 1e-10: as published
        return found

    def __call__(self, image: torch.Tensor, target: torch.Tensor) -> float:
        with torch.no_grad():
            pairs = zip(self.weights, self.features(image), self.features(target))
            return float(sum((weight * (a - b).pow(2)).sum(dim=1).mean() for weight, a, b in pairs))


def alex_names(files: Sequence[str]) -> List[Sequence[str]]:
    """The names (weight, bias, linear) of the five layers in the .npz. Raises KeyError naming what is missing."""
    names = [(f"conv{layer + 1}.weight", f"conv{layer + 1}.bias", f"lin{layer}.weight") for layer in range(5)]
    missing = [name for group in names for name in group if name not in files]
    if missing:
        raise KeyError(f"{missing[0]} is not among the arrays of ${ALEX_VARIABLE}: {', '.join(sorted(files))}")
    return names
