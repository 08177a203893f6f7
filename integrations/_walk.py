"""A walk over the tiles' lists in plain torch, for results that ask which Gaussian has which weight in a pixel.

It takes many times as long as the rendering.
"""
from __future__ import annotations

from typing import Any, Dict, Iterator, Tuple

import torch
from torch.nn.functional import pad

from diff_smoe_rasterization import Footprints, project_gaussians
from diff_smoe_rasterization import GaussianRasterizationSettings as Settings
from diff_smoe_rasterization.settings import leaves_out_faint, resolve_blend, resolve_faint_below

TILE, STEP = 16, 8  # pixels of a tile's side; Gaussians of its list that are taken at once
FULL = 1e-4  # a pixel of less transmittance takes no more


class Walk:
    """The weights of Gaussians in pixels: those in the numerator of a pixel's colour."""

    def __init__(self, settings: Settings, inputs: Dict[str, Any]) -> None:
        self.mode, _ = resolve_blend(settings)
        given = {name: tensor for name, tensor in inputs.items() if name != "means2D"}
        footprints = project_gaussians(settings=settings, **given)
        self.height, self.width = settings.image_height, settings.image_width
        grid = torch.tensor([-(-self.width // TILE), -(-self.height // TILE)], device=footprints.radii.device)
        self.columns, self.rows = grid.tolist()
        self.order, self.tile_of, self.places = _lists(footprints, grid, self.mode in ("alpha", "smoe"))
        self.gates = footprints.gates[self.order]
        self.wide = None  # [tiles, 16, 16]: faint pairs count in these pixels; None: in all
        if leaves_out_faint(self.mode, settings.faint_below):
            self.wide = self.image_of_tiles(0) > 0
            gate_sum = self.image_of_tiles(0.0)
            for tiles, _, weight in self.steps():
                gate_sum[tiles] += weight.sum(1)
            self.wide = gate_sum < resolve_faint_below(self.mode, settings.faint_below)

    def image_of_tiles(self, value: float) -> torch.Tensor:
        """Returns [tiles, 16, 16] of one value, int64 where it is an int."""
        return torch.full((self.rows * self.columns, TILE, TILE), value, device=self.gates.device,
                          dtype=torch.int64 if isinstance(value, int) else self.gates.dtype)

    def tiled(self, image: torch.Tensor) -> torch.Tensor:
        """Returns an image [H, W] as [tiles, 16, 16], with zeros beyond it."""
        image = pad(image, (0, self.columns * TILE - self.width, 0, self.rows * TILE - self.height))
        return image.reshape(self.rows, TILE, self.columns, TILE).transpose(1, 2).reshape(-1, TILE, TILE)

    def untiled(self, tiles: torch.Tensor) -> torch.Tensor:
        """Returns what `tiled` takes."""
        image = tiles.unflatten(0, (self.rows, self.columns)).transpose(1, 2)
        return image.reshape(self.rows * TILE, self.columns * TILE)[:self.height, :self.width]

    def steps(self) -> Iterator[Tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Yields, front to back: tiles [n], which Gaussians are next in each [n, 8], their weights [n, 8, 16, 16].

        The tiles' lists are walked side by side. Beyond the end of a list weights are 0.
        """
        gates, columns = self.gates, self.columns
        place = torch.arange(TILE, device=gates.device)
        transmittance = self.image_of_tiles(1.0)
        counts = torch.bincount(self.tile_of, minlength=self.rows * columns)
        begins = counts.cumsum(0) - counts
        for seen in range(0, int(counts.max()), STEP):
            unfinished = counts > seen
            if self.mode != "smoe_std":
                unfinished &= transmittance.flatten(1).amax(1) >= FULL
            tiles = unfinished.nonzero()[:, 0]
            at = begins[tiles, None] + seen + torch.arange(STEP, device=gates.device)
            listed = at < (begins + counts)[tiles, None]
            which = self.places[at.clamp(max=len(self.places) - 1)]
            x, y, xx, xy, yy, opacity, reach, _ = gates[which][..., None].unbind(2)  # [tiles, STEP, 1]
            dx = (tiles % columns * TILE)[:, None, None] + place - x
            dy = ((tiles // columns * TILE)[:, None, None] + place - y)[..., None]
            squared = (2 * xy * dx)[:, :, None] * dy + (xx * dx * dx)[:, :, None] + yy[..., None] * dy * dy
            alpha = torch.exp(-0.5 * squared).mul_((opacity * listed[..., None])[..., None]).clamp_(max=0.99)
            alpha.masked_fill_((squared > reach[..., None]) | (squared < 0), 0)
            if self.wide is not None:
                core = torch.clamp(2 * torch.log(opacity * 1020), max=9)  # within 3 sigma
                near = torch.maximum(2 * torch.log(opacity * 255), core)[..., None]
                alpha.masked_fill_((squared > near) & ~self.wide[tiles, None], 0)
            if self.mode == "smoe_std":
                weight = alpha
            else:
                before = transmittance[tiles, None]
                behind = torch.cumprod(1 - alpha, 1).mul_(before)
                weight = alpha * torch.cat([before, behind[:, :-1]], 1)
                weight.masked_fill_(behind < FULL, 0)
                transmittance[tiles] = behind[:, -1]
            yield tiles, self.order[which], weight


@torch.no_grad()
def weights_of(settings: Settings, inputs: Dict[str, Any]) -> torch.Tensor:
    """Returns the sum of the weights of each pixel [H, W]."""
    walk = Walk(settings, inputs)
    summed = walk.image_of_tiles(0.0)
    for tiles, _, weight in walk.steps():
        summed[tiles] += weight.sum(1)
    return walk.untiled(summed)


@torch.no_grad()
def median_of(settings: Settings, inputs: Dict[str, Any], total: torch.Tensor) -> torch.Tensor:
    """Returns the Gaussian in which the weights of a pixel, front to back, reach half of `total` [H, W]; -1: none does.

    total: by what the weights of the pixel are divided, that of the background among them.
    """
    walk = Walk(settings, inputs)
    half = walk.tiled(total / 2)
    half = half.masked_fill(half <= 0, float("inf"))
    median, summed = walk.image_of_tiles(-1), walk.image_of_tiles(0.0)
    for tiles, which, weight in walk.steps():
        sums = weight.cumsum(1) + summed[tiles, None]
        reaches = sums >= half[tiles, None]
        index = reaches.to(torch.int8).argmax(1)  # the first one
        found = which.gather(1, index.flatten(1)).reshape(index.shape)
        median[tiles] = torch.where(reaches.any(1) & (median[tiles] < 0), found, median[tiles])
        summed[tiles] = sums[:, -1]
    return walk.untiled(median)


def _lists(footprints: Footprints, grid: torch.Tensor, within_radius: bool) -> Tuple[torch.Tensor, ...]:
    """Returns the visible Gaussians, nearest first, and of sorted pairs the tile and the place in that order.

    within_radius: a Gaussian is only in tiles that the square of its radius meets, as Inria's rule has it.
    """
    visible = footprints.radii.nonzero()[:, 0]
    order = visible[footprints.gates[visible, 7].sort(stable=True).indices]
    gates, radii = footprints.gates[order], footprints.radii[order, None]
    determinant = gates[:, 2] * gates[:, 4] - gates[:, 3] ** 2
    reach = (gates[:, [4, 2]] / determinant[:, None] * gates[:, 6:7].clamp(min=0)).sqrt() + 1
    reach = torch.minimum(reach, radii.to(reach)) if within_radius else reach
    zero = torch.zeros_like(grid)
    first = ((gates[:, :2] - reach) / TILE).floor().long().clamp(zero, grid)
    past = ((gates[:, :2] + reach + TILE - 1) / TILE).floor().long().clamp(zero, grid)
    size = (past - first).clamp(min=0)
    number = size.prod(1)
    place = torch.arange(len(order), device=order.device).repeat_interleave(number)
    inside = torch.arange(len(place), device=order.device) - (number.cumsum(0) - number)[place]
    tile = first[place, 0] + inside % size[place, 0] + (first[place, 1] + inside // size[place, 0]) * grid[0]
    tile, by_tile = tile.sort(stable=True)
    return order, tile, place[by_tile]
