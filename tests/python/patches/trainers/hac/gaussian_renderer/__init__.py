import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from einops import repeat

from scene.gaussian_model import GaussianModel


def render(view, pc: GaussianModel, pipe, bg_color, scaling_modifier=1.0, visible_mask=None):
    """One picture of the neural Gaussians of the visible anchors."""
    features, sizes, anchors, offsets = (rows[visible_mask] for rows in (
        pc._features, pc.get_scaling, pc.get_anchor, pc._offset))
    made = pc.network(features).view(-1, 11)
    neural_opacity = made[:, :1].tanh()
    mask = neural_opacity[:, 0] > 0
    made, places = made[mask], repeat(torch.cat([sizes, anchors], dim=1), "n (c) -> (n k) (c)", k=pc.n_offsets)[mask]
    xyz = places[:, 3:] + offsets.view(-1, 3)[mask] * places[:, :3]
    points = torch.zeros_like(xyz, requires_grad=torch.is_grad_enabled())

    settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=1, campos=view.camera_center, prefiltered=False,
        debug=pipe.debug
    )
    image, radii = GaussianRasterizer(settings)(
        means3D=xyz, means2D=points, shs=None, colors_precomp=made[:, 1:4].sigmoid(), opacities=neural_opacity[mask],
        scales=places[:, :3] * made[:, 4:7].sigmoid(), rotations=torch.nn.functional.normalize(made[:, 7:]),
        cov3D_precomp=None)
    return {"render": image, "viewspace_points": points, "visibility_filter": radii > 0, "radii": radii}


def prefilter_voxel(view, pc: GaussianModel, pipe, bg_color, scaling_modifier=1.0):
    """[N] bool: which anchors the view sees."""
    settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=1, campos=view.camera_center, prefiltered=False,
        debug=pipe.debug
    )
    radii = GaussianRasterizer(settings).visible_filter(
        cov3D_precomp=None, rotations=pc.get_rotation, scales=pc.get_scaling, means3D=pc.get_anchor)
    return radii.bool()
