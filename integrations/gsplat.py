"""gsplat's call `rasterization`, for code written for gsplat or nerfstudio: cameras in a batch, channels last."""
from __future__ import annotations

from typing import Any, Dict, Optional, Tuple

import numpy as np
import torch
import torch.nn.functional as functional

from diff_smoe_rasterization import (
    GaussianRasterizationSettings,
    project_gaussians,
    rasterize,
    reference,
    visible_radii,
)
from diff_smoe_rasterization.camera import clip_matrix
from diff_smoe_rasterization.checks import checked_number
from diff_smoe_rasterization.gaussians import divided
from diff_smoe_rasterization.settings import BackgroundGate

from ._rasterizer import share_of_gaussians
from .contracts import OF_LATER_GSPLAT

__all__ = ["compute_relocation", "quat_scale_to_covar_preci", "rasterization"]

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
EVERYTHING_NEARER = 1e10  # the far_plane that leaves nothing out
CAMERA_MODELS = {"pinhole": "pinhole", "ortho": "orthographic", "fisheye": "fisheye"}
ROLLING_SHUTTERS = ("ROLLING_TOP_TO_BOTTOM", "ROLLING_LEFT_TO_RIGHT", "ROLLING_BOTTOM_TO_TOP", "ROLLING_RIGHT_TO_LEFT",
                    "GLOBAL")
"""The names of gsplat's RollingShutterType by their numbers."""


def rasterization(means: torch.Tensor, quats: Optional[torch.Tensor], scales: Optional[torch.Tensor],
                  opacities: torch.Tensor, colors: Optional[torch.Tensor], viewmats: torch.Tensor, Ks: torch.Tensor,
                  width: int, height: int, near_plane: float = 0.01, far_plane: float = EVERYTHING_NEARER,
                  radius_clip: float = 0.0,
                  eps2d: float = 0.3, sh_degree: Optional[int] = None, packed: bool = False,
                  tile_size: Optional[int] = None, backgrounds: Optional[torch.Tensor] = None, render_mode: str = "RGB",
                  sparse_grad: bool = False, absgrad: bool = False, rasterize_mode: str = "classic",
                  channel_chunk: int = 32, distributed: bool = False, camera_model: str = "pinhole",
                  segmented: bool = False, covars: Optional[torch.Tensor] = None, blend_mode: Optional[str] = None,
                  background_gate: Optional[BackgroundGate] = None, faint_below: Optional[float] = None,
                  radial_coeffs: Optional[torch.Tensor] = None, tangential_coeffs: Optional[torch.Tensor] = None,
                  thin_prism_coeffs: Optional[torch.Tensor] = None, rolling_shutter: Any = None,
                  viewmats_rs: Optional[torch.Tensor] = None,
                  **others: Any) -> Tuple[torch.Tensor, torch.Tensor, Dict[str, Any]]:
    """Renders N Gaussians with C cameras.

    Args:
        means: [N, 3] centres, world.
        quats, scales: [N, 4] quaternions w, x, y, z of any length, and [N, 3] standard deviations.
        opacities: [N].
        colors: [N, D] or [C, N, D]; if sh_degree is given harmonics [N, K, 3] or [C, N, K, 3].
        viewmats: [C, 4, 4] world to camera, for column vectors; differentiable.
        Ks: [C, 3, 3] focal lengths and principal points in pixels, without skew; they get no gradient and are read by
            the host, which on a GPU waits for them.
            colors may be None if render_mode has no RGB.
        near_plane, far_plane: Gaussians with view depth <= near_plane or > far_plane are culled.
        eps2d: what is added to the variances on the image, square pixels.
        radius_clip: Gaussians with a radius <= radius_clip, in pixels, are culled.
        packed: meta is that of gsplat's packed mode. What is computed, and its memory, is the same.
        absgrad: means2d also gets the attribute `absgrad`: the sum over pixels of its absolute gradients.
        backgrounds: [C, D]; None is black. The background of a depth is 0.
        render_mode: "RGB", and ED for the depth sum(w z) / sum(w) or D for that times alphas, as the only or the last
            channel.
        rasterize_mode: "classic" or "antialiased".
        covars: [N, 3, 3] in place of quats and scales, which are then ignored.
        camera_model: "pinhole", "ortho" (Ks has pixels by unit of length) or "fisheye". Of a fisheye depths are
            distances, for near_plane and far_plane too.
        radial_coeffs: [C, 6] k1 to k6 of a pinhole, or [C, 4] k1 to k4 of a fisheye. tangential_coeffs: [C, 2] p1, p2,
            and thin_prism_coeffs: [C, 4] s1 to s4, of a pinhole. The host reads all. The footprint is that of the
            affine approximation, not gsplat's unscented transform.
        rolling_shutter: gsplat's RollingShutterType, or its number; None: GLOBAL.
        viewmats_rs: [C, 4, 4] at the last row or column, where viewmats is at the first; differentiable. Matrices are
            mixed linearly between them.
        blend_mode: one of BLEND_MODES; None: $DSMOE_BLEND_MODE, else "alpha".
        background_gate: `smoe` and `smoe_eq7`: how much the background weighs, a number or a tensor of one element,
            which gets a gradient; None: $DSMOE_BACKGROUND_GATE, else 0.
        faint_below: as in GaussianRasterizationSettings.
        tile_size, channel_chunk, segmented: taken and without effect, as they change no image.

    Returns:
        renders: [C, H, W, X], X = D, 1 or D + 1 by render_mode.
        alphas: [C, H, W, 1], the share of the pixel that the background does not have, by which callers composite:
            sum(w) in `alpha`, W / (W + B + lambda T) in `smoe`. In the others without a background gate, 1 wherever a
            gate is open.
        meta: means2d [C, N, 2], pixels, which receives the gradient of the images by them (also in pixels) and passes
            none on; radii [C, N, 2] int32, 3 sigma of the longer axis twice, 0 if not seen; depths [C, N]; width,
            height, n_cameras, n_batches; batch_ids, camera_ids and gaussian_ids are None. With `packed` means2d,
            radii and depths have a row for each Gaussian that a camera sees, [M, 2], [M, 2] and [M], and the three
            ids [M] say which.

    Raises:
        NotImplementedError: what is asked for is not offered: sparse_grad, distributed, other cameras, tangential and
            prism coefficients of a fisheye, other arguments of later versions of gsplat but with the values that
            switch them off.
        ValueError, TypeError: arguments do not fit.
    """
    _refuse_what_is_not_offered(others, sparse_grad=(sparse_grad, False), distributed=(distributed, False))
    if camera_model not in CAMERA_MODELS:
        raise NotImplementedError(f"rasterization: camera_model is {camera_model!r}; this module offers "
                                  f"{', '.join(CAMERA_MODELS)}")
    for name, size in (("width", width), ("height", height)):
        if not isinstance(size, (int, np.integer)) or size < 1:
            raise ValueError(f"rasterization: {name} is {size!r}; it must be a whole number of pixels, 1 or more")
    far_plane, radius_clip = checked_number("rasterization", "far_plane", far_plane), checked_number(
        "rasterization", "radius_clip", radius_clip)
    _check_choice("render_mode", render_mode, RENDER_MODES)
    _check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    _check_shape("means", means, (-1, 3))
    _check_shape("viewmats", viewmats, (-1, 4, 4))
    count, num_cameras = len(means), len(viewmats)
    if num_cameras == 0:
        raise ValueError("rasterization: viewmats has shape [0, 4, 4]; there must be a camera")
    if viewmats.dtype != means.dtype:
        raise TypeError(f"rasterization: viewmats is {viewmats.dtype}; it must be {means.dtype}, as means is")
    _check_shape("Ks", Ks, (num_cameras, 3, 3))
    _check_shape("opacities", opacities, (count,))
    with_color, with_depth = "RGB" in render_mode, "D" in render_mode
    color_name, color_shape = ("colors_precomp", (count, -1)) if sh_degree is None else ("shs", (count, -1, 3))
    if with_color or colors is not None:
        _check_shape("colors", colors, color_shape, (num_cameras,) + color_shape)
    if not with_color:  # a depth has no use for them
        color_name, color_shape, colors, backgrounds = "colors_precomp", (count, 1), means.new_zeros(count, 1), None
    channels = colors.shape[-1]
    if backgrounds is None:
        backgrounds = means.new_zeros(num_cameras, channels)
    _check_shape("backgrounds", backgrounds, (num_cameras, channels))
    shape = _shape(quats, scales, covars, count)

    model, distortions = _distortions(camera_model, num_cameras, radial_coeffs, tangential_coeffs, thin_prism_coeffs)
    shutter = _shutter(rolling_shutter, viewmats_rs, viewmats)
    rolls = shutter != "global"
    differentiable = [means, opacities, colors, viewmats, backgrounds, *shape.values()] + [viewmats_rs] * rolls
    with_gradient = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in differentiable)
    projections = viewmats.transpose(1, 2) @ clip_matrix(Ks.detach(), width, height).transpose(1, 2).contiguous()
    centres = torch.inverse(viewmats)[:, :3, 3]
    if rolls:
        centres = (centres + torch.inverse(viewmats_rs)[:, :3, 3]) / 2
    intrinsics = Ks[:, :2].tolist()
    all_settings = [GaussianRasterizationSettings(
        image_height=height, image_width=width, tanfovx=width / (2 * focal_x), tanfovy=height / (2 * focal_y),
        bg=backgrounds[camera], scale_modifier=1.0, viewmatrix=viewmats[camera].T, projmatrix=projections[camera],
        sh_degree=sh_degree or 0, campos=centres[camera], antialiasing=rasterize_mode == "antialiased",
        near=near_plane, blend_mode=blend_mode, background_gate=background_gate, low_pass=eps2d,
        faint_below=faint_below, camera_model=model, distortion=distortions[camera],
        principal_point=None if model == "pinhole" and not rolls else (center_x, center_y),
        rolling_shutter=shutter, viewmatrix_end=viewmats_rs[camera].T if rolls else None)
        for camera, ((focal_x, _, center_x), (_, focal_y, center_y)) in enumerate(intrinsics)]
    if rolls:
        means2d, depths = _rolling_points(means, shape, all_settings)
    else:
        means2d, depths = _image_points(means, viewmats, Ks, all_settings)
    clips = far_plane < EVERYTHING_NEARER or radius_clip > 0
    if packed or clips:  # else the radii come with the images
        seen = torch.stack([visible_radii(means, settings, **shape) for settings in all_settings])
        seen = seen.masked_fill((depths > far_plane) | (seen <= radius_clip), 0) if clips else seen
    ids = seen.nonzero(as_tuple=True) if packed else None
    means2d = _Points(means2d if ids is None else means2d[ids], ids, depths.shape, (width, height),
                      with_gradient, absgrad)
    renders, alphas, radii = [], [], []
    for camera, settings in enumerate(all_settings):
        color = colors[camera] if colors.dim() > len(color_shape) else colors
        rendering = rasterize(means, opacities.where(seen[camera] > 0, opacities.new_zeros(())) if clips else opacities,
                              settings, outputs=("alpha", "depth") if with_depth else ("alpha",),
                              **means2d.of_camera(camera), **{color_name: color}, **shape)
        images, share = [rendering.color] if with_color else [], share_of_gaussians(rendering.alpha, settings)
        if with_depth:
            images.append(rendering.depth if "ED" in render_mode else rendering.depth * share)
        renders.append(torch.cat(images).permute(1, 2, 0))
        alphas.append(share.permute(1, 2, 0))
        radii.append(rendering.radii)
    radii = seen if clips else torch.stack(radii)
    meta = {"means2d": means2d.points, "radii": (radii if ids is None else radii[ids])[..., None].expand(
                *radii.shape if ids is None else ids[0].shape, 2).contiguous(),
            "depths": depths if ids is None else depths[ids], "width": width, "height": height,
            "n_cameras": num_cameras, "n_batches": 1, "batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    if ids is not None:
        meta.update(batch_ids=torch.zeros_like(ids[0]), camera_ids=ids[0], gaussian_ids=ids[1])
    return torch.stack(renders), torch.stack(alphas), meta


def _shape(quats, scales, covars, count):
    """Returns the arguments of `rasterize` that say how the Gaussians extend."""
    if covars is not None:
        _check_shape("covars", covars, (count, 3, 3))
        return {"cov3D_precomp": covars[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]}
    _check_shape("quats", quats, (count, 4))
    _check_shape("scales", scales, (count, 3))
    return {"scales": scales, "rotations": functional.normalize(quats, dim=1)}


def _distortions(camera_model, num_cameras, radial, tangential, thin_prism):
    """Returns the camera model of the settings and the distortion of each camera."""
    given = {"radial_coeffs": radial, "tangential_coeffs": tangential, "thin_prism_coeffs": thin_prism}
    counts = {"pinhole": (6, 2, 4), "fisheye": (4, 0, 0), "ortho": (0, 0, 0)}[camera_model]
    columns = []
    for (name, value), count in zip(given.items(), counts):
        if value is not None and count == 0:
            raise NotImplementedError(f"rasterization: {name} is given; camera_model {camera_model!r} has none here")
        if value is not None:
            _check_shape(name, value, (num_cameras, count))
        columns.append([[0.0] * count] * num_cameras if value is None else value.tolist())
    if all(value is None for value in given.values()):
        return CAMERA_MODELS[camera_model], [()] * num_cameras
    if camera_model == "fisheye":
        return "fisheye", [tuple(k) for k in columns[0]]
    return "opencv", [(*k[:2], *p, *k[2:], *s) for k, p, s in zip(*columns)]


def _shutter(given, viewmats_rs, viewmats):
    """Returns the shutter's name in the settings."""
    name = "GLOBAL" if given is None else getattr(given, "name", given)
    if isinstance(name, int) and not isinstance(name, bool) and 0 <= name < len(ROLLING_SHUTTERS):
        name = ROLLING_SHUTTERS[name]
    _check_choice("rolling_shutter", name, ROLLING_SHUTTERS)
    if (name == "GLOBAL") != (viewmats_rs is None):
        raise ValueError(f"rasterization: viewmats_rs is {'None' if viewmats_rs is None else 'given'}, but "
                         f"rolling_shutter is {name}; it must be {'None' if name == 'GLOBAL' else 'given'}")
    if viewmats_rs is not None:
        _check_shape("viewmats_rs", viewmats_rs, tuple(viewmats.shape))
        if viewmats_rs.dtype != viewmats.dtype:
            raise TypeError(f"rasterization: viewmats_rs is {viewmats_rs.dtype}; it must be {viewmats.dtype}, as "
                            "viewmats is")
        if viewmats_rs.device != viewmats.device:
            raise TypeError(f"rasterization: viewmats_rs is on {viewmats_rs.device}; it must be on {viewmats.device}, "
                            "as viewmats is")
    return name.lower().replace("rolling_", "")


@torch.no_grad()
def _rolling_points(means, shape, all_settings):
    """Returns what `_image_points` does, zeros of Gaussians that a camera does not see."""
    nothing = means.new_zeros(len(means), 1)
    prints = [project_gaussians(means, nothing, settings._replace(bg=nothing.new_zeros(1)), colors_precomp=nothing,
                                **shape) for settings in all_settings]
    unseen = torch.stack([each.radii == 0 for each in prints])
    return (torch.stack([each.means2D + 0.5 for each in prints]).masked_fill(unseen[..., None], 0),
            torch.stack([each.depths for each in prints]).masked_fill(unseen, 0))


@torch.no_grad()
def _image_points(means, viewmats, Ks, all_settings):
    """Returns the centres on the images [C, N, 2] in pixels, detached, and their depths [C, N].

    The centre of the first pixel is at (0.5, 0.5), as gsplat has it.
    """
    in_view = means @ viewmats[:, :3, :3].transpose(1, 2) + viewmats[:, None, :3, 3]
    if all_settings[0].camera_model != "pinhole":
        points, depths = zip(*(reference.positions_and_depths(view, settings)
                               for view, settings in zip(in_view, all_settings)))
        return torch.stack(points) + 0.5, torch.stack(depths)
    depths = in_view[..., 2]
    focal_lengths, principal_points = Ks[:, None, (0, 1), (0, 1)], Ks[:, None, :2, 2]
    return focal_lengths * in_view[..., :2] / depths[..., None] + principal_points, depths


class _Points:
    """meta["means2d"], and what of it goes into the rendering of each camera, so that the gradients come back to it.

    points: [C, N, 2], or [M, 2] if ids, two tensors [M], say which cameras and Gaussians; pixels. shape: (C, N).
    """

    def __init__(self, points, ids, shape, size, with_gradient, absgrad):
        self.points = points.requires_grad_(with_gradient)
        self.ids, self.shape, self.to_ndc = ids, shape, points.new_tensor([2 / size[0], 2 / size[1]])
        self.signed = self._of_all(self.points) if with_gradient else None
        self.absolute = None
        if with_gradient and absgrad:
            leaf = torch.zeros_like(points).requires_grad_()
            leaf.register_hook(lambda gradient: setattr(self.points, "absgrad", gradient))
            self.absolute = self._of_all(leaf)

    def of_camera(self, camera):
        """Returns the arguments means2D and means2D_abs of `rasterize`."""
        signed = None if self.signed is None else functional.pad(self.signed[camera], (0, 1))
        return {"means2D": signed, "means2D_abs": None if self.absolute is None else self.absolute[camera]}

    def _of_all(self, values):
        """Returns them for all Gaussians, so scaled that a gradient by pixels comes back."""
        values = values * self.to_ndc
        if self.ids is None:
            return values
        return values.new_zeros(*self.shape, 2).index_put(self.ids, values)


def compute_relocation(opacities: torch.Tensor, scales: torch.Tensor, ratios: torch.Tensor, binoms: torch.Tensor,
                       min_opacity: float = 0.0) -> Tuple[torch.Tensor, torch.Tensor]:
    """Opacities [N] and scales [N, 3] of Gaussians that n equal ones in one place take over (Eq. 9 of 3DGS-MCMC).

    opacities: [N]. scales: [N, 3]. ratios: [N] n, which is clamped in place to [1, n_max], as gsplat does. binoms:
    [n_max, n_max]; only its size is read. min_opacity: the smallest new opacity.
    """
    ratios.clamp_(min=1, max=len(binoms))
    new_opacities, factors = divided(opacities, ratios, min_opacity)
    return new_opacities, factors[:, None] * scales


def quat_scale_to_covar_preci(quats: torch.Tensor, scales: torch.Tensor, compute_covar: bool = True,
                              compute_preci: bool = True, triu: bool = False
                              ) -> Tuple[Optional[torch.Tensor], Optional[torch.Tensor]]:
    """Covariances R S^2 R^T and their inverses [N, 3, 3], as gsplat's strategies ask for them; None: not asked for.

    quats: [N, 4] of any length. scales: [N, 3]. triu: as [N, 6], xx, xy, xz, yy, yz, zz.
    """
    rotations = functional.normalize(quats, dim=-1)

    def product(lengths):
        made = reference.covariance3D(
            reference.Gaussians(lengths, None, None, None, None, lengths, rotations, None), 1.0)
        return made[..., (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)] if triu else made

    return product(scales) if compute_covar else None, product(1 / scales) if compute_preci else None


def _refuse_what_is_not_offered(others, **arguments):
    for name, (value, only) in arguments.items():
        if value != only:
            raise NotImplementedError(f"rasterization: {name} is {value!r}; this module offers only {only!r}")
    for name, value in others.items():
        if name not in OF_LATER_GSPLAT:
            raise TypeError(f"rasterization: there is no argument {name}")
        if value is not None and value is not OF_LATER_GSPLAT[name]:
            raise NotImplementedError(f"rasterization: {name} is {value!r}; this module does not offer it")


def _check_choice(name, value, choices):
    if value not in choices:
        raise ValueError(f"rasterization: {name} is {value!r}; it must be one of {', '.join(choices)}")


def _check_shape(name, tensor, *allowed):
    """Raises unless the tensor has one of the allowed shapes; -1 is any size."""
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"rasterization: {name} is of type {type(tensor).__name__}; it must be a torch.Tensor")
    for shape in allowed:
        if tensor.dim() == len(shape) and all(want in (-1, size) for size, want in zip(tensor.shape, shape)):
            return
    wanted = " or ".join(str(["*" if size == -1 else size for size in shape]).replace("'", "") for shape in allowed)
    raise ValueError(f"rasterization: {name} has shape {list(tensor.shape)}; it must be {wanted}")
