import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer

from scene.gaussian_model import GaussianModel


def render(viewpoint_camera, pc: GaussianModel, pipe, bg_color: torch.Tensor, scaling_modifier=1.0,
           override_color=None, pixel_weights=None):
    """One picture of `pc`, and what pixel_weights [H, W] and the blending add up to for every Gaussian."""
    view, points = viewpoint_camera, torch.zeros_like(pc.get_xyz, requires_grad=torch.is_grad_enabled())
    settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=pc.active_sh_degree, campos=view.camera_center,
        prefiltered=False, debug=pipe.debug, pixel_weights=pixel_weights)
    rasterizer = GaussianRasterizer(raster_settings=settings)
    (image, radii, counts, lists, lists_render, lists_distance, centers, depths, own_radii, weights, count, blend,
     distance) = rasterizer(
        means3D=pc.get_xyz, means2D=points, dc=pc.get_features_dc, shs=pc.get_features_rest,
        colors_precomp=override_color, opacities=pc.get_opacity, **pc.shape(pipe))
    return {"render": image, "viewspace_points": points, "visibility_filter": (radii > 0).nonzero(), "radii": radii,
            "gaussian_depths": depths, "gaussian_radii": own_radii, "accum_weights": weights, "accum_count": count,
            "accum_blend": blend, "accum_dist": distance}
