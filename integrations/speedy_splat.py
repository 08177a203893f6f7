"""The API of Speedy-Splat's rasterizer: `scores` [N, 1], by whose gradient Gaussians are pruned.

That gradient is here what the removal of a Gaussian changes, `Splats.importance().removal_costs`: exact in each blend
mode, while the original has the squared derivative by the kernel. The trainer reads only the order of the scores.
`kernel_times` is one NaN: nothing is timed, and the trainer divides by it.
"""
from __future__ import annotations

import torch

from diff_smoe_rasterization import rasterize_with_splats
from diff_smoe_rasterization.autograd import differentiated_once

from ._rasterizer import classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class _Scored(torch.autograd.Function):
    """Passes an image on; its scores get the removal costs."""

    @staticmethod
    def forward(ctx, color, scores, splats):
        ctx.splats = splats
        ctx.sources = color, scores  # not saved by torch, as the caller may edit the image in place
        return color.view_as(color)

    @staticmethod
    def backward(ctx, gradient):
        costs = ctx.splats.importance().removal_costs.reshape(ctx.sources[1].shape)
        if torch.is_grad_enabled():  # true only with create_graph
            costs, = differentiated_once("rasterize_gaussians", [costs], ctx.sources)
        return gradient, costs, None


def _render(settings, inputs):
    scores = inputs.pop("scores", None)
    if scores is not None and scores.requires_grad and torch.is_grad_enabled():
        rendering, splats = rasterize_with_splats(settings=settings, **inputs)
        color, radii = _Scored.apply(rendering.color, scores, splats), rendering.radii
    else:
        color, radii = results_of(("color", "radii"), settings, inputs)
    return color, radii, color.new_full((1,), float("nan"))


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("speedy_splat", __name__, _render)
