"""The package against finite differences in float64: all modes, all inputs, and the optional outputs.

Every scene keeps its pairs away from the thresholds of its mode, at which the image has no derivative, and its
opacities under 0.99, above which the gradient is passed straight through a clamp.
"""
from __future__ import annotations

import math

import pytest
import torch
from comparison import threshold_margin
from devices import on_the_cpu, random_normal
from scenes import random_scene, with_gate, with_gates, without_tails

import diff_smoe_rasterization
from diff_smoe_rasterization.settings import OUTPUTS

pytestmark = pytest.mark.usefixtures("device")

CASES = {
    "spherical_harmonics": dict(degree=2),
    "split_spherical_harmonics": dict(degree=1, split_dc=True),
    "covariance": dict(degree=0, covariance="cov3D"),
    "colours": dict(channels=3),
    "five_channels": dict(channels=5, covariance="cov3D"),
    "antialiasing": dict(degree=1, antialiasing=True, principal_point=(2.5, -1.5)),
    "unclamped": dict(degree=2, clamp_color=False),
}


def check_gradients(function, leaves, device, **options):
    # On the CPU two runs of the backward agree bit for bit. A GPU sums in any order: 1e-16 of values up to 1e4.
    tolerance = 0.0 if device.type == "cpu" else 1e-10
    with on_the_cpu():  # gradcheck draws its projections there
        assert torch.autograd.gradcheck(function, list(leaves.values()), nondet_tol=tolerance, **options)


@with_gate
@pytest.mark.parametrize("outputs", [(), OUTPUTS], ids=["colour", "all_outputs"])
@pytest.mark.parametrize("case", CASES)
def test_gradients_equal_finite_differences(mode, case, outputs, device):
    scene = without_tails(random_scene(mode, 8, 20, 18, seed=3, scale=0.4, opacity=(0.1, 0.9), **CASES[case]))
    assert threshold_margin(scene).min() > 1e-4  # far more than the step of 1e-6 can cross
    scene = scene.requiring_grad()
    # The value of means2D is ignored, so that it has no finite differences; test_drop_in.py checks its gradient.
    leaves = {name: leaf for name, leaf in scene.leaves().items() if name != "means2D"}

    def function(*tensors):
        tensors = dict(zip(leaves, tensors))
        camera = {name: tensors.pop(name) for name in scene.camera()}
        rendering = diff_smoe_rasterization.rasterize(settings=scene.settings._replace(**camera), outputs=outputs,
                                                      **tensors)
        return (rendering.color,) + tuple(getattr(rendering, name) for name in outputs)

    assert (diff_smoe_rasterization.rasterize(settings=scene.settings, **scene.inputs).radii > 0).sum() >= 5
    # The fast mode compares random projections of both Jacobians, one pair for every input and output.
    check_gradients(function, leaves, device, fast_mode=True)


@with_gate
def test_every_entry_of_the_jacobian(mode, device):
    scene = without_tails(random_scene(mode, 4, 9, 8, seed=5, scale=0.5, opacity=(0.2, 0.8), degree=1))
    assert threshold_margin(scene).min() > 1e-4
    scene = scene.requiring_grad(camera=False)
    leaves = {name: leaf for name, leaf in scene.leaves().items() if name != "means2D"}

    def function(*tensors):
        tensors = dict(zip(leaves, tensors))
        settings = scene.settings._replace(background_gate=tensors.pop("background_gate", None))
        return diff_smoe_rasterization.rasterize(settings=settings, **tensors).color

    check_gradients(function, leaves, device)


@with_gates
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("options", [{}, {"absolute": True}, {"deterministic": True}, {"channels": 5}],
                         ids=["usual", "absolute", "deterministic", "five_channels"])
def test_a_nan_reaches_the_shapes_of_its_pixels_gaussians_alone(mode, options, dtype, device):
    """A pair that does not contribute has no gradient. The colours of Gaussians beside the pixel may be NaN."""
    options = {"channels": 3, **options}
    absolute = options.pop("absolute", False)
    # So faint that no pixel is full, behind which smoe_tn would still count pairs.
    scene = random_scene(mode, 400, 41, 27, scale=0.06, opacity=(0.02, 0.2), dtype=dtype, **options)
    if absolute:
        scene = scene.with_inputs(means2D_abs=torch.zeros(400, 2, dtype=dtype))
    scene = scene.requiring_grad(camera=False)
    rendering, splats = diff_smoe_rasterization.rasterize_with_splats(settings=scene.settings, **scene.inputs)
    pixel = torch.zeros(27, 41, dtype=dtype)
    pixel[13, 21] = 1
    there = splats.contributions(pixel).pixel_weights > 0
    assert 1 < there.sum() < 40
    weights = random_normal(rendering.color.shape, 1, dtype)
    weights[1, 13, 21] = math.nan
    names = ["means3D", "means2D", "opacities", "scales", "rotations"] + ["means2D_abs"] * absolute
    gradient = torch.autograd.grad(rendering.color, [scene.inputs[name] for name in names], weights)
    for name, values in zip(names, gradient):
        assert torch.equal(~torch.isfinite(values).all(1), there), name
