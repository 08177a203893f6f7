"""The trainable Gaussians: raw parameters and their activations."""
from __future__ import annotations

import math
from typing import Dict, Optional, Tuple

import torch

from diff_smoe_rasterization.gaussians import activate, quaternion_to_matrix
from diff_smoe_rasterization.lazy_adam import LazyAdam
from diff_smoe_rasterization.neighbors import distCUDA2

from .scenes.pointcloud import SH_C0, PointCloud

INITIAL_OPACITY = 0.1
LARGEST_LOG = 88.7  # exp of more is infinite in float32
MIN_SQUARED_DISTANCE = 1e-7  # of coinciding points, so that log scales stay finite

PARAMETERS = ("means3D", "dc", "shs", "opacities", "scales", "rotations")
"""The raw parameters: shapes [N, 3], [N, 1, 3], [N, K-1, 3], [N, 1] logits, [N, 3] logs, [N, 4] unnormalised."""


def inverse_sigmoid(x: torch.Tensor) -> torch.Tensor:
    """log(x / (1 - x))"""
    return torch.log(x / (1 - x))


def rotation_matrices(rotations: torch.Tensor) -> torch.Tensor:
    """[N, 3, 3] of quaternions (w, x, y, z) of any length [N, 4]."""
    return quaternion_to_matrix(torch.nn.functional.normalize(rotations))


def are_numbers(name: str, values: torch.Tensor) -> torch.Tensor:
    """Whether each value of a raw parameter can be used: finite, a log scale also by its exponential."""
    return values < LARGEST_LOG if name == "scales" else values.isfinite()


def finite_rows(raw: Dict[str, torch.Tensor]) -> torch.Tensor:
    """[N] bool: the Gaussians that can be shown: every number of theirs can be used."""
    rows = [are_numbers(name, tensor.detach()).flatten(1).all(1) for name, tensor in raw.items()]
    return torch.stack(rows).all(0)


class GaussianModel:
    """N Gaussians as leaf tensors. GaussianOptimizer (optimizer.py) steps them, adds and removes rows."""

    def __init__(self, raw: Dict[str, torch.Tensor], sh_degree: int) -> None:
        """raw: tensors named in PARAMETERS. sh_degree: highest degree that `shs` holds."""
        self.sh_degree = sh_degree
        self.active_sh_degree = 0
        self.stored = {name: raw[name].detach().clone().contiguous().requires_grad_() for name in PARAMETERS}
        """The raw parameters; some rows of spherical harmonics may wait for steps of `lazy`."""
        self.lazy: Optional[LazyAdam] = None

    @classmethod
    def from_points(cls, points: PointCloud, sh_degree: int, device: str) -> GaussianModel:
        """Initialises as 3DGS: round Gaussians as wide as the distance to their neighbours, opacity 0.1."""
        count = len(points.positions)
        positions = torch.tensor(points.positions, device=device)
        log_scales = distCUDA2(positions).clamp(min=MIN_SQUARED_DISTANCE).sqrt().log()
        rotations = torch.zeros(count, 4, device=device)
        rotations[:, 0] = 1
        return cls({
            "means3D": positions.float(),
            "dc": ((torch.tensor(points.colors, device=device) - 0.5) / SH_C0).float().unsqueeze(1),
            "shs": torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3, device=device),
            "opacities": inverse_sigmoid(torch.full((count, 1), INITIAL_OPACITY, device=device)),
            "scales": log_scales.float().unsqueeze(1).repeat(1, 3),
            "rotations": rotations,
        }, sh_degree)

    @classmethod
    def from_gaussians(cls, raw: Dict[str, torch.Tensor], sh_degree: int) -> GaussianModel:
        """Trained Gaussians, with all harmonics active, cut or filled with 0 to sh_degree."""
        shs, bands = raw["shs"], (sh_degree + 1) ** 2 - 1
        there = shs.shape[1]
        filled = torch.cat([shs[:, :bands], shs.new_zeros(len(shs), max(0, bands - there), 3)], 1)
        model = cls({**raw, "shs": filled}, sh_degree)
        model.active_sh_degree = min(sh_degree, math.isqrt(there + 1) - 1)
        return model

    @property
    def raw(self) -> Dict[str, torch.Tensor]:
        """The raw parameters by name, brought up to date."""
        if self.lazy is not None:
            self.lazy.catch_up()
        return self.stored

    @property
    def num_gaussians(self) -> int:
        return self.stored["means3D"].shape[0]

    def activated(self) -> Tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Opacities [N, 1] in (0, 1), scales [N, 3] in world units, and rotations [N, 4], unit quaternions."""
        return activate(self.stored["opacities"], self.stored["scales"], self.stored["rotations"])

    @property
    def opacities(self) -> torch.Tensor:
        """[N, 1] in (0, 1)"""
        return self.activated()[0]

    @property
    def scales(self) -> torch.Tensor:
        """[N, 3] world units"""
        return self.activated()[1]

    @property
    def rotations(self) -> torch.Tensor:
        """[N, 4] unit quaternions"""
        return self.activated()[2]

    def color_arguments(self) -> Dict[str, torch.Tensor]:
        """The colour arguments of `rasterize`; while degree 0 is active the higher bands are left out."""
        raw = self.raw
        return {name: raw[source] for name, source in self.color_sources().items()}

    def color_sources(self) -> Dict[str, str]:
        """The parameters that are the colour arguments of `rasterize`, by these."""
        return {"shs": "dc"} if self.active_sh_degree == 0 else {"dc": "dc", "shs": "shs"}

    def raise_sh_degree(self) -> None:
        """Activates one more SH degree, up to the highest."""
        self.active_sh_degree = min(self.active_sh_degree + 1, self.sh_degree)
