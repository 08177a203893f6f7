import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from einops import repeat

from scene.gaussian_model import GaussianModel
from utils.encodings import Stepped
from utils.screen import points_on_screen


def gaussians_of_anchors(pc: GaussianModel, center, visible_mask, step):
    """What the networks make of the visible anchors, of positive opacity."""
    if visible_mask is None:
        visible_mask = torch.ones_like(pc.get_anchor[:, 0], dtype=torch.bool)
    anchor, features = pc.get_anchor[visible_mask], pc._anchor_feat[visible_mask]
    scaling, offsets = pc.get_scaling[visible_mask], pc._offset[visible_mask]
    if pc.learns and step > 3:
        features = features + 0.01 * (torch.rand_like(features) - 0.5)
    elif not pc.learns and not pc.decoded:
        features = Stepped.apply(features, 0.01)

    direction = anchor - center
    distance = direction.norm(dim=1, keepdim=True)
    inputs = torch.cat([features, direction / distance, distance], dim=1)
    neural_opacity = pc.get_opacity_mlp(inputs).reshape(-1, 1)
    mask = neural_opacity[:, 0] > 0

    per_anchor = repeat(torch.cat([scaling, anchor], dim=1), "n (c) -> (n k) (c)", k=pc.n_offsets)[mask]
    color = pc.get_color_mlp(inputs).view(-1, 3)[mask]
    scale_rot = pc.get_cov_mlp(inputs).view(-1, 7)[mask]
    xyz = per_anchor[:, 6:] + offsets.view(-1, 3)[mask] * per_anchor[:, :3]
    sizes = per_anchor[:, 3:6] * scale_rot[:, :3].sigmoid()
    rot = torch.nn.functional.normalize(scale_rot[:, 3:])
    kept = pc.get_mask[visible_mask].view(-1, 1)[mask]
    return xyz, color, neural_opacity[mask] * kept, sizes * kept, rot, neural_opacity, mask


def render(view, pc: GaussianModel, pipe, bg_color, scaling_modifier=1.0, visible_mask=None, step=0):
    """One picture of the neural Gaussians of the visible anchors."""
    xyz, color, opacity, scaling, rot, neural_opacity, mask = gaussians_of_anchors(
        pc, view.camera_center, visible_mask, step)
    points = points_on_screen(xyz)

    settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=1, campos=view.camera_center, prefiltered=False,
        debug=pipe.debug
    )
    image, radii = GaussianRasterizer(settings)(
        means3D=xyz, means2D=points, shs=None, colors_precomp=color, opacities=opacity, scales=scaling, rotations=rot,
        cov3D_precomp=None)

    result = {"render": image, "viewspace_points": points, "visibility_filter": radii > 0, "radii": radii}
    if pc.learns:
        result.update(selection_mask=mask, neural_opacity=neural_opacity, scaling=scaling)
    return result


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
        cov3D_precomp=None, rotations=pc.get_rotation, scales=pc.get_scaling[:, :3], means3D=pc.get_anchor)
    return radii.bool()
