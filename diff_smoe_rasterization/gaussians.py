"""Passes over all Gaussians between the optimizer and the rasterizer, each one kernel."""
from __future__ import annotations

from typing import Any, Tuple

import torch

from .autograd import refuse_forward_mode
from .extension import _C  # noqa: F401  (loading it registers the ops)

_OPS = torch.ops.diff_smoe_rasterization


def activate(opacities: torch.Tensor, scales: torch.Tensor,
             rotations: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What the rasterizer takes from what an optimizer moves freely, differentiably.

    opacities: [N, 1] logits, scales: [N, 3] logarithms, rotations: [N, 4] quaternions of any length. Returns: opacities
    sigmoid(.), scales exp(.), rotations of length 1 (a quaternion shorter than 1e-12 is divided by that).
    Raises ValueError or TypeError where shapes, types or devices do not fit.
    """
    refuse_forward_mode("activate", (opacities, scales, rotations))
    if torch.is_grad_enabled() and (opacities.requires_grad or scales.requires_grad or rotations.requires_grad):
        return _Activate.apply(opacities, scales, rotations)
    return _OPS.activate(opacities, scales, rotations)


def add_view(dL_dmeans2D: torch.Tensor, radii: torch.Tensor, gradient_sum: torch.Tensor,
             view_count: torch.Tensor) -> None:
    """Adds one view to the statistics of densification, in place.

    Where radii [N] (int32) is positive, gradient_sum [N] grows by the length of the first two components of
    dL_dmeans2D [N, 3], and view_count [N] by 1. Raises ValueError or TypeError where shapes or types do not fit.
    """
    _OPS.add_view(dL_dmeans2D, radii, gradient_sum, view_count)


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *raw: torch.Tensor) -> Tuple[torch.Tensor, ...]:
        values = _OPS.activate(*raw)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*raw, *values)
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *dL_dvalues: Any) -> Tuple[torch.Tensor, ...]:  # type: ignore[override]
        saved = ctx.saved_tensors
        return _OPS.activate_backward(saved[:3], saved[3:], *dL_dvalues)
