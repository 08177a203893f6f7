"""The .spz format of Niantic: compressed, about a tenth of a .ply. The library gsply writes it."""
from __future__ import annotations

import math
import os
import tempfile

import numpy as np

from diff_smoe_rasterization.io import Gaussians

from ..errors import TrainerError
from ..system.process import pip_install
from .rows import rotatable_rows, y_up

# Bits behind the point of a coordinate, which has 24 bits. The fewest reach to 8192 units, in steps of a thousandth.
FEWEST_FRACTIONAL_BITS, MOST_FRACTIONAL_BITS = 10, 20


def check_spz() -> None:
    """Raises TrainerError if this environment cannot write such a file."""
    try:
        import gsply  # noqa: F401
    except ImportError as error:
        raise TrainerError(f"for .spz gsply is needed: {pip_install('gsply')}; it needs Python 3.10 or "
                           "later") from error


def spz_bytes(gaussians: Gaussians) -> bytes:
    """The file's content: version 3, in the axes of OpenGL as its specification says.

    Left out are Gaussians that are not finite, and those whose quaternion is 0. A Gaussian that is too far away for the
    format moves towards the origin and shrinks by the same factor, so it looks the same from there.
    """
    check_spz()
    import gsply

    position, logit, log_scales, rotations, dc, harmonics = rotatable_rows(y_up(gaussians))
    limit = (2**23 - 1) / 2**FEWEST_FRACTIONAL_BITS
    excess = (np.abs(position).max(axis=1, keepdims=True, initial=0) / limit).clip(min=1)
    position, log_scales = position / excess, log_scales - np.log(excess)
    data = gsply.GSData.from_arrays(
        means=position, scales=log_scales, quats=rotations, opacities=logit[:, 0].clip(-30, 30), sh0=dc,
        shN=harmonics.reshape(len(harmonics), -1, 3) if harmonics.shape[1] else None, format="ply")
    with tempfile.TemporaryDirectory() as folder:  # gsply writes to a path only
        path = os.path.join(folder, "model.spz")
        gsply.write_spz(path, data, version=3, fractional_bits=fractional_bits(position))
        with open(path, "rb") as file:
            return file.read()


def fractional_bits(positions: np.ndarray) -> int:
    """How many bits behind the point leave room for the largest coordinate: 23 in all, and a sign."""
    _, before_point = math.frexp(float(np.abs(positions).max(initial=0)))
    return min(max(23 - before_point, FEWEST_FRACTIONAL_BITS), MOST_FRACTIONAL_BITS)
