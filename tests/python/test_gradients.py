"""The package against finite differences in float64: all modes, all inputs, and the optional outputs.

Every scene keeps its pairs away from the thresholds of its mode, where the image jumps and has no derivative, and its
opacities under 0.99, where the gradient is passed straight through a clamp.
"""
from __future__ import annotations

import pytest
import torch
from comparison import threshold_margin
from devices import on_the_cpu
from scenes import random_scene, with_gate

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
    scene = random_scene(mode, 8, 20, 18, seed=3, scale=0.4, opacity=(0.1, 0.9), **CASES[case])
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
    scene = random_scene(mode, 4, 9, 8, seed=5, scale=0.5, opacity=(0.2, 0.8), degree=1)
    assert threshold_margin(scene).min() > 1e-4
    scene = scene.requiring_grad(camera=False)
    leaves = {name: leaf for name, leaf in scene.leaves().items() if name != "means2D"}

    def function(*tensors):
        tensors = dict(zip(leaves, tensors))
        settings = scene.settings._replace(background_gate=tensors.pop("background_gate", None))
        return diff_smoe_rasterization.rasterize(settings=settings, **tensors).color

    check_gradients(function, leaves, device)
