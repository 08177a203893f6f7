import math

import torch
from diff_gaussian_rasterization import (
    GaussianRasterizationSettings, GaussianRasterizer,
    GaussianRasterizerIndexed,
)

from scene.gaussian_model import GaussianModel


def render(
    view, pc: GaussianModel, pipe, bg_color, scaling_modifier=1.0, *,
    override_color=None, cov3d=None, clamp_color=True,
):
    """One picture of `pc`, from its codebooks where it has them, or with other covariances."""
    points = torch.zeros_like(pc.get_xyz, requires_grad=torch.is_grad_enabled())
    settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=pc.active_sh_degree, campos=view.camera_center,
        clamp_color=clamp_color, prefiltered=False,
        debug=pipe.debug,
    )
    if pc.indices is not None:
        colors, shapes = pc.indices
        image, radii = GaussianRasterizerIndexed(raster_settings=settings)(
            means3D=pc.get_xyz, means2D=points, shs=pc.get_features, sh_indices=colors, g_indices=shapes,
            colors_precomp=None, opacities=pc.get_opacity, scales=pc.get_scaling,
            scale_factors=torch.ones_like(pc.get_opacity), rotations=pc.get_rotation, cov3D_precomp=None,
        )
    else:
        shape = pc.shape(pipe) if cov3d is None else {"cov3D_precomp": cov3d}
        image, radii = GaussianRasterizer(raster_settings=settings)(
            means3D=pc.get_xyz, means2D=points, shs=pc.get_features if override_color is None else None,
            colors_precomp=override_color, opacities=pc.get_opacity, **shape,
        )
    return {"render": image, "viewspace_points": points, "visibility_filter": radii > 0, "radii": radii}
