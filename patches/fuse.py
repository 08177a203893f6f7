"""What --fuse does as a script begins: SSIM and Adam by this package's kernels, the same but for rounding."""
from __future__ import annotations

import contextlib
import importlib
from functools import partial
from typing import Any, Callable, Dict

import torch

from diff_smoe_rasterization import FusedAdam, fused_ssim

from .runtime import say

# Of the largest value. Of a variance E[x^2] - E[x]^2 float32 rounds off some 1e-7 of E[x^2], which may be 1e-4 of the
# variance; another window, border or constant makes several per cent.
SSIM_ROUNDING = 1e-3


def start() -> None:
    """Changes torch.optim.Adam and the trainer's utils.loss_utils.ssim in this process."""
    torch.optim.Adam = fused_where_it_fits(torch.optim.Adam)
    with contextlib.suppress(ImportError, AttributeError):  # the trainer will say what is missing
        losses: Any = importlib.import_module("utils.loss_utils")
        losses.ssim = partial(fused_where_equal, losses.ssim, {})


def fused_where_it_fits(adam: Any) -> Any:
    """Returns a class in the place of torch.optim.Adam: a call makes FusedAdam if that has its arguments."""
    class Adam(adam):
        def __new__(cls, *arguments: Any, **keywords: Any) -> Any:
            if cls is not Adam:  # a class of the trainer's own
                return super().__new__(cls)
            fits = len(arguments) <= 4 and set(keywords) <= {"params", "lr", "betas", "eps"}
            return (FusedAdam if fits else adam)(*arguments, **keywords)

    return Adam


def fused_where_equal(ssim: Callable[..., Any], differences: Dict[Any, str], *images: Any, **keywords: Any) -> Any:
    """Returns a trainer's ssim(img1, img2, ...), by `fused_ssim` if that can be.

    img1, img2: [3, H, W] or [B, 3, H, W]. Of the first images of a shape both are computed: if they differ in value
    or gradient the trainer's own stays, and a line on stderr says so. It is also called for other arguments and types,
    and for gradients by img2: the kernel has none of it. differences: by shape, what was found.
    """
    first, second = images if len(images) == 2 and not keywords else (torch.empty(0),) * 2
    if (first.dim() not in (3, 4) or first.shape != second.shape or first.device != second.device
            or {first.dtype, second.dtype} != {torch.float32} or second.requires_grad and torch.is_grad_enabled()):
        return ssim(*images, **keywords)
    case = first.device, first.shape
    if case not in differences:
        differences[case] = difference_of(ssim, first, second)
        if differences[case]:
            say(f"--fuse: utils.loss_utils.ssim is not SSIM as it is fused here ({differences[case]}): it is computed "
                "as before")
    return ssim(*images) if differences[case] else fused_ssim(*images)


def difference_of(own: Callable[..., Any], img1: Any, img2: Any) -> str:
    """What a similarity of images differs in from ours, its gradient by img1 too; empty if in nothing."""
    results = []
    with torch.inference_mode(False), torch.enable_grad(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        try:
            for similarity in (fused_ssim, own):
                image = img1.detach().clone().requires_grad_()
                value = similarity(image, img2.detach().clone())
                results.append((value.detach(), *torch.autograd.grad(value, image)))
            for ours, theirs in zip(*results):
                torch.testing.assert_close(theirs, ours, rtol=0, atol=SSIM_ROUNDING * float(ours.abs().max()))
        except Exception as error:  # whatever another function has against the images: the training goes on
            return " ".join(str(error).split())
    return ""
