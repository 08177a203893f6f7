"""What is measured of a rendering, the same way whatever program rendered: one number of one image for each metric."""
from __future__ import annotations

import math
import os
from typing import Dict, List, Optional, Sequence

import torch
import torch.nn.functional as F

from ..results.metrics import image_metrics, psnr, quantised
from .lpips import Distance, lpips_network
from .names import VARIABLES, net_of
from .protocol import EDGE_REACH, STRONG_GRADIENT

LUMINANCE = (0.299, 0.587, 0.114)  # Rec. 601


def edge_mask(target: torch.Tensor) -> torch.Tensor:
    """[H, W] bool: pixels near the strong gradients of a ground truth [3, H, W] in [0, 1]; see protocol.EDGE_RULE."""
    luminance = (target * target.new_tensor(LUMINANCE)[:, None, None]).sum(dim=0)
    padded = F.pad(luminance[None, None], (1, 1, 1, 1), mode="replicate")
    sobel = target.new_tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8  # of a ramp: its slope
    gradient = F.conv2d(padded, torch.stack([sobel, sobel.T])[:, None])[0]
    strong = (gradient.norm(dim=0) >= STRONG_GRADIENT).to(target.dtype)
    return F.max_pool2d(strong[None, None], 2 * EDGE_REACH + 1, stride=1, padding=EDGE_REACH)[0, 0] > 0


def edge_psnr(image: torch.Tensor, target: torch.Tensor, mask: Optional[torch.Tensor] = None) -> Optional[float]:
    """PSNR in dB over the pixels of `edge_mask(target)` that the mask [1, H, W], if any, keeps; None without any."""
    edges = edge_mask(target)
    if mask is not None:
        edges &= mask[0] > 0
    kept = None if mask is None else mask[:, edges]
    return psnr(image[:, edges], target[:, edges], kept) if bool(edges.any()) else None


class Measures:
    """All metrics of one rendering; LPIPS of each kind whose weights are at hand."""

    def __init__(self, device: str, lpips: Sequence[str] = ()) -> None:
        self.reasons: Dict[str, Optional[str]] = {}  # why a kind of LPIPS is absent; None if it is measured
        self._networks: Dict[str, Distance] = {}
        for kind in lpips:
            try:
                self._networks[kind] = lpips_network(kind, device)
                self.reasons[kind] = None
            except (ImportError, OSError, KeyError, ValueError, RuntimeError) as error:
                said, *_ = f"{type(error).__name__}: {error}".splitlines()
                variable = VARIABLES[net_of(kind)]
                self.reasons[kind] = (f"${variable}: {said}" if os.environ.get(variable) else
                                      f"no weights at hand: {said} (${variable} may name a file of them)")

    def __call__(self, color: torch.Tensor, target: torch.Tensor,
                 mask: Optional[torch.Tensor] = None, padding: str = "same") -> Dict[str, Optional[float]]:
        """color: a rendering [3, H, W]; mask: [1, H, W], the view's, by which LPIPS multiplies both images.

        padding: of SSIM's windows, as `fused_ssim` takes it.
        """
        png = quantised(color)
        metrics: Dict[str, Optional[float]] = {**image_metrics(color, target, mask, padding),
                                               "psnr_edge": edge_psnr(png, target, mask)}
        if mask is not None:
            png, target = png * mask, target * mask
        for kind, network in self._networks.items():
            try:
                metrics[kind] = distance = network(png, target)
                if not math.isfinite(distance):
                    raise ValueError(f"it is {distance}")
            except (RuntimeError, ValueError) as error:  # an image too small for the strides, too large for the memory
                metrics[kind] = None
                self.reasons[kind] = f"{type(error).__name__}: {error}".splitlines()[0]
        return metrics

    def lpips_of(self, metrics: Dict[str, Optional[float]]) -> List[Dict[str, object]]:
        """Each kind asked for, with its mean, or the reason why some view, and so the scene, has none."""
        return [{"value": metrics.get(kind) if reason is None else None, "kind": kind, "reason": reason}
                for kind, reason in self.reasons.items()]


def headline_lpips(rows: Sequence[Dict[str, object]]) -> Dict[str, object]:
    if not rows:
        return {"value": None, "kind": None, "reason": "the suite asks for none"}
    return next((row for row in rows if row["value"] is not None), rows[0])
