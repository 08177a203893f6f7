"""The API of MonoGS's rasterizer: depth, opacity, n_touched, and the camera's gradient by `theta` and `rho`.

theta and rho [3] are a small rotation and translation that follow world to view: T becomes exp(rho, theta) T. Their
values are not read, only their gradients are of use; the trainer moves its camera by them. `n_touched` counts every
pixel that blended a Gaussian, also where it lies behind others: the original counts those in front, of T > 1/2.
"""
from __future__ import annotations

import torch

from ._rasterizer import classes_of, results_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

RESULTS = ("color", "radii", "depth", "opacity", "n_touched")


def _render(settings, inputs):
    theta, rho = inputs.pop("theta", None), inputs.pop("rho", None)
    if theta is not None or rho is not None:
        settings = _moved(settings, theta, rho)
    return results_of(RESULTS, settings, inputs)


def _moved(settings, theta, rho):
    """Returns the settings with a camera that depends on theta and rho, at 0, to first order."""
    view = settings.viewmatrix  # transposed
    zero = view.new_zeros(3)
    x, y, z = (zero if theta is None else theta.reshape(3) - theta.reshape(3).detach()).unbind()
    nothing = torch.zeros_like(x)
    turn = torch.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing]).reshape(3, 3)  # turn @ v = theta x v
    step = torch.cat([turn.T, (zero if rho is None else rho.reshape(3) - rho.reshape(3).detach())[None]])  # transposed
    moved = view + torch.cat([view[:, :3] @ step[:3] + view[:, 3:] * step[3:], view.new_zeros(4, 1)], 1)
    projection = settings.projmatrix_raw
    if projection is None:  # what the product of both says
        projection = torch.linalg.solve(view, settings.projmatrix)
    centre = -moved[3, :3] @ torch.linalg.inv(moved[:3, :3])
    return settings._replace(viewmatrix=moved, projmatrix=moved @ projection, campos=centre)


GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("monogs", __name__, _render)
