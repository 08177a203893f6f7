"""The dense baseline of benchmarks/ does the work of the reference, or its time would compare with nothing."""
from __future__ import annotations

import os
import sys

import pytest
import torch
from scenes import assert_not_empty, gradients, random_scene

from diff_smoe_rasterization.reference import rasterize as reference_rasterize
from diff_smoe_rasterization.settings import BLEND_MODES

sys.path.insert(0, os.path.join(os.path.dirname(__file__), "..", "..", "benchmarks", "timing"))
import dense_torch  # noqa: E402

# Same formulas in float64, other order of sums: 1e-16 a term, grown by sums of about 1e2 terms and by 1/(1 - alpha) of
# at most 1e2 a pair, which leaves four digits of room below a wrong term.
TOLERANCE = 1e-9


def compare(mode, gate=None, **scene_options):
    scene = random_scene(mode, **scene_options)
    scene = scene._replace(settings=scene.settings._replace(background_gate=gate))
    expected, expected_gradients = gradients(reference_rasterize, scene, camera=False)
    assert_not_empty(expected, scene.settings)

    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "means2D"}
    generator = torch.Generator().manual_seed(1)
    dL_dcolor = torch.randn(expected.color.shape, generator=generator, dtype=torch.float64)
    image, values = dense_torch.rasterize_with_gradients(inputs, scene.settings, dL_dcolor)
    torch.testing.assert_close(image, expected.color.detach(), rtol=TOLERANCE, atol=TOLERANCE)
    for name, value in values.items():
        scale = expected_gradients[name].abs().max()
        assert scale > 0, name
        assert (value - expected_gradients[name]).abs().max() <= TOLERANCE * scale, name

    rendered, none = dense_torch.rasterize_with_gradients(inputs, scene.settings)
    assert none is None
    assert torch.equal(rendered, image)


@pytest.mark.parametrize("mode, gate", [*((mode, None) for mode in BLEND_MODES), ("smoe_eq7", 0.05)])
def test_image_and_gradients_are_those_of_the_reference(mode, gate):
    compare(mode, gate)


@pytest.mark.parametrize("mode", ["alpha", *(pytest.param(mode, marks=pytest.mark.slow) for mode in BLEND_MODES[1:])])
def test_pixels_that_saturate_stop_where_the_reference_stops(mode):
    compare(mode, num_gaussians=300, opacity=(0.9, 1.2), scale=0.3, seed=3)


@pytest.mark.parametrize("mode", ("alpha", "smoe"))
def test_precomputed_inputs_and_other_options(mode):
    compare(mode, channels=5, covariance="cov3D", antialiasing=True, alpha_min=0.01, seed=5)


def test_a_scene_out_of_sight_is_background():
    scene = random_scene("smoe")
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "means2D"}
    inputs["means3D"] = inputs["means3D"] - 100 * scene.settings.viewmatrix[:3, 2]
    image, values = dense_torch.rasterize_with_gradients(inputs, scene.settings, torch.ones(3, 37, 50).double())
    assert torch.equal(image, scene.settings.bg[:, None, None].expand_as(image))
    assert all((value == 0).all() for value in values.values())
