"""What a viewer shows for a camera: colour, gates, depth or coverage, in one blend or in two side by side."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import torch

from diff_smoe_rasterization.settings import GATED_MODES, resolve_background_gate

from ..inspection import to_image
from ..results.rendering import Renderer
from ..results.rows import blend_name
from ..scenes.cameras import Camera

SHOWN = ("colour", "gates", "largest gate", "depth", "coverage")
LINE = (255, 255, 255)  # between two blends


@dataclass(frozen=True)
class Blend:
    """By which equation a picture is made."""

    mode: str  # one of BLEND_MODES
    background_gate: float = 0.0  # of GATED_MODES; the other modes have their own

    @classmethod
    def of(cls, renderer: Renderer) -> Blend:
        """The one that a model was trained with."""
        gate = float(renderer.background_gate) if renderer.blend_mode in GATED_MODES else 0.0
        return cls(renderer.blend_mode, gate)

    def __str__(self) -> str:
        return blend_name(self.mode, self.background_gate)


@dataclass(frozen=True)
class Look:
    """What a viewer is asked to show."""

    blend: Blend
    # One of SHOWN; gates: each Gaussian in a colour of its own, blended; largest gate: not blended, the gate map.
    shown: str = "colour"
    beside: Optional[Blend] = None  # right of the split
    split: float = 0.5  # of the width


@torch.no_grad()
def picture(renderer: Renderer, camera: Camera, look: Look) -> np.ndarray:
    """The picture [H, W, 3] uint8 of a renderer's model. Raises ValueError for a background gate that is none."""
    left = _of_blend(renderer, camera, look.blend, look.shown)
    if look.beside is None:
        return left
    right = _of_blend(renderer, camera, look.beside, look.shown)
    column = min(max(round(look.split * camera.width), 0), camera.width)
    both = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    both[:, max(column - 1, 0):column + 1] = LINE
    return both


def _of_blend(renderer: Renderer, camera: Camera, blend: Blend, shown: str) -> np.ndarray:
    gate = blend.background_gate if blend.mode in GATED_MODES else resolve_background_gate(blend.mode, None)
    own = Renderer(renderer.model, blend.mode, renderer.background, renderer.antialiasing, renderer.rasterize,
                   background_gate=gate,
                   faint_below=renderer.faint_below if blend.mode == renderer.blend_mode else None)
    if shown == "gates":
        image = own(camera, colors_precomp=own_colours(renderer.model.num_gaussians).to(renderer.background)).color
    elif shown == "largest gate":
        image = _gate_map(own, camera)
    elif shown == "depth":
        image = near_is_bright(own(camera, outputs=("depth",)).depth).expand(3, -1, -1)
    elif shown == "coverage":
        image = own(camera, outputs=("alpha",)).alpha.expand(3, -1, -1)
    else:
        image = own(camera).color
    return np.asarray(to_image(image)).copy()


def _gate_map(renderer: Renderer, camera: Camera) -> torch.Tensor:
    """[3, H, W] the colour of the Gaussian with the largest gate, and the background if none is open."""
    _, splats = renderer.with_splats(camera)
    colours = torch.cat([own_colours(renderer.model.num_gaussians).to(renderer.background),
                         renderer.background[None]])
    return colours[splats.gate_map().gaussians.long()].permute(2, 0, 1)  # -1 is the last row


def own_colours(count: int) -> torch.Tensor:
    """[count, 3] colours in [0, 1], spread evenly by a low-discrepancy sequence; always the same."""
    root = 1.22074408460575947536  # of x^4 = x + 1: Roberts' sequence in three dimensions
    steps = torch.tensor([root**-1, root**-2, root**-3], dtype=torch.float64)
    return ((torch.arange(count, dtype=torch.float64)[:, None] + 1) * steps % 1).float()


def near_is_bright(depth: torch.Tensor) -> torch.Tensor:
    """Grey of depths [1, H, W]: 1 at the nearest percent, falling to 0.1 at the farthest, and 0 if nothing is."""
    hit = depth > 0
    if not hit.any():
        return torch.zeros_like(depth)
    near, far = torch.quantile(depth[hit][::max(1, int(hit.sum()) // 100_000)], depth.new_tensor([0.01, 0.99]))
    bright = 1 - (depth - near) / (far - near).clamp(min=1e-6)
    return torch.where(hit, bright.clamp(0.1, 1), torch.zeros_like(depth))
