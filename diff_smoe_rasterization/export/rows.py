"""The Gaussians of a model that can be shown."""
from __future__ import annotations

from typing import List

import numpy as np

from ..io import Gaussians
from ..trainer.results.modelfile import finite_gaussians


def finite_rows(gaussians: Gaussians) -> List[np.ndarray]:
    """Positions [M, 3], opacity logits [M, 1], log scales [M, 3], quaternions [M, 4], dc [M, 3] and the other harmonics
    [M, 3 (K - 1)] of the M Gaussians all of whose numbers are finite."""
    arrays = [gaussians.means3D, gaussians.opacity_logits, gaussians.log_scales, gaussians.rotations,
              gaussians.dc[:, 0], gaussians.shs.reshape(len(gaussians.shs), 3 * gaussians.shs.shape[1])]
    finite = finite_gaussians(gaussians)
    return [array[finite] for array in arrays]
