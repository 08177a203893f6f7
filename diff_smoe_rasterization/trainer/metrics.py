"""Image metrics as 3DGS papers report them: on images as an 8-bit PNG would hold them, one value per image."""
from __future__ import annotations

import math
from typing import Dict

import torch

from ..losses import fused_ssim


def quantised(image: torch.Tensor) -> torch.Tensor:
    """The image after a trip through an 8-bit file: clamped to [0, 1] and rounded to multiples of 1/255."""
    return (image.clamp(0, 1) * 255).add(0.5).floor().clamp(max=255) / 255


def psnr(image: torch.Tensor, target: torch.Tensor) -> float:
    """Peak signal-to-noise ratio in dB of one image [3, H, W], the squared error averaged over pixels and channels.

    Infinite for equal images, NaN where a pixel is.
    """
    mean_squared_error = float((image - target).double().pow(2).mean())
    return math.inf if mean_squared_error == 0 else -10 * math.log10(mean_squared_error)


def image_metrics(image: torch.Tensor, target: torch.Tensor) -> Dict[str, float]:
    """Metrics of one rendering [3, H, W] against its ground truth in [0, 1].

    psnr, ssim: on 8-bit values (the headline). psnr_float: on floats clamped to [0, 1]. All of them are NaN where a
    pixel of the rendering is NaN or infinite.
    """
    if not bool(torch.isfinite(image).all()):  # clamping would hide the infinite ones
        return {"psnr": math.nan, "ssim": math.nan, "psnr_float": math.nan}
    png = quantised(image)
    return {
        "psnr": psnr(png, target),
        "ssim": float(fused_ssim(png, target, train=False)),
        "psnr_float": psnr(image.clamp(0, 1), target),
    }
