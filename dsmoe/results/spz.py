"""The .spz format of Niantic: compressed, about a tenth of a .ply. The library gsply writes and reads it."""
from __future__ import annotations

import math
import os
import tempfile

import numpy as np

from diff_smoe_rasterization.io import Gaussians

from ..errors import TrainerError
from ..system.process import pip_install
from .shown import rotatable_rows, y_up

# Bits behind the point of a coordinate, which has 24 bits. The fewest reach to 8192 units, in steps of a thousandth.
FEWEST_FRACTIONAL_BITS, MOST_FRACTIONAL_BITS = 10, 20

LARGEST_LOGIT = 30.0  # of opacities, which the format holds in 8 bits


def check_spz() -> None:
    """Raises TrainerError if this environment can neither write nor read such a file."""
    try:
        import gsply  # noqa: F401
    except ImportError as error:
        raise TrainerError(f"for .spz gsply is needed: {pip_install('gsply')}; it needs Python 3.10 or "
                           "later") from error


def spz_bytes(gaussians: Gaussians) -> bytes:
    """The file's content: version 3, in the axes of OpenGL as its specification says.

    Left out are Gaussians that are not finite, and those whose quaternion is 0. A Gaussian that is too far away for the
    format moves towards the origin and shrinks by the same factor, so it looks the same from there. Raises TrainerError
    if none is left, or without the package gsply.
    """
    check_spz()
    import gsply

    position, logit, log_scales, rotations, dc, harmonics = rotatable_rows(y_up(gaussians))
    limit = (2**23 - 1) / 2**FEWEST_FRACTIONAL_BITS
    excess = (np.abs(position).max(axis=1, keepdims=True, initial=0) / limit).clip(min=1)
    position, log_scales = position / excess, log_scales - np.log(excess)
    data = gsply.GSData.from_arrays(
        means=position, scales=log_scales, quats=rotations, sh0=dc,
        opacities=logit[:, 0].clip(-LARGEST_LOGIT, LARGEST_LOGIT),
        shN=harmonics.reshape(len(harmonics), -1, 3) if harmonics.shape[1] else None, format="ply")
    with tempfile.TemporaryDirectory() as folder:  # gsply writes to a path only
        path = os.path.join(folder, "model.spz")
        gsply.write_spz(path, data, version=3, fractional_bits=fractional_bits(position))
        with open(path, "rb") as file:
            return file.read()


def spz_gaussians(content: bytes) -> Gaussians:
    """What a file holds. Raises TrainerError without gsply, ValueError if it is none."""
    check_spz()
    import gsply

    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "model.spz")
        with open(path, "wb") as file:
            file.write(content)
        try:
            data = gsply.read_spz(path)
        except Exception as error:  # gsply's own, and of zlib
            raise ValueError("gsply cannot read it: " + str(error).replace(f": {path}", "")) from error
    count = len(data.means)
    arrays = {"means3D": data.means, "dc": data.sh0.reshape(count, 1, 3),
              "shs": np.zeros((count, 0, 3)) if data.shN is None else data.shN.reshape(count, -1, 3),
              "opacity_logits": data.opacities.reshape(count, 1).clip(-LARGEST_LOGIT, LARGEST_LOGIT),
              "log_scales": data.scales, "rotations": data.quats}
    return y_up(Gaussians(**{name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}))


def fractional_bits(positions: np.ndarray) -> int:
    """How many bits behind the point leave room for the largest coordinate: 23 in all, and a sign."""
    _, before_point = math.frexp(float(np.abs(positions).max(initial=0)))
    return min(max(23 - before_point, FEWEST_FRACTIONAL_BITS), MOST_FRACTIONAL_BITS)
