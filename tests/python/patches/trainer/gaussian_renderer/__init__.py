import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer

from scene.gaussian_model import GaussianModel


def render(viewpoint_camera, pc: GaussianModel, pipe, bg_color: torch.Tensor, scaling_modifier=1.0):
    """One picture of `pc`, with the points on the screen whose gradient densification reads."""
    view, points = viewpoint_camera, torch.zeros_like(pc.get_xyz, requires_grad=torch.is_grad_enabled())
    settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=pc.active_sh_degree, campos=view.camera_center, prefiltered=False,
        debug=pipe.debug
    )
    image, radii = GaussianRasterizer(raster_settings=settings)(
        means3D=pc.get_xyz, means2D=points, shs=pc.get_features, opacities=pc.get_opacity,
        scales=pc.get_scaling, rotations=pc.get_rotation)
    return {"render": image, "viewspace_points": points, "visibility_filter": radii > 0, "radii": radii}
