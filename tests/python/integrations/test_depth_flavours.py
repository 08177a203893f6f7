"""The rasterizers that return a depth, or depth and alpha: what these are in each mode, and their gradients."""
from __future__ import annotations

import pytest
import torch
from comparison import assert_close
from devices import random_normal
from scenes import random_scene, with_gates

from diff_smoe_rasterization import rasterize
from diff_smoe_rasterization.integrations import depth, depth_alpha
from diff_smoe_rasterization.integrations.contracts import SETTINGS

pytestmark = pytest.mark.usefixtures("device")

# A sum of some thousand terms in float64, each with some hundred roundings of 1e-16.
TOLERANCE = 1e-11


def drawn_over_black(scene, values):
    """A picture of Gaussians that have these values [N, 1] for colours, over black."""
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name not in ("shs", "colors_precomp")}
    settings = scene.settings._replace(bg=torch.zeros(1, dtype=torch.float64))
    return rasterize(settings=settings, colors_precomp=values, **inputs).color


@with_gates
def test_depth_and_alpha_are_what_is_drawn_over_black(mode):
    """z, and 1, as colours; gradients too. In `smoe_tn`, whose weights do not sum to 1, alpha is 1 where a gate is."""
    scene = random_scene(mode, 30, 33, 21, seed=61, degree=1, scale=0.02).requiring_grad(camera=False)
    color, radii, depth_image, alpha = depth_alpha.GaussianRasterizer(scene.settings)(**scene.inputs)
    points = torch.cat([scene.inputs["means3D"], torch.ones(30, 1, dtype=torch.float64)], 1)
    z, ones = (points @ scene.settings.viewmatrix)[:, 2:3], torch.ones(30, 1, dtype=torch.float64)
    expected = rasterize(settings=scene.settings, **scene.inputs)
    assert torch.equal(color, expected.color) and torch.equal(radii, expected.radii)
    drawn = [drawn_over_black(scene, values) for values in (z, ones)]
    if mode == "smoe_tn":
        drawn[1] = (drawn[1] > 0).to(drawn[1])
    weights = random_normal((2, 1, 21, 33), 62)
    gradients = []
    for images in ((depth_image, alpha), drawn):
        leaves = [scene.inputs[name] for name in ("means3D", "opacities", "scales")]
        gradients.append(torch.autograd.grad((torch.stack(images) * weights).sum(), leaves, retain_graph=True))
    assert (alpha == 0).any() and (alpha > 0).any()
    assert_close(depth_image, drawn[0], TOLERANCE, "depth")
    assert_close(alpha, drawn[1], TOLERANCE, "alpha")
    for found, wanted in zip(*gradients):
        assert_close(found, wanted, TOLERANCE, "gradient")


def test_a_second_gradient_of_the_points_on_the_screen_and_a_confidence():
    scene = random_scene("smoe", 30, 33, 21, seed=63, degree=1).requiring_grad(camera=False)
    inputs = dict(scene.inputs)
    _, _, image = depth.GaussianRasterizer(scene.settings)(**inputs)
    expected = torch.autograd.grad(image.sum(), inputs["means2D"])[0]
    densify = torch.zeros_like(inputs["means2D"]).requires_grad_()
    _, _, image = depth.GaussianRasterizer(scene.settings)(**inputs, means2D_densify=densify)
    found = torch.autograd.grad(image.sum(), (inputs["means2D"], densify))
    assert torch.equal(*found) and expected.any()
    assert_close(found[0], expected, TOLERANCE, "means2D")  # a GPU adds in another order each time

    names = ("means3D", "means2D", "shs", "opacities", "scales")
    leaves, confidence = [inputs[name] for name in names], torch.rand(30, 1, dtype=torch.float64)
    found = []
    for given in (None, confidence):
        fields = {name: getattr(scene.settings, name) for name in SETTINGS}
        settings = depth_alpha.GaussianRasterizationSettings(**fields, confidence=given, blend_mode="smoe",
                                                             background_gate=0.1)
        image = depth_alpha.GaussianRasterizer(settings)(**inputs)[0]
        found.append(torch.autograd.grad(image.sum(), leaves))
    for name, plain, scaled in zip(names, *found):
        factor = 1 if name == "means2D" else confidence.reshape(-1, *[1] * (plain.dim() - 1))
        assert_close(scaled, plain * factor, TOLERANCE, name)
        assert plain.any()
