"""Coloured points that Gaussians start from."""
from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..errors import SceneError

SH_C0 = 0.28209479177387814  # value of the constant spherical harmonic, 1 / (2 sqrt(pi)): a colour is 1/2 + SH_C0 dc
MIN_POINTS = 4  # each scale is the distance to three neighbours


@dataclass(frozen=True)
class PointCloud:
    """N coloured points."""

    positions: np.ndarray  # [N, 3] float64, world
    colors: np.ndarray  # [N, 3] float64 in [0, 1]
    measured: bool = True  # of the scene; False: random ones, whose number says nothing of it

    def size_of_subset(self, count: int) -> int:
        """How many points `subset` of this count gives."""
        return min(count or len(self.positions), len(self.positions))

    def subset(self, count: int, seed: int) -> PointCloud:
        """A random choice of `count` points, in their original order; all of them if there are no more."""
        if self.size_of_subset(count) == len(self.positions):
            return self
        chosen = np.sort(np.random.RandomState(seed).choice(len(self.positions), count, replace=False))
        return dataclasses.replace(self, positions=self.positions[chosen], colors=self.colors[chosen])

    def checked(self, source: str) -> PointCloud:
        """Returns self; raises SceneError naming `source` if there are too few points or float32 cannot hold one."""
        if len(self.positions) < MIN_POINTS:
            raise SceneError(f"{source}: {len(self.positions)} points; training needs at least {MIN_POINTS} to start")
        finite = np.isfinite(self.positions).all(axis=1)
        if not finite.all():
            raise SceneError(f"{source}: point {int(np.argmin(finite))} has a coordinate that is NaN or infinite")
        small = (np.abs(self.positions) <= np.finfo(np.float32).max).all(axis=1)
        if not small.all():
            raise SceneError(f"{source}: point {int(np.argmin(small))} has a coordinate that float32 cannot hold")
        return self
