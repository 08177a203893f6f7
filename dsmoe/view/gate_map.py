"""The gate map: of each pixel the Gaussian with the largest gate, the paper's Figure 10. By the reference's stages."""
from __future__ import annotations

from typing import Any, Iterator, List, Tuple

import torch

from diff_smoe_rasterization import reference
from diff_smoe_rasterization.settings import GaussianRasterizationSettings, leaves_out_faint, resolve_faint_below

from ..model import GaussianModel

BLOCK = 32  # px; pixels are taken in squares of this side
CHUNK = 128  # Gaussians of a block, at once


@torch.no_grad()
def largest_gates(model: GaussianModel, settings: GaussianRasterizationSettings) -> torch.Tensor:
    """[H, W] int64: the Gaussian whose weight in the numerator of the pixel's colour is largest, -1 where none counts.

    settings: of the rendering, blend mode and background gate among them; the background is no candidate.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # its tensors are so small that threads would only wait for each other
    try:
        return _by_blocks(model, settings)
    finally:
        torch.set_num_threads(threads)


def _by_blocks(model: GaussianModel, settings: GaussianRasterizationSettings) -> torch.Tensor:
    mode, gate = reference.mode_and_gate(settings)
    opacities, scales, rotations = model.activated()
    means, unused = model.raw["means3D"].detach(), torch.zeros_like(model.raw["means3D"])
    gaussians = reference.Gaussians(means, unused, opacities.reshape(-1), None, unused, scales, rotations, None)
    _, order = reference.visible(gaussians, settings, mode)
    splats = reference.project(_rows(gaussians, order), settings)
    width, height = settings.image_width, settings.image_height

    def near(splats: Any, left: int, top: int, right: int, bottom: int) -> torch.Tensor:
        return reference.footprint_meets(splats, left, top, right - 1, bottom - 1, settings, mode, slack=1.0)

    bands: List[torch.Tensor] = []
    for top in range(0, height, BLOCK):
        bottom = min(top + BLOCK, height)
        in_band = near(splats, 0, top, width, bottom)
        band, band_order, blocks = _rows(splats, in_band), order[in_band], []
        for left in range(0, width, BLOCK):
            right = min(left + BLOCK, width)
            in_block = near(band, left, top, right, bottom)
            blocks.append(_largest(_rows(band, in_block), band_order[in_block], left, top, right, bottom, settings,
                                   mode, gate))
        bands.append(torch.cat(blocks, dim=1))
    return torch.cat(bands)


def _largest(splats: Any, order: torch.Tensor, left: int, top: int, right: int, bottom: int,
             settings: GaussianRasterizationSettings, mode: str, gate: Any) -> torch.Tensor:
    """[bottom - top, right - left] of one block. The Gaussians come nearest first, and no weight is above the
    transmittance in front of it: where that has fallen to the largest weight so far, the rest cannot win."""
    x = torch.arange(left, right).to(order.device).repeat(bottom - top).to(splats.depth)
    y = torch.arange(top, bottom).to(order.device).repeat_interleave(right - left).to(splats.depth)
    largest, which = torch.zeros_like(x), torch.full_like(x, -1, dtype=torch.int64)

    def chunks(wide: torch.Tensor) -> Iterator[Tuple[int, torch.Tensor, torch.Tensor]]:
        """Yields where a chunk begins, the weights of its pairs, and the transmittance behind it, front to back."""
        transmittance = torch.ones_like(x)
        for begin in range(0, len(order), CHUNK):
            chunk = _rows(splats, slice(begin, begin + CHUNK))
            counts = reference.pair_counts(chunk, x, y, settings, mode, gate)
            if not wide.all():
                counts &= reference.near_pairs(chunk, x, y, counts) | wide
            alpha = reference.pair_alphas(chunk, x, y, counts)
            # What is in front counts as one pair that lets so much through.
            weight, stopped = reference.numerator(torch.cat([(1 - transmittance)[None], alpha]), mode)
            transmittance = transmittance * (1 - alpha).prod(dim=0).masked_fill(stopped.any(dim=0), 0)
            yield begin, weight[1:], transmittance

    wide = torch.ones_like(x, dtype=torch.bool)
    if leaves_out_faint(mode, settings.faint_below):
        gate_sum, least = torch.zeros_like(x), resolve_faint_below(mode, settings.faint_below)
        for _, weight, _ in chunks(~wide):
            gate_sum += weight.sum(0)
            if (gate_sum >= least).all():
                break
        wide = gate_sum < least
    for begin, weight, transmittance in chunks(wide):
        best, row = weight.max(dim=0)
        better = best > largest
        largest = torch.where(better, best, largest)
        which = torch.where(better, order[begin + row], which)
        if mode != "smoe_std" and (transmittance <= largest).all():
            break
    return which.view(bottom - top, right - left)


def _rows(table: Any, index: torch.Tensor) -> Any:
    return type(table)(*(None if column is None else column[index] for column in table))
