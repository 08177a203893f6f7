"""Image metrics as 3DGS papers report them: on images as an 8-bit PNG would hold them, one value per image."""
from __future__ import annotations

import math
from typing import Dict, Optional

import torch
import torch.nn.functional as F

from diff_smoe_rasterization.losses import fused_ssim, with_columns_around


def quantised(image: torch.Tensor) -> torch.Tensor:
    """The image after a trip through an 8-bit file: clamped to [0, 1] and rounded to multiples of 1/255."""
    return (image.clamp(0, 1) * 255).add(0.5).floor().clamp(max=255) / 255


def psnr(image: torch.Tensor, target: torch.Tensor, mask: Optional[torch.Tensor] = None) -> float:
    """Peak signal-to-noise ratio in dB of one image [3, H, W], the squared error averaged over pixels and channels.

    mask: [1, H, W] in [0, 1], how much each pixel counts. Infinite for equal images, NaN if a pixel is.
    """
    mean_squared_error = _mean((image - target).double().pow(2), mask)
    return math.inf if mean_squared_error == 0 else -10 * math.log10(mean_squared_error)


def masked_ssim(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor, padding: str = "same") -> float:
    """SSIM of two images [3, H, W], both times the mask [1, H, W], averaged over the pixels as the mask counts them.

    Window, constants and padding, "same" or "around", are those of `fused_ssim`, which gives only the plain mean.
    """
    offsets = torch.arange(11, device=image.device) - 5.0
    line = torch.exp(-offsets**2 / (2 * 1.5**2)).double()
    window = torch.outer(line, line)[None, None] / line.sum()**2
    x, y = ((picture * mask).double()[:, None] for picture in (image, target))  # channels as a batch: [3, 1, H, W]

    def blurred(planes: torch.Tensor) -> torch.Tensor:
        if padding == "around":
            return F.conv2d(with_columns_around(planes), window)
        return F.conv2d(planes, window, padding=5)

    mean_x, mean_y = blurred(x), blurred(y)
    variances = blurred(x * x) - mean_x**2 + blurred(y * y) - mean_y**2
    covariance = blurred(x * y) - mean_x * mean_y
    ssim = ((2 * mean_x * mean_y + 0.01**2) * (2 * covariance + 0.03**2)
            / ((mean_x**2 + mean_y**2 + 0.01**2) * (variances + 0.03**2)))
    return _mean(ssim[:, 0], mask)


def _mean(values: torch.Tensor, mask: Optional[torch.Tensor]) -> float:
    """Of values [3, H, W] over channels and pixels, weighed by the mask [1, H, W] if there is one."""
    return float(values.mean() if mask is None else (values * mask).sum() / (len(values) * mask.double().sum()))


def image_metrics(image: torch.Tensor, target: torch.Tensor, mask: Optional[torch.Tensor] = None,
                  padding: str = "same") -> Dict[str, float]:
    """Metrics of one rendering [3, H, W] against its ground truth in [0, 1], over what the mask [1, H, W] keeps.

    psnr, ssim: on 8-bit values (the headline). psnr_float: on floats clamped to [0, 1]. All of them are NaN if a
    pixel of the rendering is NaN or infinite. padding: of SSIM's windows, "same" or "around".
    """
    if not bool(torch.isfinite(image).all()):  # clamping would hide the infinite ones
        return {"psnr": math.nan, "ssim": math.nan, "psnr_float": math.nan}
    png = quantised(image)
    return {
        "psnr": psnr(png, target, mask),
        "ssim": (float(fused_ssim(png, target, padding, train=False)) if mask is None
                 else masked_ssim(png, target, mask, padding)),
        "psnr_float": psnr(image.clamp(0, 1), target, mask),
    }
