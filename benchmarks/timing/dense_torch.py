"""The rasterizer as a torch user would write it: a dense [pixels, Gaussians] evaluation a tile, gradients by autograd.

A baseline for benchmarks only. It does the same work as the library, as well as plain torch allows: projection and
depth order once, a list of exact bounding boxes for every 16x16 tile, separable terms evaluated on rows and columns
before they meet, all of torch's threads. A tile's backward follows its forward at once, so no tile is evaluated twice
and memory is for one tile only. So the image gradient must be known beforehand, which a training loop could not
promise. The formulas and thresholds are those of `diff_smoe_rasterization.reference`, which tests it.
"""
from __future__ import annotations

import math

import torch

from diff_smoe_rasterization import reference
from diff_smoe_rasterization.settings import leaves_out_faint, resolve_faint_below

TILE = reference.TILE


def rasterize_with_gradients(gaussians, settings, dL_dcolor=None):
    """Renders, and pulls an image gradient back to the inputs.

    Args:
        gaussians: dict of the tensor arguments of `diff_smoe_rasterization.rasterize`: means3D [N, 3], opacities [N]
            or [N, 1], shs [N, K, 3] or colors_precomp [N, C], scales [N, 3] with rotations [N, 4] or cov3D_precomp.
        settings: GaussianRasterizationSettings.
        dL_dcolor: [C, H, W], or None to render only.
    Returns: the image [C, H, W], and a dict of gradients, a key an argument (None without dL_dcolor).
    """
    mode, _ = reference.mode_and_gate(settings)
    backward = dL_dcolor is not None
    leaves = {name: tensor.detach().clone().requires_grad_(backward) for name, tensor in gaussians.items()}
    with torch.set_grad_enabled(backward):
        absent = dict.fromkeys(reference.Gaussians._fields)
        columns = dict(absent, **leaves, means2D=torch.zeros_like(leaves["means3D"]))
        columns["opacities"] = columns["opacities"].reshape(-1)
        columns = reference.Gaussians(**columns)
        with torch.no_grad():
            _, order = reference.visible(columns, settings, mode)
        visible = reference.Gaussians(*(None if column is None else column[order] for column in columns))
        splats = reference.project(visible, settings)
        table = torch.cat([splats.position, splats.conic, splats.opacity[:, None], splats.color], 1)  # [n, 6 + C]

    with torch.no_grad():
        members, ends = tile_lists(splats, settings, mode)
    image, dL_dtable = _render_tiles(table.detach(), members, ends, settings, mode, dL_dcolor)
    if not backward:
        return image, None
    gradients = torch.autograd.grad(table, list(leaves.values()), dL_dtable, allow_unused=True)
    return image, dict(zip(leaves, gradients))


def tile_lists(splats, settings, mode):
    """Bins splats, given nearest first, by the box around the ellipse where their pairs can count.

    Returns members [instances], rows of splats tile by tile, nearest first, and ends, the list of each tile's end.
    """
    tiles_x, tiles_y = -(-settings.image_width // TILE), -(-settings.image_height // TILE)
    if mode in ("alpha", "smoe"):
        least = reference.ALPHA_MIN if mode == "alpha" else reference.TAIL_MIN
        distance_squared = 2 * torch.log(splats.opacity.clamp(min=1e-30) / least)
    else:
        distance_squared = torch.full_like(splats.opacity, -2 * math.log(reference.KERNEL_MIN))
        distance_squared[splats.opacity <= 0] = -1
    # A relative 1e-4 outward, so that rounding loses no pair: the pairs themselves are tested exactly.
    reach = (1.0001 * distance_squared.clamp(min=0))[:, None] * splats.covariance[:, ::2]
    reach = reach.sqrt()
    grid = splats.position.new_tensor([tiles_x, tiles_y])
    zero = torch.zeros_like(grid)
    first = torch.floor((splats.position - reach) / TILE).clamp(zero, grid)
    past = (torch.floor((splats.position + reach) / TILE) + 1).clamp(zero, grid)
    if mode in ("alpha", "smoe"):
        rectangle_first, rectangle_past = reference.tile_rectangle(splats, settings)
        first, past = torch.maximum(first, rectangle_first), torch.minimum(past, rectangle_past)
    first, size = first.long(), (past - first).clamp(min=0).long()
    size[distance_squared < 0] = 0

    counts = size.prod(1)
    splat = torch.repeat_interleave(torch.arange(len(counts)), counts)
    within = torch.arange(len(splat)) - (counts.cumsum(0) - counts)[splat]
    columns = size[splat, 0]
    tile = (first[splat, 1] + within // columns) * tiles_x + first[splat, 0] + within % columns
    tile, by_tile = torch.sort(tile, stable=True)
    ends = torch.searchsorted(tile, torch.arange(tiles_x * tiles_y), right=True)
    return splat[by_tile], ends.tolist()


def _render_tiles(table, members, ends, settings, mode, dL_dcolor):
    """Returns the image [C, H, W] and dL/dtable [n, 6 + C] (None without dL_dcolor)."""
    height, width = settings.image_height, settings.image_width
    image = table.new_empty(settings.bg.shape[0], height, width)
    dL_dtable = None if dL_dcolor is None else torch.zeros_like(table)
    start = 0
    for tile, end in enumerate(ends):
        top, left = tile // -(-width // TILE) * TILE, tile % -(-width // TILE) * TILE
        window = slice(None), slice(top, min(top + TILE, height)), slice(left, min(left + TILE, width))
        index = members[start:end]
        start = end
        rows = table[index]
        y = torch.arange(window[1].start, window[1].stop).to(table)
        x = torch.arange(window[2].start, window[2].stop).to(table)
        if dL_dcolor is None or not len(index):
            with torch.no_grad():
                image[window] = blend_tile(rows, x, y, settings, mode)
            continue
        rows.requires_grad_()
        pixels = blend_tile(rows, x, y, settings, mode)
        image[window] = pixels.detach()
        dL_dtable.index_add_(0, index, torch.autograd.grad(pixels, rows, dL_dcolor[window])[0])
    return image, dL_dtable


def blend_tile(rows, x, y, settings, mode):
    """Renders one tile densely.

    rows: [n, 6 + C] of position, conic, opacity, colour, nearest first; x: [columns], y: [lines] pixel coordinates.
    Returns [C, lines, columns].
    """
    mean_x, mean_y, a, b, c, opacity = rows[:, :6].unbind(1)
    color = rows[:, 6:]
    dx, dy = mean_x - x[:, None], mean_y - y[:, None]  # [columns, n], [lines, n]
    along = (-0.5 * a * dx * dx) + (-0.5 * c * dy * dy)[:, None]
    power = torch.addcmul(along, (b * dy)[:, None], dx, value=-1).reshape(len(y) * len(x), len(rows))
    kernel = torch.exp(power)
    raw = opacity * kernel
    with torch.no_grad():
        if mode in ("alpha", "smoe"):
            least = reference.ALPHA_MIN if mode == "alpha" else max(reference.STRONG_MIN, settings.alpha_min)
            skipped = raw < least
        else:
            skipped = (kernel < reference.KERNEL_MIN) | (raw < settings.alpha_min)
        skipped |= power > 0
        gate = reference.mode_and_gate(settings)[1]
        if mode == "smoe_eq7" and gate > 0:
            least = float(torch.tensor(gate, dtype=torch.float32) * reference.ALPHA_MIN)  # rounded as float32
            skipped |= raw < (opacity * reference.KERNEL_KEPT).clamp(max=least)
        wide = torch.ones_like(raw[:, :1], dtype=torch.bool)
        if leaves_out_faint(mode, settings.faint_below):
            near = raw >= (opacity * reference.KERNEL_KEPT).clamp(min=reference.CORE_MIN, max=reference.ALPHA_MIN)
            near_alpha = raw.masked_fill(skipped | ~near, 0).clamp(max=reference.ALPHA_MAX)
            behind = torch.cumprod(1 - near_alpha, 1)
            in_front = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], 1)
            gate_sum = (near_alpha * in_front).masked_fill(behind < reference.TRANSMITTANCE_MIN, 0).sum(1, keepdim=True)
            wide = gate_sum < resolve_faint_below(mode, settings.faint_below)
            skipped |= ~near & ~wide
    alpha = reference._PassThroughClamp.apply(raw.masked_fill(skipped, 0))

    weight = alpha
    if mode != "smoe_std":
        behind = torch.cumprod(1 - alpha, 1)  # T_{i+1}
        transmittance = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], 1)
        with torch.no_grad():
            stopped = behind < reference.TRANSMITTANCE_MIN
        weight = (alpha * transmittance).masked_fill(stopped, 0)
    if mode == "alpha":
        blended = weight @ (color - settings.bg) + settings.bg  # the transmittance left over is 1 - sum of weights
    else:
        gate_sum = (weight if mode in ("smoe", "smoe_eq7") else alpha).sum(1, keepdim=True)
        background = gate * (1 - gate_sum)
        if mode == "smoe":
            with torch.no_grad():
                every = not leaves_out_faint(mode, settings.faint_below)
                least = reference.EVERY_TAIL_MIN if every else reference.TAIL_MIN
                tails = raw.masked_fill(~skipped | (power > 0) | (raw < least) | stopped, 0)
                tails = (tails * transmittance).sum(1, keepdim=True)
                background = background + tails.masked_fill(~wide, 0)
        total = gate_sum + background
        has_gate = gate_sum >= reference.GATE_SUM_MIN
        blended = weight @ color + background * settings.bg
        blended = torch.where(has_gate, blended / total.masked_fill(~has_gate, 1), settings.bg)
    return blended.T.reshape(-1, len(y), len(x))
