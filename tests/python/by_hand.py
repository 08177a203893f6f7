"""Scenes so simple that their pixels can be computed by hand."""
from __future__ import annotations

import torch
from scenes import camera_settings


def facing_camera(mode, width=11, height=7, bg=(0.1, 0.2, 0.3), **fields):
    """A camera in the origin that looks along z; tan(fov / 2) = 1, so that focal lengths are half the image size."""
    identity = torch.eye(4, dtype=torch.float64)
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0] = projection[1, 1] = projection[2, 2] = projection[2, 3] = 1
    settings = camera_settings(width, height, bg=torch.tensor(bg, dtype=torch.float64), blend_mode=mode, **fields)
    return settings._replace(tanfovx=1.0, tanfovy=1.0, viewmatrix=identity, projmatrix=projection,
                             campos=torch.zeros(3, dtype=torch.float64))


def on_axis(depths, opacities, colors, variance=0.04):
    """Isotropic Gaussians on the optical axis: they project to the middle of the image."""
    count = len(depths)
    covariance = variance * torch.tensor([1, 0, 0, 1, 0, 1], dtype=torch.float64)
    return dict(means3D=torch.tensor([[0, 0, depth] for depth in depths], dtype=torch.float64),
                opacities=torch.tensor(opacities, dtype=torch.float64)[:, None],
                colors_precomp=torch.tensor(colors, dtype=torch.float64), cov3D_precomp=covariance.repeat(count, 1))


def middle(rendering_image):
    return rendering_image[:, rendering_image.shape[1] // 2, rendering_image.shape[2] // 2].tolist()
