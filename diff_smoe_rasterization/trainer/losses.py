"""The training loss of 3DGS: (1 - lambda) L1 + lambda (1 - SSIM)."""
from __future__ import annotations

from typing import Any, NamedTuple, Tuple

import torch
import torch.nn.functional as F

WINDOW = 11  # taps of the Gaussian window (Wang et al. 2004)
SIGMA = 1.5
C1 = 0.01**2  # stabilisers of SSIM for images in [0, 1]
C2 = 0.03**2


def gaussian_window(dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """[WINDOW] samples of a Gaussian that sum to 1."""
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-offsets**2 / (2 * SIGMA**2))
    return (weights / weights.sum()).to(dtype=dtype, device=device)


def blur(images: torch.Tensor) -> torch.Tensor:
    """Gaussian blur with zero padding, axis by axis. images: [C, H, W]. The operator is symmetric: its own adjoint."""
    planes = images.shape[0]
    window = gaussian_window(images.dtype, images.device)
    rows = window.view(1, 1, 1, WINDOW).expand(planes, 1, 1, WINDOW)
    columns = window.view(1, 1, WINDOW, 1).expand(planes, 1, WINDOW, 1)
    # Planes interleaved, one group each: on a CPU, 5 times faster than planes one after another.
    stack = images.unsqueeze(0).contiguous(memory_format=torch.channels_last)
    stack = F.conv2d(stack, rows, padding=(0, WINDOW // 2), groups=planes)
    stack = F.conv2d(stack, columns, padding=(WINDOW // 2, 0), groups=planes)
    return stack.squeeze(0).contiguous()


class TargetMoments(NamedTuple):
    """What SSIM needs of the ground truth alone; computed once per view."""

    image: torch.Tensor  # [3, H, W]
    mean: torch.Tensor  # [3, H, W] local mean
    variance: torch.Tensor  # [3, H, W] local variance


def target_moments(image: torch.Tensor) -> TargetMoments:
    """Local moments of a ground-truth image [3, H, W] in [0, 1]."""
    mean, mean_square = blur(torch.cat([image, image * image])).chunk(2)
    return TargetMoments(image, mean, mean_square - mean * mean)


class _MeanSsim(torch.autograd.Function):
    """Mean SSIM of an image against fixed moments, with its exact gradient by three blurs.

    With mu = K x, q = K x^2, r = K (x y), mu_y and var_y given:
    S = A1 A2 / (B1 B2), A1 = 2 mu mu_y + C1, A2 = 2 (r - mu mu_y) + C2,
    B1 = mu^2 + mu_y^2 + C1, B2 = q - mu^2 + var_y + C2.
    """

    @staticmethod
    def forward(ctx: Any, image: torch.Tensor, target: torch.Tensor, target_mean: torch.Tensor,
                target_variance: torch.Tensor) -> torch.Tensor:
        mean, square, product = blur(torch.cat([image, image * image, image * target])).chunk(3)
        means = mean * target_mean
        a1 = 2 * means + C1
        a2 = 2 * (product - means) + C2
        b1 = mean * mean + target_mean * target_mean + C1
        b2 = square - mean * mean + target_variance + C2
        ssim = a1 * a2 / (b1 * b2)
        ctx.save_for_backward(image, target, mean, target_mean, a1, a2, b1, b2, ssim)
        return ssim.mean()

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> Tuple[torch.Tensor, None, None, None]:  # type: ignore[override]
        image, target, mean, target_mean, a1, a2, b1, b2, ssim = ctx.saved_tensors
        inverse = 1 / (b1 * b2)
        d_mean = 2 * target_mean * (a2 - a1) * inverse + 2 * mean * ssim * (1 / b2 - 1 / b1)
        d_square = -ssim / b2
        d_product = 2 * a1 * inverse
        d_mean, d_square, d_product = blur(torch.cat([d_mean, d_square, d_product])).chunk(3)
        gradient = d_mean + 2 * image * d_square + target * d_product
        return gradient * (grad / image.numel()), None, None, None


def ssim(image: torch.Tensor, target: TargetMoments) -> torch.Tensor:
    """Mean structural similarity (Wang et al. 2004): 11x11 window, sigma 1.5, zero padding. image: [3, H, W]."""
    return _MeanSsim.apply(image, target.image, target.mean, target.variance)


def training_loss(image: torch.Tensor, target: TargetMoments, lambda_dssim: float) -> torch.Tensor:
    """(1 - lambda) mean |image - target| + lambda (1 - SSIM). image: [3, H, W]."""
    l1 = (image - target.image).abs().mean()
    if lambda_dssim == 0:
        return l1
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim(image, target))
