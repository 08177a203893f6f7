import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from einops import repeat

from scene.gaussian_model import GaussianModel
from utils.encodings import STE_multistep
from utils.screen import points_on_screen


def generate_neural_gaussians(viewpoint_camera, pc: GaussianModel, visible_mask=None, is_training=False, step=0):
    """What the networks make of the visible anchors, of positive opacity."""
    if visible_mask is None:
        visible_mask = torch.ones_like(pc.get_anchor[:, 0], dtype=torch.bool)
    anchor, features = pc.get_anchor[visible_mask], pc._anchor_feat[visible_mask]
    scaling, offsets = pc.get_scaling[visible_mask], pc._offset[visible_mask]
    if is_training and step > 3:
        features = features + 0.01 * (torch.rand_like(features) - 0.5)
    elif not is_training and not pc.decoded_version:
        features = STE_multistep.apply(features, 0.01)

    direction = anchor - viewpoint_camera.camera_center
    distance = direction.norm(dim=1, keepdim=True)
    inputs = torch.cat([features, direction / distance, distance], dim=1)
    neural_opacity = (pc.get_opacity_mlp(inputs) * pc.get_mask[visible_mask][..., 0]).reshape(-1, 1)
    mask = neural_opacity[:, 0] > 0

    per_anchor = repeat(torch.cat([scaling, anchor], dim=1), "n (c) -> (n k) (c)", k=pc.n_offsets)[mask]
    color = pc.get_color_mlp(inputs).view(-1, 3)[mask]
    scale_rot = pc.get_cov_mlp(inputs).view(-1, 7)[mask]
    xyz = per_anchor[:, 6:] + offsets.view(-1, 3)[mask] * per_anchor[:, :3]
    sizes = per_anchor[:, 3:6] * scale_rot[:, :3].sigmoid()
    rot = torch.nn.functional.normalize(scale_rot[:, 3:])
    return xyz, color, neural_opacity[mask], sizes, rot, neural_opacity, mask


def render(viewpoint_camera, pc: GaussianModel, pipe, bg_color: torch.Tensor, scaling_modifier=1.0, visible_mask=None,
           retain_grad=False, step=0):
    """One picture of the neural Gaussians of the visible anchors."""
    is_training = pc.get_color_mlp.training
    xyz, color, opacity, scaling, rot, neural_opacity, mask = generate_neural_gaussians(
        viewpoint_camera, pc, visible_mask, is_training=is_training, step=step)

    view, points = viewpoint_camera, points_on_screen(xyz)
    raster_settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=1, campos=view.camera_center,
        prefiltered=False,
        debug=pipe.debug
    )
    rasterizer = GaussianRasterizer(raster_settings=raster_settings)
    image, radii = rasterizer(means3D=xyz, means2D=points, shs=None, colors_precomp=color, opacities=opacity,
                              scales=scaling, rotations=rot, cov3D_precomp=None)

    result = {"render": image, "viewspace_points": points, "visibility_filter": radii > 0, "radii": radii}
    if is_training:
        result.update(selection_mask=mask, neural_opacity=neural_opacity, scaling=scaling)
    return result


def prefilter_voxel(viewpoint_camera, pc: GaussianModel, pipe, bg_color: torch.Tensor, scaling_modifier=1.0,
                    override_color=None):
    """[N] bool: which anchors the view sees."""
    view = viewpoint_camera
    raster_settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=1, campos=view.camera_center,
        prefiltered=False,
        debug=pipe.debug
    )
    rasterizer = GaussianRasterizer(raster_settings=raster_settings)
    radii_pure = rasterizer.visible_filter(
        means3D=pc.get_anchor, scales=pc.get_scaling[:, :3], rotations=pc.get_rotation, cov3D_precomp=None)
    return radii_pure > 0
