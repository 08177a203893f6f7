"""The rasterizer written as its own specification: plain torch, formula after formula, gradients by autograd.

It is slow, runs in float32 and float64, imports no extension and shares no constant with the C++ core, so that the
core can be tested against it. Equation numbers are those of "3D SMoE Splatting for Edge-aware Realtime Radiance Field
Rendering". Read it in this order: `rasterize`, `project`, `pair_counts`, `wide_pixels`, `pair_alphas`,
`blend`.

What the paper leaves open is decided here:

- Gaussians are sorted by view depth; equal depths keep the order of the input.
- A Gaussian is culled (radius 0, gradients exactly 0) if any value of its attributes, used or not, is NaN or
  infinite, its opacity is above 1e20, its view depth is not beyond `near`, its projected covariance is not positive
  definite, its pixel position, conic or colour is not finite, or its footprint misses the image.
- A Gaussian at `campos` has no view direction: its harmonics above degree 0 are 0, and so are their derivatives.
- With a camera model other than "pinhole", a Gaussian beyond its lens's range is culled too: see `lens_points`. With a
  rolling shutter, so is one that moves about as fast as it, or is never where it reads: see `rolling_points`.
- Opacity plays no other part in culling and none in the radius; pairs with opacity <= 0 do not count.
- Thresholds are float32 values in every scalar type: (1 - 0.99f)^2 < 1e-4f stops a pixel, the same in double does not.
- `smoe` cuts pairs as the paper's authors do, `smoe_eq7` as the paper's text says: see `pair_counts`, `tail_sum`.
- If the near pairs of a pixel cover it, `smoe` blends no others, and `smoe_eq7` on request: see `wide_pixels`.
- The background of a pixel without a gate (gate sum under 1e-30) replaces its colour in the SMoE modes.
- In `smoe_eq7` a background gate that is the number 1 is the mode `alpha`, with its tile rectangle and its cut; a
  tensor of value 1 keeps the footprints. If the background has a gate, opacity cuts pairs too: see `pair_counts`.
- The value of `means2D` is ignored; it only receives a gradient.
"""
from __future__ import annotations

import math
from typing import NamedTuple, Optional, Sequence, Tuple

import numpy as np
import torch
from torch.utils.checkpoint import checkpoint

from .settings import (
    OUTPUTS,
    Contributions,
    GaussianRasterizationSettings,
    Importance,
    Rendering,
    leaves_out_faint,
    resolve_blend,
    resolve_faint_below,
)


def _float32(value):
    return torch.tensor(value, dtype=torch.float32).item()


COMPENSATION_MIN = _float32(2.5e-5)  # least square of the antialiasing factor (3DGS of 2024)
FRUSTUM_MARGIN = 1.3  # the Jacobian is taken at most this many tan(fov) off axis, if it still fits (3DGS)
W_EPSILON = 1e-7  # added to the clip w before dividing (3DGS)
EIGENVALUE_SPREAD_MIN = _float32(0.1)  # px^4 under the root of the radius rule (3DGS)
TILE = 16  # px; the tiles of 3DGS, whose rectangle is part of its image
ALPHA_MAX = _float32(0.99)  # no Gaussian is opaque, else T would reach 0 (3DGS)
OPACITY_MAX = _float32(1e20)  # beyond, gradients by a place overflow in float32
ALPHA_MIN = _float32(1 / 255)  # less changes no 8-bit image (3DGS)
STRONG_MIN = _float32(1 / 2040)  # `smoe`: pairs of at least this alpha are blended; weaker ones are tails (authors)
CORE_MIN = _float32(1 / 1020)  # `smoe`: within 3 sigma, pairs of less alpha are faint
TAIL_MIN = _float32(1 / 2040 / 255)  # `smoe`: weaker tails change no 8-bit image, as STRONG_MIN is the least sum there
EVERY_TAIL_MIN = 2.0**-35  # the same if all pixels have all pairs: half a float32 unit of STRONG_MIN
KERNEL_MIN = _float32(1e-5)  # other SMoE modes cut on G: faint pairs decide where gates are weak (paper's text)
KERNEL_KEPT = _float32(math.exp(-4.5))  # G at 3 sigma: nearer, a background gate cuts nothing, or gradients would end
TRANSMITTANCE_MIN = _float32(1e-4)  # a pixel this dark behind what it has is finished (3DGS)
GATE_SUM_MIN = _float32(1e-30)  # under this, and only then, a sum of gates is none; far above float32's smallest number
BLOCK = 32  # px; pixels are processed in squares of this side, only for speed


class Gaussians(NamedTuple):
    """The inputs, one row a Gaussian; an input that was not given is None."""

    means3D: torch.Tensor  # [N, 3] world
    means2D: torch.Tensor  # [N, 3] zeros that receive the gradient in normalised device coordinates
    opacities: torch.Tensor  # [N]
    shs: Optional[torch.Tensor]  # [N, K, 3]
    colors_precomp: Optional[torch.Tensor]  # [N, C]
    scales: Optional[torch.Tensor]  # [N, 3] standard deviations, world
    rotations: Optional[torch.Tensor]  # [N, 4] quaternions w, x, y, z
    cov3D_precomp: Optional[torch.Tensor]  # [N, 6] xx, xy, xz, yy, yz, zz


class Splats(NamedTuple):
    """Projected Gaussians, one row each."""

    position: torch.Tensor  # [n, 2] px; the centre of pixel (0, 0) is at (0, 0)
    depth: torch.Tensor  # [n] view z; the distance from the camera if the lens sees around
    covariance: torch.Tensor  # [n, 3] px^2: xx, xy, yy, low-pass included
    conic: torch.Tensor  # [n, 3] 1/px^2: the inverse of it
    opacity: torch.Tensor  # [n] compensated if antialiasing
    color: torch.Tensor  # [n, C]


def _rows(table, index):
    return type(table)(*(None if column is None else column[index] for column in table))


_Absent = Optional[torch.Tensor]


def rasterize(means3D: torch.Tensor, opacities: torch.Tensor, settings: GaussianRasterizationSettings,
              means2D: _Absent = None, dc: _Absent = None, shs: _Absent = None, colors_precomp: _Absent = None,
              scales: _Absent = None, rotations: _Absent = None, cov3D_precomp: _Absent = None,
              outputs: Sequence[str] = ()) -> Rendering:
    """Renders Gaussians; the arguments, shapes and results of `diff_smoe_rasterization.rasterize`.

    Args:
        means3D: [N, 3] centres, world.
        opacities: [N, 1] or [N]; may exceed 1, up to 1e20.
        settings: GaussianRasterizationSettings; viewmatrix, viewmatrix_end, projmatrix, campos, bg and a tensor
            background_gate are differentiable.
        means2D: [N, 3]; its gradient is dL/d(pixel) times (0.5 width, 0.5 height), z = 0.
        dc, shs: [N, 1, 3] and [N, K - 1, 3], or only shs [N, K, 3]; K >= (sh_degree + 1)^2.
        colors_precomp: [N, C] instead of dc and shs.
        scales, rotations: [N, 3] and [N, 4]; quaternions w, x, y, z are used as given.
        cov3D_precomp: [N, 6] xx, xy, xz, yy, yz, zz, instead of scales and rotations.
        outputs: names from OUTPUTS, the optional images to return.
    All tensors have the type of means3D, float32 or float64. None or a tensor of shape [0] is an absent input.

    Returns: Rendering.
    Raises ValueError for both or neither of shs and colors_precomp, of scales with rotations and cov3D_precomp; for an
    unknown output or blend mode, for a background gate that the mode does not know; under `strict` for a value that is
    not finite; under `prefiltered` for a Gaussian that is not beyond `near`.
    """
    mode, gate = mode_and_gate(settings)
    if not set(outputs) <= set(OUTPUTS):
        raise ValueError(f"rasterize: outputs is {tuple(outputs)}; it may hold {', '.join(OUTPUTS)}")
    gaussians = _gather(means3D, means2D, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
    with torch.no_grad():
        radii, order = visible(gaussians, settings, mode)
    splats = project(_rows(gaussians, order), settings)
    image = _render_blocks(splats, settings, mode, gate)
    channels = settings.bg.shape[0]
    images = dict(zip(OUTPUTS, image[channels:].split(1)))
    return Rendering(image[:channels], radii, **{name: images[name] for name in outputs})


def contributions(means3D: torch.Tensor, opacities: torch.Tensor, settings: GaussianRasterizationSettings,
                  pixel_weights: torch.Tensor, dc: _Absent = None, shs: _Absent = None, colors_precomp: _Absent = None,
                  scales: _Absent = None, rotations: _Absent = None,
                  cov3D_precomp: _Absent = None) -> Tuple[torch.Tensor, torch.Tensor, Contributions]:
    """Scores Gaussians by their pixels; what `diff_smoe_rasterization.Splats` returns, without gradients.

    pixel_weights: [height, width]. The others are the arguments of `rasterize`.
    Returns: centres [N, 2] in pixels, depths [N], Contributions. Culled Gaussians have 0.
    """
    with torch.no_grad():
        mode, gate = mode_and_gate(settings)
        gaussians = _gather(means3D, None, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
        order = visible(gaussians, settings, mode)[1]
        splats = project(_rows(gaussians, order), settings)
        sums = splats.depth.new_zeros(4, len(order))
        for y in range(settings.image_height):
            columns = torch.arange(settings.image_width).to(splats.depth)
            row = torch.full_like(columns, y)
            counts, _ = blended_pairs(splats, columns, row, settings, mode, gate)
            weight, stopped = numerator(pair_alphas(splats, columns, row, counts), mode)
            blended = counts & ~stopped
            distance = torch.hypot(columns - splats.position[:, :1], row - splats.position[:, 1:])
            for total, values in zip(sums, (pixel_weights[y].expand_as(weight), torch.ones_like(weight), weight,
                                            distance)):
                total += values.masked_fill(~blended, 0).sum(1)

    def of_all(values):
        return values.new_zeros((len(means3D),) + values.shape[1:]).index_copy(0, order, values)

    scores = [of_all(total) for total in sums]
    scores[1] = scores[1].to(torch.int32)
    return of_all(splats.position), of_all(splats.depth), Contributions(*scores)


def importance(means3D: torch.Tensor, opacities: torch.Tensor, settings: GaussianRasterizationSettings,
               pixel_weights: torch.Tensor, share_weights: torch.Tensor, dc: _Absent = None, shs: _Absent = None,
               colors_precomp: _Absent = None, scales: _Absent = None, rotations: _Absent = None,
               cov3D_precomp: _Absent = None) -> Importance:
    """What each Gaussian is worth to the image: each is left out, and the image blended again without it.

    The sum of a pixel's tails stays, as in the gradients of `smoe`.
    pixel_weights, share_weights: [height, width]. The others are the arguments of `rasterize`. Culled Gaussians have 0.
    """
    with torch.no_grad():
        mode, gate = mode_and_gate(settings)
        gaussians = _gather(means3D, None, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
        order = visible(gaussians, settings, mode)[1]
        splats = project(_rows(gaussians, order), settings)
        x = torch.arange(settings.image_width).to(splats.depth).repeat(settings.image_height)
        y = torch.arange(settings.image_height).to(splats.depth).repeat_interleave(settings.image_width)
        counts, wide = blended_pairs(splats, x, y, settings, mode, gate)
        alpha = pair_alphas(splats, x, y, counts)
        tails = tail_sum(splats, x, y, counts, alpha, settings, mode, wide)
        count, weights = len(order), pixel_weights.reshape(-1)
        # With a channel for each Gaussian, the image is the map of their shares.
        identity, black = torch.eye(count).to(alpha), alpha.new_zeros(count)
        share = blend(alpha, identity, splats.depth, black, mode, gate, tails)[:count]
        image = blend(alpha, splats.color, splats.depth, settings.bg, mode, gate, tails)[:len(settings.bg)]
        costs = alpha.new_zeros(count)
        for k in range(count):
            others = alpha.clone()
            others[k] = 0
            without = blend(others, splats.color, splats.depth, settings.bg, mode, gate, tails)[:len(settings.bg)]
            costs[k] = (weights * (without - image).square()).sum()

    def of_all(values):
        return values.new_zeros(len(means3D)).index_copy(0, order, values)

    return Importance(of_all(share @ share_weights.reshape(-1)), of_all(share.square() @ weights), of_all(costs))


def mode_and_gate(settings):
    """Returns the blend mode and the background's gate lambda, a number or a tensor of shape []."""
    mode, gate = resolve_blend(settings)
    if isinstance(gate, str):
        raise ValueError(f"reference: background_gate is {gate!r}; it must be a number or a tensor of one element")
    return mode, gate.reshape(()) if isinstance(gate, torch.Tensor) else gate


def _given(tensor):
    return None if tensor is None or tensor.shape == (0,) else tensor


def appearance(dc, shs, colors_precomp):
    """Returns shs [N, K, 3] with dc in it, or None, and colors_precomp [N, C], or None: arguments of `rasterize`.

    Raises ValueError unless just one of both is given.
    """
    dc, shs, colors_precomp = _given(dc), _given(shs), _given(colors_precomp)
    if dc is not None:
        shs = dc if shs is None else torch.cat([dc, shs], 1)
    if (shs is None) == (colors_precomp is None):
        raise ValueError("rasterize: give either shs or colors_precomp, and not both")
    return shs, colors_precomp


def _gather(means3D, means2D, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp):
    means2D = _given(means2D)
    scales, rotations, cov3D_precomp = _given(scales), _given(rotations), _given(cov3D_precomp)
    shs, colors_precomp = appearance(dc, shs, colors_precomp)
    if (scales is None) != (rotations is None) or (scales is None) == (cov3D_precomp is None):
        raise ValueError("rasterize: give either scales with rotations or cov3D_precomp, and not both")
    means2D = torch.zeros_like(means3D) if means2D is None else means2D - means2D.detach()
    return Gaussians(means3D, means2D, opacities.reshape(-1), shs, colors_precomp, scales, rotations, cov3D_precomp)


def visible(gaussians, settings, mode):
    """Returns radii [N] int32 and the rows of the visible Gaussians, nearest first [n]."""
    finite = torch.ones_like(gaussians.opacities, dtype=torch.bool)
    for name, column in zip(gaussians._fields, gaussians):
        if column is None or name == "means2D":
            continue
        column_finite = torch.isfinite(column).flatten(1).all(1) if column.dim() > 1 else column.abs() <= OPACITY_MAX
        if settings.strict and not column_finite.all():
            index = (~column_finite).nonzero()[0].item()
            limit = " or above 1e20" if name == "opacities" else ""
            raise ValueError(f"rasterize: {name}[{index}] is not finite{limit} (strict=True)")
        finite &= column_finite
    finite = finite.nonzero()[:, 0]

    splats = project(_rows(gaussians, finite), settings)
    in_front = splats.depth > _float32(settings.near)  # not so if it is NaN: beyond the lens's range
    too_near = splats.depth <= _float32(settings.near)
    if settings.prefiltered and too_near.any():
        index = finite[too_near][0].item()
        raise ValueError(f"rasterize: prefiltered is set, but means3D[{index}] is not beyond the near plane")
    xx, xy, yy = splats.covariance.unbind(1)
    det = xx * yy - xy * xy
    kept = in_front & (xx > 0) & (det > 0) & torch.isfinite(det)
    for column in splats:
        kept &= torch.isfinite(column if column.dim() > 1 else column[:, None]).flatten(1).all(1)
    kept &= footprint_meets(splats, 0, 0, settings.image_width - 1, settings.image_height - 1, settings, mode)
    kept = kept.nonzero()[:, 0]

    radii = torch.zeros(len(gaussians.means3D), dtype=torch.int32, device=finite.device)
    largest = torch.iinfo(torch.int32).max
    radii[finite[kept]] = radius(splats.covariance[kept]).double().clamp(max=largest).to(torch.int32)
    nearest_first = torch.sort(splats.depth[kept], stable=True)[1]
    return radii, finite[kept][nearest_first]


def project(gaussians, settings):
    """Projects Gaussians to the image plane (Eq. 1, 2; EWA splatting as in 3DGS)."""
    if settings.rolling_shutter == "global":
        view = _transform(gaussians.means3D, settings.viewmatrix)[:, :3]
        turn = settings.viewmatrix[:3, :3].T
        points = pinhole_points if settings.camera_model == "pinhole" else lens_points
        position, depth, jacobian = points(gaussians.means3D, view, settings)
    else:
        position, depth, jacobian, turn = rolling_points(gaussians.means3D, settings)
    position = position + gaussians.means2D[:, :2] * position.new_tensor(
        [settings.image_width / 2, settings.image_height / 2])
    to_image = jacobian @ turn
    raw = to_image @ covariance3D(gaussians, settings.scale_modifier) @ to_image.transpose(1, 2)
    raw_xx, xy, raw_yy = raw[:, 0, 0], raw[:, 0, 1], raw[:, 1, 1]
    xx, yy = raw_xx + settings.low_pass, raw_yy + settings.low_pass
    det = xx * yy - xy * xy
    opacity = gaussians.opacities
    if settings.antialiasing:
        opacity = opacity * ((raw_xx * raw_yy - xy * xy) / det).clamp(min=COMPENSATION_MIN).sqrt()
    return Splats(position, depth, torch.stack([xx, xy, yy], 1), torch.stack([yy, -xy, xx], 1) / det[:, None], opacity,
                  color(gaussians, settings))


def pinhole_points(points, view, settings):
    """Returns positions in pixels [n, 2], depths [n] and Jacobians [n, 2, 3] by view coordinates.

    points, view: [n, 3] world and view space.
    """
    width, height = settings.image_width, settings.image_height
    clip = _transform(points, settings.projmatrix)
    ndc = clip[:, :2] / (clip[:, 3:] + W_EPSILON)
    x, y, z = view.unbind(1)
    limit_x, limit_y = FRUSTUM_MARGIN * settings.tanfovx, FRUSTUM_MARGIN * settings.tanfovy
    slope_x, slope_y = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    focal_x, focal_y = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([torch.stack([focal_x / z, zero, -focal_x * slope_x / z], 1),
                            torch.stack([zero, focal_y / z, -focal_y * slope_y / z], 1)], 1)
    return ((ndc + 1) * ndc.new_tensor([width, height]) - 1) / 2, z, jacobian


def lens_points(points, view, settings):
    """The same of a lens. The Jacobian is torch's own derivative. A depth is NaN beyond the lens's range."""
    del points
    model, numbers = settings.camera_model, [float(number) for number in settings.distortion]
    size = settings.image_width, settings.image_height
    focal, principal, on_image = _image(view, settings)
    keeps_graph = torch.is_grad_enabled()
    with torch.enable_grad():
        view = view if view.requires_grad else view.detach().requires_grad_()
        plane, seen = on_plane(view, model, numbers)
        position = on_image(plane)
        if model == "opencv":  # the Jacobian is taken at most FRUSTUM_MARGIN times the image's slopes off axis
            limits = focal.new_tensor(slope_limits(numbers, focal.tolist(), principal.tolist(), size))
            slopes = plane.clamp(-limits, limits)
            by_slope = [torch.autograd.grad(row.sum(), slopes, create_graph=True)[0]
                        for row in on_image(slopes).unbind(1)]
            z = view[:, 2:]
            jacobian = torch.stack([torch.cat([row / z, -(row * slopes).sum(1, keepdim=True) / z], 1)
                                    for row in by_slope], 1)
        else:
            jacobian = torch.stack([torch.autograd.grad(row.sum(), view, create_graph=True)[0]
                                    for row in position.unbind(1)], 1)
        depth = _depths(view, model).masked_fill(~seen, math.nan)
    return (position, depth, jacobian) if keeps_graph else (position.detach(), depth.detach(), jacobian.detach())


def positions_and_depths(view, settings):
    """Returns both of a lens, [n, 2] and [n], without asking what the lens sees. view: [n, 3]."""
    model, numbers = settings.camera_model, [float(number) for number in settings.distortion]
    return _image(view, settings)[2](on_plane(view, model, numbers)[0]), _depths(view, model)


FIRST_TIME, LAST_TIME = -0.15, 1.15  # of a rolling shutter: 0 is the first row, or column, and 1 the last
SHUTTER_SPEED_MIN = 0.1  # what moves with the shutter at more than 1 - this of its speed is culled
TIME_ERROR_MAX = 0.1  # pixels between a point and the row that is read then; rounding is far below, a jump far above


def rolling_points(points, settings):
    """The same of a rolling shutter, with the rotations [n, 3, 3] from world to view at the times of the points.

    A point is seen at the time t for which its pixel, by the pose (1 - t) first + t last, is in the row read at t. The
    time is found by bisection. One step of Newton's method from there, which does not move it, gives it derivatives.
    """
    axis = 0 if settings.rolling_shutter in ("left_to_right", "right_to_left") else 1
    sign = -1 if settings.rolling_shutter in ("bottom_to_top", "right_to_left") else 1
    length = max((settings.image_width, settings.image_height)[axis] - 1, 1)
    first = _transform(points, settings.viewmatrix)[:, :3]
    motion = _transform(points, settings.viewmatrix_end)[:, :3] - first
    settings = settings._replace(camera_model=settings.camera_model.replace("pinhole", "opencv"))

    def late(time):
        place = positions_and_depths(first + time[:, None] * motion, settings)[0][:, axis]
        return (place if sign > 0 else length - place) - length * time

    with torch.no_grad():
        low, high = torch.full_like(points[:, 0], FIRST_TIME), torch.full_like(points[:, 0], LAST_TIME)
        for _ in range(64):
            time = (low + high) / 2
            later = late(time) > 0
            low, high = torch.where(later, time, low), torch.where(later, high, time)
        time = (low + high) / 2
        stands_still = (time < FIRST_TIME + 1e-9) | (time > LAST_TIME - 1e-9)
        time = time.masked_fill(time < FIRST_TIME + 1e-9, FIRST_TIME).masked_fill(time > LAST_TIME - 1e-9, LAST_TIME)
        never = ~stands_still & (late(time).abs() > TIME_ERROR_MAX)  # the point jumps over its row: at a seam
    with torch.enable_grad():
        moved = time.clone().requires_grad_()
        slope = torch.autograd.grad(late(moved).sum(), moved)[0]
    time = time - (late(time) / slope).masked_fill(stands_still, 0)

    position, depth, jacobian = lens_points(None, first + time[:, None] * motion, settings)
    # By the chain rule: the pixel p(x, t) also moves with the time t, which moves with p.
    velocity = jacobian @ motion[:, :, None]
    speed = length - sign * velocity[:, axis]
    depth = depth.masked_fill(never | ~stands_still & (speed[:, 0] < SHUTTER_SPEED_MIN * length), math.nan)
    stretch = (sign * velocity @ jacobian[:, axis:axis + 1] / speed[:, None]).masked_fill(
        stands_still[:, None, None], 0)
    view, end = (matrix[:3, :3].T for matrix in (settings.viewmatrix, settings.viewmatrix_end))
    return position, depth, jacobian + stretch, view + time[:, None, None] * (end - view)


def _image(view, settings):
    """Returns focal lengths and principal point [2], and the function from a lens's plane to pixels."""
    width, height = settings.image_width, settings.image_height
    focal = view.new_tensor([width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)])
    principal = settings.principal_point or (width / 2, height / 2)
    if settings.camera_model == "equirectangular":
        focal, principal = view.new_tensor([width / (2 * math.pi), height / math.pi]), (width / 2, height / 2)
    principal = view.new_tensor(principal)
    numbers = [float(number) for number in settings.distortion]
    return focal, principal, lambda plane: focal * distorted(plane, settings.camera_model, numbers) + principal - 0.5


def _depths(view, model):
    return view.norm(dim=1) if model in SEES_AROUND else view[:, 2]


SEES_AROUND = ("fisheye", "thin_prism_fisheye", "equirectangular")  # their depth is the distance
FISHEYE_END = 0.97 * math.pi  # the angle to the axis where every fisheye ends
POLE = 1e-3  # equirectangular: how near the axis of the poles, as a part of the distance, nothing is seen
MOST_SLOPE = 1e3  # "opencv" ends there at the latest


def on_plane(view, model, numbers):
    """Returns points on the plane that a lens distorts [n, 2], and which of them the lens sees [n]."""
    x, y, z = view.unbind(1)
    if model == "orthographic":
        return view[:, :2], torch.ones_like(z, dtype=torch.bool)
    if model == "opencv":
        plane = view[:, :2] / z[:, None]
        return plane, plane.norm(dim=1) < distortion_end(model, numbers, MOST_SLOPE)
    if model == "equirectangular":
        horizontal = torch.hypot(x, z)
        return (torch.stack([torch.atan2(x, z), torch.atan2(y, horizontal)], 1),
                horizontal > POLE * view.norm(dim=1))
    squared = x * x + y * y
    near_axis = (squared < 1e-6 * z * z) & (z > 0)  # there theta / rho is a series, of which three terms are all
    rho = torch.where(near_axis, torch.ones_like(squared), squared).sqrt()
    e = torch.where(near_axis, squared / (z * z), torch.zeros_like(z))
    ratio = torch.where(near_axis, (1 - e / 3 + e * e / 5) / torch.where(near_axis, z, torch.ones_like(z)),
                        torch.atan2(rho, z) / rho)
    plane = view[:, :2] * ratio[:, None]
    return plane, plane.norm(dim=1) < distortion_end(model, numbers, FISHEYE_END)


def _terms(model, numbers):
    """Returns polynomials in r^2, constants first, that scale the radius (over, under), then p1, p2 and s1 to s4."""
    k = list(numbers) + [0.0] * 12
    if model == "opencv":
        return [1.0, k[0], k[1], k[4]], [1.0, k[5], k[6], k[7]], k[2:4], k[8:12]
    if model == "thin_prism_fisheye":
        return [1.0, k[0], k[1], k[4], k[5]], [1.0], k[2:4], [k[6], 0.0, k[7], 0.0]
    return [1.0, *k[:4]], [1.0], [0.0, 0.0], [0.0] * 4


def distorted(plane, model, numbers):
    """Returns the distorted points of a plane [n, 2], as OpenCV and COLMAP define them."""
    over, under, (p1, p2), (s1, s2, s3, s4) = _terms(model, numbers)
    u, v = plane.unbind(1)
    squared = u * u + v * v
    radial = (sum(c * squared**i for i, c in enumerate(over)) / sum(c * squared**i for i, c in enumerate(under)))
    return torch.stack([
        u * radial + 2 * p1 * u * v + p2 * (squared + 2 * u * u) + s1 * squared + s2 * squared**2,
        v * radial + 2 * p2 * u * v + p1 * (squared + 2 * v * v) + s3 * squared + s4 * squared**2], 1)


def distortion_end(model, numbers, end):
    """Returns the least radius at which the distorted radius r R(r^2), or its denominator, stops rising; at most end.

    Only the radial part counts: the roots of the numerator of its derivative, a polynomial in r^2.
    """
    over, under = (np.polynomial.Polynomial(terms) for terms in _terms(model, numbers)[:2])
    q = np.polynomial.Polynomial([0.0, 1.0])
    stops = [over * under + 2 * q * (over.deriv() * under - over * under.deriv()), under]
    roots = [root.real for each in stops for root in each.trim().roots() if abs(root.imag) < 1e-9 and root.real > 0]
    return min([end, *np.sqrt(roots)])


def slope_limits(numbers, focal, principal, size):
    """Returns FRUSTUM_MARGIN times the largest |x/z| and |y/z| of the image's edges and corners, by the radial part."""
    over, under, *_ = _terms("opencv", numbers)
    end = distortion_end("opencv", numbers, MOST_SLOPE)
    edge = [max(centre, side - centre) / scale for centre, side, scale in zip(principal, size, focal)]

    def stretch(radius):
        low, high = 0.0, end
        while True:
            middle = 0.5 * (low + high)
            if middle in (low, high):
                return low / radius
            q = middle * middle
            value = middle * np.polyval(over[::-1], q) / np.polyval(under[::-1], q)
            low, high = (middle, high) if value < radius else (low, middle)

    return [FRUSTUM_MARGIN * side * max(stretch(side), stretch(math.hypot(*edge))) for side in edge]


def _transform(points, matrix):
    return torch.cat([points, torch.ones_like(points[:, :1])], 1) @ matrix


def covariance3D(gaussians, scale_modifier):
    """Returns R S S^T R^T [n, 3, 3], or the given covariance, which scale_modifier does not touch."""
    if gaussians.cov3D_precomp is not None:
        xx, xy, xz, yy, yz, zz = gaussians.cov3D_precomp.unbind(1)
        return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).reshape(-1, 3, 3)
    w, x, y, z = gaussians.rotations.unbind(1)
    rotation = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).reshape(-1, 3, 3)
    axes = rotation * (scale_modifier * gaussians.scales)[:, None, :]
    return axes @ axes.transpose(1, 2)


def color(gaussians, settings):
    """Returns the experts [n, C]: the given colours, or spherical harmonics plus 0.5, at least 0 by `clamp_color`."""
    if gaussians.colors_precomp is not None:
        return gaussians.colors_precomp
    basis = sh_basis(settings.sh_degree, gaussians.means3D - settings.campos)
    unclamped = 0.5 + torch.einsum("nk,nkc->nc", basis, gaussians.shs[:, :basis.shape[1]])
    return unclamped.clamp(min=0) if settings.clamp_color else unclamped


def sh_basis(degree, offset):
    """Returns the real spherical harmonics of degree 0 to 3 [n, (degree + 1)^2] in the direction of offset [n, 3].

    The signs are those of 3DGS, with the Condon-Shortley phase.
    """
    constant = torch.ones_like(offset[:, 0])
    bands = [math.sqrt(1 / (4 * math.pi)) * constant]
    if degree > 0:
        length = offset.norm(dim=1, keepdim=True)
        x, y, z = (offset / length.masked_fill(length == 0, math.inf)).unbind(1)
        factor = math.sqrt(3 / (4 * math.pi))
        bands += [-factor * y, factor * z, -factor * x]
    if degree > 1:
        factor = math.sqrt(15 / (4 * math.pi))
        bands += [factor * x * y, -factor * y * z, math.sqrt(5 / (16 * math.pi)) * (2 * z * z - x * x - y * y),
                  -factor * x * z, factor / 2 * (x * x - y * y)]
    if degree > 2:
        outer, inner = math.sqrt(35 / (32 * math.pi)), math.sqrt(21 / (32 * math.pi))
        factor = math.sqrt(105 / (4 * math.pi))
        bands += [-outer * y * (3 * x * x - y * y), factor * x * y * z, -inner * y * (4 * z * z - x * x - y * y),
                  math.sqrt(7 / (16 * math.pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y),
                  -inner * x * (4 * z * z - x * x - y * y), factor / 2 * z * (x * x - y * y),
                  -outer * x * (x * x - 3 * y * y)]
    return torch.stack(bands, 1)


def radius(covariance):
    """Returns the 3-sigma radius of the longer axis in whole pixels [n], as a floating-point number (3DGS)."""
    xx, xy, yy = covariance.unbind(1)
    mid = (xx + yy) / 2
    det = xx * yy - xy * xy
    return torch.ceil(3 * torch.sqrt(mid + torch.sqrt((mid * mid - det).clamp(min=EIGENVALUE_SPREAD_MIN))))


def tile_rectangle(splats, settings):
    """Returns the first tile and the tile past the last [n, 2] each, in x and y, that 3DGS bins a splat into.

    3DGS truncates toward zero; after the clamp to the grid that equals the floor.
    """
    grid = splats.position.new_tensor([-(-settings.image_width // TILE), -(-settings.image_height // TILE)])
    reach = radius(splats.covariance)[:, None]
    first = torch.floor((splats.position - reach) / TILE)
    past = torch.floor((splats.position + reach + (TILE - 1)) / TILE)
    zero = torch.zeros_like(grid)
    return first.clamp(zero, grid), past.clamp(zero, grid)


def footprint_meets(splats, left, top, right, bottom, settings, mode, slack=0.0):
    """Returns whether each footprint meets a rectangle of pixel centres, edges included [n].

    The footprint is the tile rectangle of 3DGS in "alpha" and "smoe", and the ellipse G >= 1e-5 in the other modes,
    where slack is added to d^T Sigma^-1 d.
    """
    low, high = splats.position.new_tensor([left, top]), splats.position.new_tensor([right, bottom])
    if mode in ("alpha", "smoe"):
        first, past = tile_rectangle(splats, settings)
        return ((past > first) & (first * TILE <= high) & (past * TILE > low)).all(1)
    return _closest_squared(splats, left, top, right, bottom) <= -2 * math.log(KERNEL_MIN) + slack


def _closest_squared(splats, left, top, right, bottom):
    """Returns the smallest d^T Sigma^-1 d [n] over a rectangle: 0 inside, else on one of its edges, as it is convex."""
    x, y = splats.position.unbind(1)
    a, b, c = splats.conic.unbind(1)
    candidates = []
    for edge in (left, right):
        dx = edge - x
        candidates.append((dx, (y - b / c * dx).clamp(top, bottom) - y))
    for edge in (top, bottom):
        dy = edge - y
        candidates.append(((x - b / a * dy).clamp(left, right) - x, dy))
    on_edges = torch.stack([a * dx * dx + 2 * b * dx * dy + c * dy * dy for dx, dy in candidates]).min(0)[0]
    inside = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
    return on_edges.masked_fill(inside, 0)


class _PassThroughClamp(torch.autograd.Function):
    """min(ALPHA_MAX, x) whose gradient is passed straight through, as in 3DGS."""

    @staticmethod
    def forward(ctx, raw):
        return raw.clamp(max=ALPHA_MAX)

    @staticmethod
    def backward(ctx, gradient):
        return gradient


def pair_counts(splats, x, y, settings, mode, gate):
    """Returns which pairs of Gaussian and pixel count [n, pixels]; x, y [pixels] are pixel coordinates.

    A pair counts if o > 0, power <= 0 and, in "alpha", alpha >= 1/255 within the tile rectangle of 3DGS; in "smoe"
    alpha >= 1/2040 (or alpha_min) within that rectangle; in the other modes G >= 1e-5 and alpha >= alpha_min. If
    the background has a gate lambda > 0 there, a pair of less than lambda / 255 changes no 8-bit image either, and
    counts only within 3 sigma, whatever the Gaussian's opacity.
    """
    opacity = splats.opacity[:, None]
    power = _power(splats.conic, splats.position[:, :1] - x, splats.position[:, 1:] - y)
    kernel = torch.exp(power)
    alpha = opacity * kernel
    counts = (opacity > 0) & (power <= 0)
    if mode not in ("alpha", "smoe"):
        cut = torch.tensor(float(gate), dtype=torch.float32) * ALPHA_MIN  # rounded as float32
        return (counts & (kernel >= KERNEL_MIN) & (alpha >= _float32(settings.alpha_min))
                & (alpha >= (opacity * KERNEL_KEPT).clamp(max=cut.item())))
    least = ALPHA_MIN if mode == "alpha" else max(STRONG_MIN, _float32(settings.alpha_min))
    return counts & in_rectangle(splats, x, y, settings) & (alpha >= least)


def in_rectangle(splats, x, y, settings):
    """Returns whether each pixel lies in the tile rectangle of each Gaussian [n, pixels]."""
    (first_x, first_y), (past_x, past_y) = (edge.T[:, :, None] for edge in tile_rectangle(splats, settings))
    tile_x, tile_y = torch.floor(x / TILE), torch.floor(y / TILE)
    return (tile_x >= first_x) & (tile_x < past_x) & (tile_y >= first_y) & (tile_y < past_y)


def near_pairs(splats, x, y, counts):
    """Returns which of the pairs that count [n, pixels] are near: alpha >= 1/255, within 3 sigma 1/1020.

    Others are faint. Within 3 sigma fewer are, so that faint Gaussians have a gradient.
    """
    kernel = torch.exp(_power(splats.conic, splats.position[:, :1] - x, splats.position[:, 1:] - y))
    alpha = splats.opacity[:, None] * kernel
    return counts & ((alpha >= ALPHA_MIN) | (kernel >= KERNEL_KEPT) & (alpha >= CORE_MIN))


def wide_pixels(splats, x, y, near, settings, mode):
    """Returns which pixels are wide [pixels]: those with a gate sum of the near pairs below faint_below.

    In the others no faint pair and no tail counts. There a pair of alpha < 1/255 would move its pixel by less than
    1/255/W, with W the gate sum. near: [n, pixels], of `near_pairs`.
    """
    with torch.no_grad():
        weight, _ = numerator(pair_alphas(splats, x, y, near), mode)
        return weight.sum(0) < _float32(resolve_faint_below(mode, settings.faint_below))


def blended_pairs(splats, x, y, settings, mode, gate):
    """Returns which pairs are blended [n, pixels], and which pixels are wide [pixels]."""
    counts = pair_counts(splats, x, y, settings, mode, gate)
    if not leaves_out_faint(mode, settings.faint_below):
        return counts, torch.ones_like(x, dtype=torch.bool)
    near = near_pairs(splats, x, y, counts)
    wide = wide_pixels(splats, x, y, near, settings, mode)
    return near | (counts & wide), wide


def tail_sum(splats, x, y, counts, alpha, settings, mode, wide):
    """Returns the sum B of each pixel's tails [pixels]; 0 in modes but "smoe", and if it is not wide. No gradient.

    A tail is a pair within the tile rectangle that is too weak to count. Its alpha T joins B while its pixel is open,
    and T does not feel it. counts, alpha: [n, pixels], of `blended_pairs` and `pair_alphas`. wide: [pixels].
    """
    with torch.no_grad():
        if mode != "smoe":
            return torch.zeros_like(x)
        opacity = splats.opacity[:, None]
        power = _power(splats.conic, splats.position[:, :1] - x, splats.position[:, 1:] - y)
        tail = opacity * torch.exp(power)
        least = TAIL_MIN if leaves_out_faint(mode, settings.faint_below) else EVERY_TAIL_MIN
        is_tail = (opacity > 0) & (power <= 0) & ~counts & in_rectangle(splats, x, y, settings) & (tail >= least)
        _, stopped = numerator(alpha, mode)
        transmittance = torch.cat([torch.ones_like(alpha[:1]), torch.cumprod(1 - alpha, 0)])[:len(alpha)]
        total = (tail * transmittance).masked_fill(~is_tail | stopped, 0).sum(0)
        return total.masked_fill(~wide, 0)


def pair_alphas(splats, x, y, counts):
    """Returns alpha_i = min(0.99, o_i G_i) (Eq. 1) [n, pixels], 0 for pairs that do not count.

    Those pairs are moved to the centre first: far away their derivatives overflow, and 0 times infinity is NaN.
    """
    dx = (splats.position[:, :1] - x).masked_fill(~counts, 0)
    dy = (splats.position[:, 1:] - y).masked_fill(~counts, 0)
    kernel = torch.exp(_power(splats.conic, dx, dy))
    return _PassThroughClamp.apply(splats.opacity[:, None] * kernel).masked_fill(~counts, 0)


def _power(conic, dx, dy):
    a, b, c = conic.T[:, :, None]
    return -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy


def numerator(alpha, mode):
    """Returns each pair's weight in the numerator of its pixel's colour, and which pairs a full pixel leaves out of it.

    alpha: [n, pixels], Gaussians nearest first; so are the results.
    """
    transmittance_behind = torch.cumprod(1 - alpha, 0)
    transmittance = torch.cat([torch.ones_like(alpha[:1]), transmittance_behind])[:len(alpha)]  # T_i, Eq. 4
    stopped = transmittance_behind < TRANSMITTANCE_MIN  # from the Gaussian on that would saturate the pixel
    if mode == "smoe_std":
        return alpha, torch.zeros_like(stopped)
    return (alpha * transmittance).masked_fill(stopped, 0), stopped


def blend(alpha, color, depth, bg, mode, gate, tails):
    """Blends the Gaussians of every pixel, front to back, and behind them the background.

    alpha: [n, pixels]; color: [n, C]; depth: [n]; bg: [C]; gate: number or []; tails: [pixels], of `tail_sum`.
    Returns [C + 3, pixels]: colour, alpha, depth, inverse depth.
    """
    weight, stopped = numerator(alpha, mode)
    gate_sum = weight.sum(0) if mode in ("alpha", "smoe", "smoe_eq7") else alpha.sum(0)
    background = tails  # B
    if isinstance(gate, torch.Tensor) or gate:
        background = background + gate * (1 - alpha).masked_fill(stopped, 1).prod(0)  # lambda T, behind the last pair
    # alpha (Eq. 3) divides by 1, which this sum is only to rounding; Eq. 7 (smoe, smoe_eq7), 8 (smoe_tn) and 6
    # (smoe_std) differ in weight and gate_sum. Of these the background has a weight only in the first two.
    total = torch.ones_like(gate_sum) if mode == "alpha" else gate_sum + background

    of_background = background * bg[:, None]
    if background is tails:  # a background that is NaN must not reach pixels without tails
        of_background = of_background.masked_fill(tails == 0, 0)
    blended = color.T @ weight + of_background
    without = gate_sum < GATE_SUM_MIN
    image = _quotient(blended, total, without, bg[:, None])
    expected_depth = _quotient(depth @ weight, gate_sum, without, 0)
    inverse_depth = _quotient((1 / depth) @ weight, total, without, 0)
    covered = _quotient(gate_sum, total, without, 0) if mode == "smoe" else gate_sum
    return torch.cat([image, torch.stack([covered, expected_depth, inverse_depth])])


def _quotient(numerator, gates, without, otherwise):
    """Returns numerator / gates, and what is to stand if there are no gates."""
    return torch.where(without, torch.as_tensor(otherwise).to(gates), numerator / gates.masked_fill(without, 1))


def _render_blocks(splats, settings, mode, gate):
    """Returns [C + 3, height, width]; each block keeps only its inputs for the backward and is computed again there."""
    def block(left, top, right, bottom, *columns):
        splats = Splats(*columns)
        x = torch.arange(left, right).to(splats.depth).repeat(bottom - top)
        y = torch.arange(top, bottom).to(splats.depth).repeat_interleave(right - left)
        with torch.no_grad():
            # The slack keeps rounding in this shortcut from losing a pair; only `pair_counts` decides.
            meets = footprint_meets(splats, left, top, right - 1, bottom - 1, settings, mode, slack=1.0)
            counts, wide = blended_pairs(_rows(splats, meets), x, y, settings, mode, gate)
        met = _rows(splats, meets)
        alpha = pair_alphas(met, x, y, counts)
        tails = tail_sum(met, x, y, counts, alpha, settings, mode, wide)
        image = blend(alpha, met.color, met.depth, settings.bg, mode, gate, tails)
        return image.reshape(-1, bottom - top, right - left)

    bands = []
    for top in range(0, settings.image_height, BLOCK):
        bottom = min(top + BLOCK, settings.image_height)
        bands.append(torch.cat([
            checkpoint(block, left, top, min(left + BLOCK, settings.image_width), bottom, *splats, use_reentrant=False)
            for left in range(0, settings.image_width, BLOCK)], 2))
    return torch.cat(bands, 1)
