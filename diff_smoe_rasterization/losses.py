"""SSIM and the training loss of 3DGS, each with its exact gradient, in a few kernels."""
from __future__ import annotations

from typing import Any, Tuple

import torch

from .autograd import once_differentiable, refuse_transforms
from .checks import check_tensors, checked_number
from .extension import BACKENDS  # noqa: F401  (loading it registers the ops)

_OPS = torch.ops.diff_smoe_rasterization
_WINDOW_RADIUS = 5  # pixels; of the 11x11 window
_MARGINS = {"same": 0, "valid": _WINDOW_RADIUS, "around": 0}


def l1_ssim_loss(image: torch.Tensor, target: torch.Tensor, lambda_dssim: float = 0.2,
                 padding: str = "same") -> torch.Tensor:
    """(1 - lambda) mean |image - target| + lambda (1 - SSIM), the loss of 3D Gaussian Splatting.

    image: [..., H, W], float32 or float64. target: of the same shape and type, or uint8 (then 255 is 1); it gets no
    gradient. SSIM and padding are as in `fused_ssim`; the mean of |image - target| is over all pixels in any case.
    Raises ValueError or TypeError if shapes, types or devices do not fit.
    """
    check_tensors("l1_ssim_loss", image=image, target=target)
    lambda_dssim = checked_number("l1_ssim_loss", "lambda_dssim", lambda_dssim)
    _refuse_gradient("l1_ssim_loss", "target", target)
    return _image_loss(image, target, 1 - lambda_dssim, 0.0, -lambda_dssim, lambda_dssim,
                       _checked_padding("l1_ssim_loss", padding))


def l1_ssim_loss_and_gradient(image: torch.Tensor, target: torch.Tensor, lambda_dssim: float = 0.2,
                              padding: str = "same") -> Tuple[torch.Tensor, torch.Tensor]:
    """`l1_ssim_loss` and its gradient by the image, without autograd."""
    check_tensors("l1_ssim_loss_and_gradient", image=image, target=target)
    lambda_dssim = checked_number("l1_ssim_loss_and_gradient", "lambda_dssim", lambda_dssim)
    return _loss(True, image.detach(), target, 1 - lambda_dssim, 0.0, -lambda_dssim, lambda_dssim,
                 _checked_padding("l1_ssim_loss_and_gradient", padding))


def l2_ssim_loss_and_gradient(image: torch.Tensor, target: torch.Tensor, lambda_dssim: float, weight: float,
                              padding: str = "same") -> Tuple[torch.Tensor, torch.Tensor]:
    """As `l1_ssim_loss_and_gradient`, with weight times the mean squared error in place of the mean absolute one."""
    check_tensors("l2_ssim_loss_and_gradient", image=image, target=target)
    lambda_dssim = checked_number("l2_ssim_loss_and_gradient", "lambda_dssim", lambda_dssim)
    weight = checked_number("l2_ssim_loss_and_gradient", "weight", weight)
    return _loss(True, image.detach(), target, 0.0, weight * (1 - lambda_dssim), -lambda_dssim, lambda_dssim,
                 _checked_padding("l2_ssim_loss_and_gradient", padding))


def fused_ssim(img1: torch.Tensor, img2: torch.Tensor, padding: str = "same", train: bool = True) -> torch.Tensor:
    """Mean structural similarity (Wang et al. 2004) of images in [0, 1]: 11x11 Gaussian window of sigma 1.5.

    img1, img2: [B, C, H, W] or [C, H, W]. padding: "same", windows reach into zeros outside the image; "valid", the
    mean leaves out the 5 pixels at each side whose windows do, so H and W must be at least 11; "around", windows reach
    across the left and the right border to the other one, as those of 360 degrees meet. train: whether a gradient may
    be asked for; only img1 gets one. The call is as in the package `fused_ssim`.
    Raises ValueError or TypeError if arguments do not fit.
    """
    check_tensors("fused_ssim", img1=img1, img2=img2)
    padding = _checked_padding("fused_ssim", padding)
    _refuse_gradient("fused_ssim", "img2", img2)
    return _image_loss(img1 if train else img1.detach(), img2, 0.0, 0.0, 1.0, 0.0, padding)


def _checked_padding(function: str, padding: str) -> str:
    if not isinstance(padding, str) or padding not in _MARGINS:
        raise ValueError(f"{function}: padding is {padding!r}; it must be one of {', '.join(_MARGINS)}")
    return padding


def _refuse_gradient(function: str, name: str, tensor: torch.Tensor) -> None:
    if tensor.requires_grad and torch.is_grad_enabled():
        raise ValueError(f"{function}: {name} requires a gradient, which only the first image gets; detach it")


def _image_loss(image: torch.Tensor, *arguments: Any) -> torch.Tensor:
    refuse_transforms("SSIM and the image loss", [image, *arguments])
    if image.requires_grad and torch.is_grad_enabled():
        return _ImageLoss.apply(image, *arguments)
    return _loss(False, image, *arguments)[0]


def _loss(with_gradient: bool, image: torch.Tensor, target: torch.Tensor, l1_weight: float, l2_weight: float,
          ssim_weight: float, offset: float, padding: str) -> Tuple[torch.Tensor, torch.Tensor]:
    """The op `image_loss`. With "around" SSIM is that of the "valid" windows of larger images."""
    if padding != "around":
        return _OPS.image_loss(image, target, l1_weight, l2_weight, ssim_weight, offset, _MARGINS[padding],
                               with_gradient)
    loss, gradient = _OPS.image_loss(image, target, l1_weight, l2_weight, 0.0, offset, 0, with_gradient)
    similarity, by_larger = _OPS.image_loss(with_columns_around(image), with_columns_around(target), 0.0, 0.0,
                                            ssim_weight, 0.0, _WINDOW_RADIUS, with_gradient)
    if with_gradient:  # each column adds up what came to its copies
        width, zeros = image.shape[-1], -_WINDOW_RADIUS % image.shape[-1]
        by_columns = torch.nn.functional.pad(by_larger[..., _WINDOW_RADIUS:-_WINDOW_RADIUS, :], (zeros, zeros))
        gradient = gradient + by_columns.reshape(*image.shape[:-1], -1, width).sum(-2)
    return loss + similarity, gradient


def with_columns_around(image: torch.Tensor) -> torch.Tensor:
    """[..., H + 10, W + 10]: an image [..., H, W] with what windows reach: 5 columns of the other border at each side,
    and 5 rows of zeros above and below."""
    columns = torch.arange(-_WINDOW_RADIUS, image.shape[-1] + _WINDOW_RADIUS, device=image.device) % image.shape[-1]
    return torch.nn.functional.pad(image[..., columns], (0, 0, _WINDOW_RADIUS, _WINDOW_RADIUS))


class _ImageLoss(torch.autograd.Function):
    """The op `image_loss`, whose gradient is computed with the value."""

    @staticmethod
    def forward(ctx: Any, image: torch.Tensor, *arguments: Any) -> torch.Tensor:
        loss, gradient = _loss(True, image, *arguments)
        ctx.save_for_backward(image, gradient)
        return loss

    @staticmethod
    @once_differentiable("SSIM and the image loss")
    def backward(ctx: Any, dL_dloss: torch.Tensor) -> Tuple[Any, ...]:  # type: ignore[override]
        _, gradient = ctx.saved_tensors
        return (gradient * dL_dloss,) + (None,) * 6
