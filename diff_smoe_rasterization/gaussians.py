"""Passes over all Gaussians between the optimizer and the rasterizer, each one kernel."""
from __future__ import annotations

from typing import Any, Tuple

import torch

from .autograd import once_differentiable, refuse_transforms
from .checks import check_tensors, checked_number
from .extension import BACKENDS  # noqa: F401  (loading it registers the ops)

_OPS = torch.ops.diff_smoe_rasterization


def activate(opacities: torch.Tensor, scales: torch.Tensor,
             rotations: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What the rasterizer takes from what an optimizer moves freely, differentiably.

    opacities: [N, 1] logits, scales: [N, 3] logarithms, rotations: [N, 4] quaternions of any length. Returns: opacities
    sigmoid(.), scales exp(.), rotations of length 1 (a quaternion shorter than 1e-12 is divided by that).
    Raises ValueError or TypeError if shapes, types or devices do not fit.
    """
    check_tensors("activate", opacities=opacities, scales=scales, rotations=rotations)
    refuse_transforms("activate", (opacities, scales, rotations))
    if torch.is_grad_enabled() and (opacities.requires_grad or scales.requires_grad or rotations.requires_grad):
        return _Activate.apply(opacities, scales, rotations)
    return _OPS.activate(opacities, scales, rotations)


def quaternion_to_matrix(rotations: torch.Tensor) -> torch.Tensor:
    """[..., 3, 3] rotation matrices of quaternions (w, x, y, z) [..., 4], used as given, as the rasterizer does."""
    w, x, y, z = rotations.unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], -1).unflatten(-1, (3, 3))


def add_view(dL_dmeans2D: torch.Tensor, radii: torch.Tensor, gradient_sum: torch.Tensor,
             view_count: torch.Tensor) -> None:
    """Adds one view to the statistics of densification, in place.

    If radii [N] (int32) is positive, gradient_sum [N] grows by the length of the first two components of
    dL_dmeans2D [N, 3], and view_count [N] by 1. Raises ValueError or TypeError if shapes or types do not fit.
    """
    check_tensors("add_view", dL_dmeans2D=dL_dmeans2D, radii=radii, gradient_sum=gradient_sum, view_count=view_count)
    _OPS.add_view(dL_dmeans2D, radii, gradient_sum, view_count)


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *raw: torch.Tensor) -> Tuple[torch.Tensor, ...]:
        values = _OPS.activate(*raw)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*raw, *values)
        return values

    @staticmethod
    @once_differentiable("activate")
    def backward(ctx: Any, *dL_dvalues: Any) -> Tuple[torch.Tensor, ...]:  # type: ignore[override]
        saved = ctx.saved_tensors
        return _OPS.activate_backward(saved[:3], saved[3:], *dL_dvalues)


MOST_COPIES = 50  # of a Gaussian in `divided`: beyond, the binomials lose their digits


def divided(opacities: torch.Tensor, copies: torch.Tensor,
            least_opacity: float = 0.0) -> Tuple[torch.Tensor, torch.Tensor]:
    """Opacity and scale factor [M] of each of n equal Gaussians in one place that look as the one before.

    That is Equation 9 of 3D Gaussian Splatting as Markov Chain Monte Carlo (arXiv:2404.09591).
    opacities: [M] of the one; copies: [M] n, taken as 50 if it is more. least_opacity: the scale factor follows it.
    """
    check_tensors("divided", opacities=opacities, copies=copies)
    if opacities.dim() != 1 or copies.shape != opacities.shape:
        raise ValueError(f"divided: opacities has shape {list(opacities.shape)} and copies {list(copies.shape)}; both "
                         "must be [M]")
    least_opacity = checked_number("divided", "least_opacity", least_opacity)
    old, n = opacities.double().unsqueeze(1), copies.double().clamp(1, MOST_COPIES).unsqueeze(1)
    new = (1 - (1 - old) ** (1 / n)).clamp(min=least_opacity)
    j = torch.arange(1.0, MOST_COPIES + 1, dtype=torch.float64, device=opacities.device)
    # The paper's sum over i of the binomials (i - 1, k) is (n, k + 1).
    log_binomials = torch.lgamma(n + 1) - torch.lgamma(j + 1) - torch.lgamma((n - j).clamp(min=0) + 1)
    signs = 2 * (j % 2) - 1
    terms = signs * (log_binomials + j * new.log()).exp() / j.sqrt()
    sums = terms.masked_fill(j > n, 0).sum(1)
    return new.squeeze(1).to(opacities), (old.squeeze(1) / sums).to(opacities)
