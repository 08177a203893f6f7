"""The API of RaDe-GS's rasterizer: depths and normals of the planes that Gaussians are near the rays through them.

A ray from the camera is deepest inside a Gaussian where t = (r^T A m) / (r^T A r). r is its direction, m the centre
and A the inverse covariance, in the camera's frame. RaDe-GS takes the first-order expansion of the distance t |r|
around the ray through the centre. It is linear in the pixel, so sums of it are images of three features. The normal is
-A m.

In the blend modes a mean is by the weights of the mode. The median is where the weights, front to back, reach half a
pixel, as T passes 0.5 in `alpha`; it needs a walk in plain torch. `integrate` (meshes by tetrahedra) is refused.
"""
from __future__ import annotations

from typing import Any, Dict, NoReturn, Tuple

import torch
from torch.nn.functional import normalize

from diff_smoe_rasterization import GaussianRasterizationSettings as Settings
from diff_smoe_rasterization import reference

from ._rasterizer import classes_of, median_places, pixel_rays, results_of, results_with_features

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


def _render(settings, inputs):
    settings = settings._replace(antialiasing=True)
    if settings.kernel_size is not None:
        settings = settings._replace(low_pass=settings.kernel_size)
    if not (settings.require_depth or settings.require_coord):
        color, radii, alpha = results_of(("color", "radii", "alpha"), settings, inputs)
        depth, coord = torch.zeros_like(alpha), alpha.new_zeros(3, *alpha.shape[1:])
        return color, radii, coord, coord.clone(), depth, depth.clone(), alpha, coord.clone()
    planes, normals = _planes(settings, inputs)
    color, radii, alpha, sums = results_with_features(
        ("color", "radii", "alpha", "features"), settings, inputs, "features",
        torch.cat([planes, normals, torch.ones_like(planes[:, :1])], 1))
    x, y = pixel_rays(settings, color)
    x, y = x.expand(len(y), -1), y[:, None].expand(-1, len(x))
    length = (x * x + y * y + 1).sqrt()
    shown = sums[6] > 0
    mean = (sums[0] + sums[1] * x + sums[2] * y) / torch.where(shown, sums[6], 1) / length
    which = median_places(settings, inputs)
    of_pixel = planes[which.clamp(min=0)] if len(planes) else planes.new_zeros(*which.shape, 3)
    median = (of_pixel[..., 0] + of_pixel[..., 1] * x + of_pixel[..., 2] * y) / length
    depth, median = mean.masked_fill(~shown, 0)[None], median.masked_fill(which < 0, 0)[None]
    rays = torch.stack([x, y, torch.ones_like(x)])
    return color, radii, depth * rays, median * rays, depth, median, alpha, normalize(sums[3:6], dim=0)


def _planes(settings: Settings, inputs: Dict[str, Any]) -> Tuple[torch.Tensor, torch.Tensor]:
    """Returns a, b, c [N, 3], by which a + b x + c y is the distance on the ray (x, y, 1), and normals [N, 3].

    Both are in the camera's frame. What lies in the camera's plane has zeros.
    """
    means, scales, cov = inputs["means3D"], inputs.get("scales"), inputs.get("cov3D_precomp")
    view = settings.viewmatrix.to(means)
    centre = means @ view[:3, :3] + view[3, :3]
    towards = centre @ view[:3, :3].T  # from the camera, in the world's frame
    if scales is not None and scales.numel():
        lengths = scales / scales.detach().amin(1, keepdim=True).clamp(min=1e-12)  # its size does not matter
        cov = reference.covariance3D(reference.Gaussians(
            means, None, None, None, None, 1 / lengths, inputs["rotations"], None), 1.0)
        product = (cov @ towards[..., None])[..., 0] @ view[:3, :3]
    else:
        full = cov[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].unflatten(1, (3, 3))
        product = torch.linalg.solve(full, towards[..., None])[..., 0] @ view[:3, :3]
    z = centre[:, 2:]
    is_before = z > 1e-6
    ray = centre[:, :2] / torch.where(is_before, z, 1)
    squared = (product * centre).sum(1, keepdim=True)
    slope = -product[:, :2] * z * z / torch.where(is_before, squared, 1)  # of z
    length = (ray.square().sum(1, keepdim=True) + 1).sqrt()
    slope = slope * length + z * ray / length  # of the distance
    planes = torch.cat([z * length - (slope * ray).sum(1, keepdim=True), slope], 1)
    return planes.masked_fill(~is_before, 0), normalize(-product, dim=1)


GaussianRasterizationSettings, _Rasterizer, rasterize_gaussians = classes_of("rade_gs", __name__, _render)


class GaussianRasterizer(_Rasterizer):
    __doc__ = _Rasterizer.__doc__

    def integrate(self, *_: Any, **__: Any) -> NoReturn:
        """Refuses."""
        raise NotImplementedError("GaussianRasterizer.integrate: this package does not integrate Gaussians over points "
                                  "(mesh_extract_tetrahedra.py); mesh_extract.py needs only depths")
