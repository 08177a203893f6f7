"""What flips.py tells apart, on the CPU: float32 against float64, and colours that are wrong."""
from __future__ import annotations

import functools
import os
import sys

import pytest
import torch
from flips import explain

from diff_smoe_rasterization import rasterize

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..", "..", "benchmarks", "timing"))
import models  # noqa: E402

MODES = pytest.mark.parametrize("mode", ["alpha", pytest.param("smoe", marks=pytest.mark.slow)])
CUT = {"alpha": 0.0, "smoe": 1 / 255}


@functools.lru_cache(maxsize=None)
def rendered(mode):
    """A model of small splats in float32 and in float64: images with the sum of the weights, inputs, settings."""
    model = models.synthetic(40_000, 320, 208)
    settings = model.settings(0, mode)._replace(alpha_min=CUT[mode])
    wide = settings._replace(**{name: getattr(settings, name).double()
                                for name in ("bg", "viewmatrix", "projmatrix", "campos")})
    first = rasterize(settings=settings, outputs=("alpha",), **model.inputs)
    second = rasterize(settings=wide, outputs=("alpha",),
                       **{name: tensor.double() for name, tensor in model.inputs.items()})
    return *(torch.cat([image.color, image.alpha]).double() for image in (first, second)), model.inputs, settings


@MODES
def test_float32_flips_and_rounds_and_nothing_else(mode):
    first, second, inputs, settings = rendered(mode)
    different = ((first - second).abs() > 5e-6).any(0)
    counts = explain(first, second, different, inputs, settings, mode)
    assert sum(counts.values()) == different.sum()
    assert counts["flipped"] > 0 and counts["rounded"] > 0 and counts["unexplained"] == 0


@MODES
def test_a_wrong_colour_is_neither(mode):
    """1e-3 is a quarter of what a pair at the cut can bring; few pixels have a close decision that could bring it."""
    first, _, inputs, settings = rendered(mode)
    wrong = torch.zeros(first.shape[1:], dtype=torch.bool)
    wrong[::29, ::23] = True
    counts = explain(first, first + 1e-3 * wrong, wrong, inputs, settings, mode)
    assert counts["unexplained"] >= 0.95 * wrong.sum()
