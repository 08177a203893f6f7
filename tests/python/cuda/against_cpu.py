"""How a GPU's results are compared with the CPU backend's in float64, on the same numbers."""
from __future__ import annotations

from typing import NamedTuple

import torch
from comparison import assert_all_close
from devices import random_normal

from diff_smoe_rasterization import rasterize


class Tolerance(NamedTuple):
    """What rounding may do to one scene."""

    pixel: float  # of a pixel, relative to the image's largest value
    gradient: float  # of a gradient, in the 2-norm, relative to its norm
    flipped: float = 0.0  # part of the pixels that may show another outcome of a threshold


# exp and fused multiply-adds round otherwise than the CPU's; 1e-16 each, in sums of up to 1e4 terms that cancel.
FLOAT64 = Tolerance(1e-11, 1e-11)
# A position of some hundred pixels is rounded by 3e-5, which can change the alpha of the smallest splats (0.55 px) by
# 2e-4 of itself, a part of a pixel. In a gradient, sums of thousands of terms that cancel multiply 6e-8 by 1e3.
# A pair within rounding of a threshold may count on only one side; such pixels are counted, and take no part.
FLOAT32 = Tolerance(1e-4, 1e-4, 1e-5)
GATE = "background_gate"


class Pass:
    """One rendering that waits for its image gradients."""

    def __init__(self, scene, outputs, camera):
        self.scene = scene.requiring_grad(camera)
        self.rendering = rasterize(settings=self.scene.settings, outputs=outputs, **self.scene.inputs)
        self.images = torch.cat([self.rendering.color] + [getattr(self.rendering, name) for name in outputs])

    def gradients(self, weights):
        """Returns the gradients by name. weights: [images, H, W]"""
        leaves = self.scene.leaves()
        values = torch.autograd.grad(self.images, list(leaves.values()), weights.to(self.images), allow_unused=True)
        return {name: torch.zeros_like(leaf) if value is None else value
                for (name, leaf), value in zip(leaves.items(), values)}


def compare(scene, gpu, dtype, outputs, tolerance, camera=True):
    """Asserts that images, radii and all gradients agree; returns the rendering of the GPU.

    scene: on the CPU, of float32 numbers. camera: whether its gradients are asked for too.
    """
    expected = Pass(scene.to(torch.float64), outputs, camera)
    actual = Pass(scene.to(dtype).to(gpu), outputs, camera)
    compare_radii(actual.rendering.radii.cpu(), expected.rendering.radii)
    wrong = different_pixels(actual.images.detach().cpu().double(), expected.images.detach(), tolerance.pixel)
    # Of a small image one pixel is more than the part that a large one is allowed.
    assert wrong.sum() <= max(tolerance.flipped * wrong.numel(), tolerance.flipped > 0), (
        f"{int(wrong.sum())} of {wrong.numel()} pixels differ")
    weights = random_normal(expected.images.shape, 1) * ~wrong
    found = {name: values.cpu() for name, values in actual.gradients(weights).items()}
    wanted = expected.gradients(weights)
    if GATE in wanted:
        # One number, a sum over pixels that cancels: what is rounded are its terms.
        difference = (found.pop(GATE).double() - wanted.pop(GATE)).abs().item()
        assert difference <= tolerance.gradient * sum_of_gate_terms(scene, outputs, weights)
    assert_all_close(found, wanted, tolerance.gradient)
    return actual.rendering


def sum_of_gate_terms(scene, outputs, weights):
    """The sum of |dL/dlambda| over pixels and images, by differences in float64, of 1e-8 of themselves."""
    gate = scene.settings.background_gate.double()
    images = []
    for value in (1.0001 * gate, 0.9999 * gate):
        settings = scene.to(torch.float64).settings._replace(background_gate=value)
        images.append(Pass(scene.to(torch.float64)._replace(settings=settings), outputs, False).images.detach())
    return float((weights * (images[0] - images[1])).abs().sum() / (2e-4 * gate))


def compare_radii(actual, expected):
    """A radius is the ceiling of a root that float32 rounds by 1e-4 if it is 1000 px: so many may differ by 1."""
    assert actual.dtype == torch.int32
    different = (actual != expected).nonzero()[:, 0]
    assert len(different) <= max(1, 1e-4 * len(expected)), f"{len(different)} of {len(expected)} radii differ"
    assert ((actual - expected).abs() <= 1).all()
    assert ((actual > 0) == (expected > 0)).all()


def different_pixels(actual, expected, tolerance):
    """Returns which pixels [H, W] differ by more than the tolerance, relative to each image's largest value."""
    assert actual.shape == expected.shape and torch.isfinite(actual).all()
    largest = expected.abs().amax((1, 2), keepdim=True)
    return ((actual - expected).abs() > tolerance * largest).any(0)
