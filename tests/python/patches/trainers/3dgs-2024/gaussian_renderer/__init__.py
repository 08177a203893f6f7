import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer

from scene.gaussian_model import GaussianModel
from utils.screen import points_on_screen, shape_arguments


def render(viewpoint_camera, pc: GaussianModel, pipe, bg_color: torch.Tensor, scaling_modifier=1.0, separate_sh=False,
           override_color=None, use_trained_exp=False):
    """One picture of `pc` and its inverse depth, with the points on the screen whose gradient densification reads."""
    view, points = viewpoint_camera, points_on_screen(pc.get_xyz)
    settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=pc.active_sh_degree, campos=view.camera_center,
        prefiltered=False, debug=pipe.debug,
        antialiasing=pipe.antialiasing)
    rasterizer = GaussianRasterizer(raster_settings=settings)
    shape = shape_arguments(pc, pipe, scaling_modifier)

    if separate_sh:
        image, radii, inverse_depth = rasterizer(
            means3D=pc.get_xyz, means2D=points, dc=pc.get_features_dc, shs=pc.get_features_rest,
            colors_precomp=override_color, opacities=pc.get_opacity, scales=shape["scales"],
            rotations=shape["rotations"], cov3D_precomp=shape["cov3D_precomp"])
    else:
        image, radii, inverse_depth = rasterizer(
            means3D=pc.get_xyz, means2D=points, shs=pc.get_features if override_color is None else None,
            colors_precomp=override_color, opacities=pc.get_opacity, scales=shape["scales"],
            rotations=shape["rotations"], cov3D_precomp=shape["cov3D_precomp"])

    if use_trained_exp:
        exposure = pc.get_exposure_from_name(view.image_name)
        image = torch.einsum("chw,dc->dhw", image, exposure[:, :3]) + exposure[:, 3:, None]
    return {"render": image.clamp(0, 1), "viewspace_points": points, "visibility_filter": (radii > 0).nonzero(),
            "radii": radii, "depth": inverse_depth}
