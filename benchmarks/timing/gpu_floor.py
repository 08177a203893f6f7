"""What a GPU cannot do faster: each stage of the rasterizer by the bytes it must move and the pairs it must walk.

A stage's floor is the larger of
- bytes / BYTES_PER_SECOND: what must be read or written at least once, whatever the algorithm; caches hold nothing; and
- pairs x instructions per pair / INSTRUCTIONS_PER_SECOND: the arithmetic of the formulas of gate.h and blend.h for
  three channels, a multiply-add, an exponential or a reciprocal one instruction each. Loads, loop control, the
  reduction over pixels and what a Gaussian or a pixel needs once count nothing.

Pairs are the (Gaussian, pixel) pairs whose exponent the kernels evaluated, so that evaluating fewer of them lowers the
floor too. Other cards: other constants.
"""
from __future__ import annotations

from typing import Dict, NamedTuple

BYTES_PER_SECOND = 4.2e12
"""H200: a copy by the device reads and writes 4.3e12 bytes a second."""
INSTRUCTIONS_PER_SECOND = 33.4e12
"""H200: 132 multiprocessors x 4 schedulers x 32 lanes x 1.98 GHz, an instruction each a cycle."""

FLOAT = INT = 4
PROJECTED = 8 * FLOAT  # position, conic, depth, opacity of a visible Gaussian
FEATURES = 4 * FLOAT  # colour, padded
RECORD = 10 * FLOAT  # what the blend's backward gives a Gaussian: 6 moments, opacity, 3 colours
SORT_PASSES = 4  # 8 bits of a 32-bit depth each
IMAGE = 3 * FLOAT
STATE = 2 * FLOAT + INT  # gate sum, transmittance, last contributor of a pixel

_EXPONENT = 2  # the quadratic form; what one coordinate gives is shared by a row of pixels
_GATE = _EXPONENT + 1 + 2  # exponential; opacity, clamp
# power <= 0; alpha >= 1/255 or 1/2040, or G and alpha_min
_TESTS = {"alpha": 2, "smoe": 2, "smoe_eq7": 3, "smoe_tn": 3, "smoe_std": 3}
_TRANSMITTANCE = 5  # 1 - alpha; its product with T; its test; weight; T
_SUMS = 3 + 1 + 1  # colour; gate sum; last contributor
FORWARD = {mode: _GATE + tests + _SUMS + (0 if mode == "smoe_std" else _TRANSMITTANCE)
           for mode, tests in _TESTS.items()}

_VALUE = 3  # u = g'.c - b
_TRANSMITTANCE_BACKWARD = 1 + 1 + 1 + 1 + 2 + 1  # 1 - alpha; reciprocal; T; weight; T u - R / (1 - alpha); suffix
_GRADIENTS = 3 + 1 + 6  # colour; dL/dpower; its moments
BACKWARD = {mode: _GATE + tests + _VALUE + _GRADIENTS + (0 if mode == "smoe_std" else _TRANSMITTANCE_BACKWARD)
            for mode, tests in _TESTS.items()}


class Counts(NamedTuple):
    """What a rendering has to do; means over views."""

    gaussians: float
    visible: float  # with a radius
    instances: float  # (Gaussian, tile) pairs
    pixels: float
    forward_pairs: float  # (Gaussian, pixel)
    backward_pairs: float
    parameter_bytes: float  # of one Gaussian: all that is differentiable


class Floor(NamedTuple):
    """Seconds."""

    bytes: float
    instructions: float

    @property
    def seconds(self) -> float:
        return max(self.bytes, self.instructions)


def floors(mode: str, counts: Counts) -> Dict[str, Floor]:
    """By the names of `stage_times`."""
    position = 3 * FLOAT
    splats = counts.visible * (PROJECTED + FEATURES)
    listed = counts.instances * INT
    blended = listed + splats + counts.pixels * (IMAGE + STATE)
    moved = {
        "project": counts.gaussians * (position + INT) + counts.visible * (counts.parameter_bytes - position) + splats,
        # Histograms read the keys once; every pass reads and writes keys and indices.
        "sort": counts.visible * (INT + SORT_PASSES * 2 * (FLOAT + INT)),
        "bin": counts.visible * PROJECTED + listed,
        "blend": blended,
        "blend_backward": blended + counts.pixels * IMAGE + counts.visible * RECORD,
        # The gradients of culled Gaussians are zeros that are written too.
        "project_backward": counts.visible * (RECORD + PROJECTED + counts.parameter_bytes)
        + counts.gaussians * counts.parameter_bytes,
    }
    walked = {"blend": counts.forward_pairs * FORWARD[mode], "blend_backward": counts.backward_pairs * BACKWARD[mode]}
    return {stage: Floor(amount / BYTES_PER_SECOND, walked.get(stage, 0) / INSTRUCTIONS_PER_SECOND)
            for stage, amount in moved.items()}
