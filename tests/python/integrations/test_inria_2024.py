"""What the flavour of 2024 adds: inverse depth, antialiasing, `dc`, the sparse optimizer and the loss."""
from __future__ import annotations

import math

import pytest
import torch
from comparison import assert_all_close, assert_close, reference_gradients
from devices import random_normal
from scenes import gradients, random_scene

from diff_smoe_rasterization import Rendering
from diff_smoe_rasterization.integrations import inria_2024
from diff_smoe_rasterization.integrations.inria_2024 import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    SparseGaussianAdam,
    fused_ssim,
)

pytestmark = pytest.mark.usefixtures("device")

# A sum of some thousand terms in float64, each with some hundred roundings of 1e-16.
TOLERANCE = 1e-12


def render(settings, outputs, **inputs):
    color, radii, inverse_depth = GaussianRasterizer(raster_settings=settings)(**inputs)
    return Rendering(color, radii, inverse_depth=inverse_depth)


def assert_is_the_reference(scene):
    rendering, actual = gradients(render, scene, outputs=("inverse_depth",))
    expected_rendering, expected = reference_gradients(scene, outputs=("inverse_depth",))
    assert_close(rendering.color, expected_rendering.color, TOLERANCE, "color")
    assert_close(rendering.inverse_depth, expected_rendering.inverse_depth, TOLERANCE, "inverse depth")
    assert_all_close(actual, expected, TOLERANCE)
    return rendering


def test_what_the_trainer_imports_is_here():
    assert set(inria_2024.__all__) == {"GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam",
                                       "compute_relocation", "fused_ssim", "rasterize_gaussians"}
    for name in inria_2024.__all__:
        assert getattr(inria_2024, name)


def test_inverse_depth_and_its_gradient_are_the_references(mode):
    rendering = assert_is_the_reference(random_scene(mode, 60, 45, 30, seed=11))
    assert rendering.inverse_depth.shape == (1, 30, 45)


def test_inverse_depth_is_not_normalised_in_alpha_and_is_in_smoe():
    """One faint Gaussian straight ahead, at depth z: sum(w / z) is alpha / z, and divided by sum(w) it is 1 / z."""
    for mode in ("alpha", "smoe"):
        scene = random_scene(mode, 1, 33, 33).with_inputs(
            means3D=torch.zeros(1, 3, dtype=torch.float64), opacities=torch.full((1, 1), 0.25, dtype=torch.float64),
            scales=torch.full((1, 3), 0.5, dtype=torch.float64))
        depth = scene.settings.viewmatrix[3, 2].item()
        inverse_depth = render(scene.settings, (), **scene.inputs).inverse_depth[0, 16, 16].item()
        # The camera looks at the Gaussian's centre, which is the centre of this pixel but for the 1e-7 added to w and
        # for the matrices' rounding to float32: G is 1 to the square of that.
        assert inverse_depth == pytest.approx((0.25 if mode == "alpha" else 1.0) / depth, rel=1e-9)


@pytest.mark.parametrize("antialiasing", [False, True])
def test_antialiasing_is_a_setting(mode, antialiasing):
    scene = random_scene(mode, 60, 45, 30, seed=12, scale=0.02).with_settings(antialiasing=antialiasing)
    rendering = assert_is_the_reference(scene)
    other = render(scene.settings._replace(antialiasing=not antialiasing), (), **scene.inputs)
    assert torch.equal(rendering.radii, other.radii)
    assert (rendering.color - other.color).abs().max() > 0.01


def test_antialiasing_follows_debug():
    values = random_scene("alpha", 1).settings[:12]
    assert GaussianRasterizationSettings(*values, True).antialiasing is True


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_dc_may_come_apart_from_the_other_coefficients(mode, degree):
    """At degree 0 the trainer passes shs of shape [N, 0, 3]."""
    scene = random_scene(mode, 60, 45, 30, seed=13, degree=degree, split_dc=True)
    assert scene.inputs["dc"].shape == (60, 1, 3) and scene.inputs["shs"].shape == (60, (degree + 1) ** 2 - 1, 3)
    split = render(scene.settings, (), **scene.inputs)
    i = scene.inputs
    positional = GaussianRasterizer(scene.settings)(i["means3D"], i["means2D"], i["opacities"], i["dc"], i["shs"], None,
                                                    i["scales"], i["rotations"])
    assert torch.equal(positional[0], split.color) and torch.equal(positional[2], split.inverse_depth)
    joint = {**scene.inputs, "shs": torch.cat([i["dc"], i["shs"]], 1), "dc": None}
    assert torch.equal(render(scene.settings, (), **joint).color, split.color)
    if degree > 0:
        assert_is_the_reference(scene)


def test_shs_in_the_place_of_dc_is_an_error():
    scene = random_scene("alpha", 60, 45, 30, degree=1)
    i = scene.inputs
    with pytest.raises(ValueError, match="dc"):
        GaussianRasterizer(scene.settings)(i["means3D"], i["means2D"], i["opacities"], i["shs"], None, None,
                                           i["scales"], i["rotations"])


def test_the_sparse_optimizer_steps_what_the_view_saw(mode):
    """The calls of the trainer: render with dc, loss.backward, then step(radii > 0, N)."""
    scene = random_scene(mode, 60, 45, 30, seed=14, degree=1, split_dc=True, dtype=torch.float32)
    start = {name: tensor.clone() for name, tensor in scene.inputs.items() if name != "means2D"}
    parameters = {name: tensor.clone().requires_grad_(True) for name, tensor in start.items()}
    rate, epsilon = 0.01, 1e-15
    optimizer = SparseGaussianAdam([{"params": [tensor], "lr": rate, "name": name}
                                    for name, tensor in parameters.items()], lr=0.0, eps=epsilon)
    color, radii, _ = GaussianRasterizer(scene.settings)(means2D=scene.inputs["means2D"], **parameters)
    color.mean().backward()
    gradient = {name: tensor.grad.clone() for name, tensor in parameters.items()}
    visible = radii > 0
    assert visible.any() and not visible.all()
    optimizer.step(visible, radii.shape[0])
    for name, tensor in parameters.items():
        assert torch.equal(tensor[~visible], start[name][~visible]), name
        # The first step without bias correction: 0.1 g over the root of 0.001 g^2.
        moved = gradient[name].abs() > 1e-8  # under it, epsilon is no longer small beside the root
        step = (start[name] - tensor.detach())[moved]
        expected = rate * 0.1 / math.sqrt(0.001) * gradient[name][moved].sign()
        assert moved.any()
        # float32: the step is what is left of numbers up to 4, each rounded by 2.4e-7.
        assert (step - expected).abs().max() < 1e-6, name


def test_fused_ssim_is_called_as_the_trainer_calls_it():
    """The mean of an image with itself is 1; a constant against another constant has a closed form."""
    image = random_normal((3, 24, 31), seed=15).sigmoid().float().requires_grad_(True)
    value = fused_ssim(image.unsqueeze(0), image.detach().unsqueeze(0))
    assert value.shape == () and value.item() == pytest.approx(1, abs=1e-6)  # float32
    (1 - value).backward()
    assert image.grad.shape == (3, 24, 31)
    one, other = torch.full((1, 3, 40, 40), 0.3), torch.full((1, 3, 40, 40), 0.6)
    # Inside, variances are 0: (2 a b + c1) / (a^2 + b^2 + c1), c1 = 0.01^2.
    expected = (2 * 0.3 * 0.6 + 1e-4) / (0.3 ** 2 + 0.6 ** 2 + 1e-4)
    # Variances come out as differences of squares, rounded by 6e-8, and c2 = 9e-4 divides them: 1e-4.
    assert fused_ssim(one, other, padding="valid").item() == pytest.approx(expected, rel=1e-3)
