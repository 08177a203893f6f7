import math

from diff_gaussian_rasterization import (
    GaussianRasterizationSettings, GaussianRasterizer,
    GaussianRasterizerIndexed,
)

from scene.gaussian_model import GaussianModel
from utils.screen import points_on_screen, shape_arguments


def render(
    view, pc: GaussianModel, pipe, bg_color, scaling_modifier=1.0, *,
    override_color=None, cov3d=None, clamp_color=True,
):
    """One picture of `pc`, from its codebooks where it has them, or with other covariances."""
    points = points_on_screen(pc.get_xyz)
    settings = GaussianRasterizationSettings(
        image_height=int(view.image_height), image_width=int(view.image_width),
        tanfovx=math.tan(view.FoVx / 2), tanfovy=math.tan(view.FoVy / 2),
        bg=bg_color, scale_modifier=scaling_modifier,
        viewmatrix=view.world_view_transform, projmatrix=view.full_proj_transform,
        sh_degree=pc.active_sh_degree, campos=view.camera_center,
        clamp_color=clamp_color, prefiltered=False,
        debug=pipe.debug,
    )
    if pc.has_codebooks:
        image, radii = GaussianRasterizerIndexed(raster_settings=settings)(
            means3D=pc.get_xyz, means2D=points, shs=pc._get_features_raw, sh_indices=pc._feature_indices,
            g_indices=pc._gaussian_indices, colors_precomp=None, opacities=pc.get_opacity,
            scales=pc.get_scaling_normalized, scale_factors=pc.get_scaling_factor,
            rotations=pc._rotation_post_activation, cov3D_precomp=None,
        )
    else:
        shape = {"scales": None, "rotations": None, "cov3D_precomp": cov3d}
        if cov3d is None:
            shape = shape_arguments(pc, pipe, scaling_modifier)
        image, radii = GaussianRasterizer(raster_settings=settings)(
            means3D=pc.get_xyz, means2D=points, shs=pc.get_features if override_color is None else None,
            colors_precomp=override_color, opacities=pc.get_opacity, scales=shape["scales"],
            rotations=shape["rotations"], cov3D_precomp=shape["cov3D_precomp"],
        )
    return {"render": image, "viewspace_points": points, "visibility_filter": radii > 0, "radii": radii}
