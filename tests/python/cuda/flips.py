"""Tells another outcome of a threshold from an error, pixel by pixel, in two float32 renderings of one model.

A rendering decides which pairs count (alpha against 1/255, and the tile rectangle of 3DGS), in which order (depth
against depth), and where a pixel stops (T against 1e-4). Where the two sides of a decision lie within rounding of each
other, two correct programs may decide otherwise. So a pixel in which they differ is blended in float64, from what the
reference projects, once for every outcome of its close decisions: each program must show one of the outcomes, to within
what its roundings can add up to.
"""
from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch

from diff_smoe_rasterization import reference

# How far float32, 2^-24 = 6e-8 an operation, may be from the exact numbers.
POSITION = 2e-7  # of the larger side of the image: (ndc + 1) is rounded, then its product with the side
COVARIANCE = 3e-7  # of a covariance's entries; its inverse multiplies that by the condition number
DEPTH = 1e-6  # of a depth: four products that cancel in part
ALPHA = 5e-7  # of alpha, if the exponent is exact
COLOR = 2e-5  # of a sum of colours up to 2, if all alphas are exact
MOST_DECISIONS = 8
PIXELS_AT_ONCE = 32


class Pixel(NamedTuple):
    """The pairs of a pixel that count or nearly count, nearest first, in float64."""

    alpha: torch.Tensor  # [n]
    color: torch.Tensor  # [n, C]
    depth: torch.Tensor  # [n]
    rounding: torch.Tensor  # [n] of ln(alpha)
    counts: torch.Tensor  # [n] bool
    close: torch.Tensor  # [n] bool: rounding may decide whether it counts


def project(inputs, settings, mode):
    """Returns the reference's Splats of the visible Gaussians, nearest first, in float64."""
    wide = {name: tensor.detach().double() for name, tensor in inputs.items()}
    settings = settings._replace(**{name: getattr(settings, name).double()
                                    for name in ("bg", "viewmatrix", "projmatrix", "campos")})
    with torch.no_grad():
        gaussians = reference._gather(*(wide.get(name) for name in (
            "means3D", "means2D", "opacities", "dc", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp")))
        return reference.project(reference._rows(gaussians, reference.visible(gaussians, settings, mode)[1]), settings)


def pixels_of(splats, settings, mode, x, y):
    """Yields the Pixel at each of the coordinates x, y [p]."""
    cut = math.log(reference.ALPHA_MIN if mode == "alpha" else settings.alpha_min)
    shift = POSITION * max(settings.image_width, settings.image_height)
    a, b, c = splats.conic.T[:, :, None]
    dx, dy = splats.position[:, :1] - x, splats.position[:, 1:] - y
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    slope = ((a * dx + b * dy) ** 2 + (b * dx + c * dy) ** 2).sqrt()
    condition = (splats.conic[:, 0] + splats.conic[:, 2]) ** 2 / (
        splats.conic[:, 0] * splats.conic[:, 2] - splats.conic[:, 1] ** 2)
    rounding = ALPHA + shift * slope - COVARIANCE * condition[:, None] * power
    above_cut = splats.opacity[:, None].log() + power - cut
    # A footprint that only one program lists for the tile.
    listed = torch.stack([in_tile(splats._replace(position=splats.position + move), x, y, settings, mode)
                          for move in (0, shift, -shift)])
    counts = (above_cut >= 0) & listed[0]
    possible = (above_cut >= -rounding) & listed.any(0)
    close = possible & ((above_cut <= rounding) | ~listed.all(0))
    for k in range(len(x)):
        rows = possible[:, k].nonzero()[:, 0]
        alpha = (above_cut[rows, k] + cut).exp().clamp(max=reference.ALPHA_MAX)
        columns = (alpha, splats.color[rows], splats.depth[rows], rounding[rows, k], counts[rows, k], close[rows, k])
        yield Pixel(*(column.cpu() for column in columns))


def in_tile(splats, x, y, settings, mode):
    """Whether each footprint is in the list of each pixel's tile [n, p]; the gated modes have no such rule."""
    if mode != "alpha":
        return torch.ones(len(splats.depth), len(x), dtype=torch.bool, device=x.device)
    (first_x, first_y), (past_x, past_y) = (
        edge.T[:, :, None] for edge in reference.tile_rectangle(splats, settings))
    tile_x, tile_y = torch.floor(x / reference.TILE), torch.floor(y / reference.TILE)
    return (tile_x >= first_x) & (tile_x < past_x) & (tile_y >= first_y) & (tile_y < past_y)


def blend(pixel, counts, order, stop, bg, mode):
    """Returns the colour and the sum of the weights [C + 1] of the pairs that count, in that order."""
    alpha = (pixel.alpha * counts)[order]
    behind = torch.cumprod(1 - alpha, 0)
    seen = behind >= stop
    before = torch.cat([torch.ones_like(behind[:1]), behind[:-1]])
    weights = alpha * before * seen
    color, total = weights @ pixel.color[order], weights.sum()
    color = color + (1 - alpha * seen).prod() * bg if mode == "alpha" else color / total
    return torch.cat([color, total[None]])


def outcomes(pixel, bg, mode):
    """Returns what the pixel may show, [k, C + 1], and what roundings may add up to on the way there [C + 1]."""
    alpha = pixel.alpha.clone().requires_grad_()
    order = torch.arange(len(alpha))
    exact = blend(pixel._replace(alpha=alpha), pixel.counts, order, reference.TRANSMITTANCE_MIN, bg, mode)
    moved = pixel.rounding * pixel.alpha
    rounding = torch.stack([(torch.autograd.grad(value, alpha, retain_graph=True)[0] * moved).abs().sum()
                            for value in exact])

    decisions = [("count", i) for i in pixel.close.nonzero()[:, 0].tolist()]
    decisions += [("swap", i) for i in range(len(order) - 1)
                  if pixel.depth[i + 1] - pixel.depth[i] <= 2 * DEPTH * pixel.depth[i]]
    transmittance = torch.cumsum(torch.log1p(-pixel.alpha * pixel.counts), 0)
    doubt = torch.cumsum(moved / (1 - pixel.alpha) * pixel.counts, 0)
    unsure = ((transmittance - math.log(reference.TRANSMITTANCE_MIN)).abs() <= doubt).nonzero()[:, 0].tolist()
    stops = [1.0] + [math.exp(sign * doubt[i].item()) for i in unsure[:1] for sign in (1, -1)]

    shown = []
    for choice in itertools.product((False, True), repeat=min(len(decisions), MOST_DECISIONS)):
        counts, order = pixel.counts.clone(), torch.arange(len(alpha))
        for (kind, i), other in zip(decisions, choice):
            if other and kind == "count":
                counts[i] = ~counts[i]
            elif other:
                order[[i, i + 1]] = order[[i + 1, i]]
        shown += [blend(pixel, counts, order, reference.TRANSMITTANCE_MIN * stop, bg, mode) for stop in stops]
    return torch.stack(shown), rounding.detach()


def kind_of(pixel, images, bg, mode):
    """Says what two colours [C] or [C + 1] of a pixel are: "flipped", "rounded" or "unexplained"."""
    shown, rounding = outcomes(pixel, bg, mode)
    tolerance = rounding.clamp(min=COLOR)
    fits = [((shown[:, :len(image)] - image).abs() <= tolerance[:len(image)]).all(1) for image in images]
    if (fits[0] & fits[1]).any():
        return "rounded"
    return "flipped" if fits[0].any() and fits[1].any() else "unexplained"


def explain(first, second, different, inputs, settings, mode):
    """Counts the pixels [H, W] where `different` is set of two images: {"flipped", "rounded", "unexplained": number}.

    first, second: colours [C, H, W], or with the sum of the weights after them. inputs: as for `rasterize`.
    """
    counts = {"flipped": 0, "rounded": 0, "unexplained": 0}
    y, x = different.nonzero().unbind(1)
    if len(x) == 0:
        return counts
    splats, bg = project(inputs, settings, mode), settings.bg.cpu().double()
    images = [image.detach()[:, y, x].cpu().double() for image in (first, second)]
    for begin in range(0, len(x), PIXELS_AT_ONCE):
        part = slice(begin, begin + PIXELS_AT_ONCE)
        for k, pixel in enumerate(pixels_of(splats, settings, mode, x[part].double(), y[part].double())):
            counts[kind_of(pixel, [image[:, begin + k] for image in images], bg, mode)] += 1
    return counts
