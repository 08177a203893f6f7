"""The reference rasterizer against pixels computed by hand; test_reference_rules.py has its single rules.

Its gradients are those of the package (test_against_reference.py), which equal finite differences
(test_gradients.py).
"""
from __future__ import annotations

import math

import pytest
import torch
from by_hand import facing_camera, middle, on_axis
from comparison import assert_all_close, assert_close, one_thread, threshold_margin
from scenes import (
    Scene,
    assert_not_empty,
    blend_of,
    gate_of,
    gradients,
    random_scene,
    random_weights,
    with_gate,
    with_gates,
    without_tails,
)

from diff_smoe_rasterization import reference
from diff_smoe_rasterization.settings import OUTPUTS

EXACT = 1e-12  # float64: the same few operations, written in another order
ALPHA_MAX = float(torch.tensor(0.99))  # the float32 value, as in every scalar type


def render(scene, outputs=()):
    return reference.rasterize(settings=scene.settings, outputs=outputs, **scene.inputs)


@pytest.fixture(autouse=True, scope="module")
def single_threaded():
    with one_thread():
        yield


@with_gates
def test_one_gaussian_by_hand(mode):
    width, depth, opacity, variance, color, bg = 11, 2.0, 0.6, 0.04, [0.9, 0.5, 0.1], [0.1, 0.2, 0.3]
    settings = facing_camera(mode, width, width)
    image = reference.rasterize(settings=settings, outputs=OUTPUTS, **on_axis([depth], [opacity], [color], variance))
    focal = width / 2
    variance2D = variance * (focal / depth) ** 2 + 0.3
    for distance in (0, 1, 2):
        kernel = math.exp(-0.5 * distance ** 2 / variance2D)
        # 1/(w + 1e-7) moves the centre of a Gaussian on the axis by nothing.
        alpha = opacity * kernel
        background = gate_of(mode) * (1 - alpha)
        expected = [(alpha * c + background * b) / (alpha + background) for c, b in zip(color, bg)]
        assert image.color[:, 5, 5 + distance].tolist() == pytest.approx(expected, rel=EXACT)
        share = alpha / (alpha + background) if blend_of(mode) == "smoe" else alpha
        assert image.alpha[0, 5 + distance, 5].item() == pytest.approx(share, rel=EXACT)
        assert image.depth[0, 5, 5 - distance].item() == pytest.approx(depth, rel=EXACT)
        inverse_depth = alpha / depth / (alpha + background)
        assert image.inverse_depth[0, 5, 5 - distance].item() == pytest.approx(inverse_depth, rel=EXACT)
    assert image.radii.tolist() == [math.ceil(3 * math.sqrt(variance2D + math.sqrt(0.1)))]


@with_gates
def test_two_gaussians_by_hand(mode):
    (o1, o2), (c1, c2), bg = (0.7, 0.4), (0.9, 0.2), 0.5
    inputs = on_axis([3.0, 2.0], [o2, o1], [[c2], [c1]])
    image = reference.rasterize(settings=facing_camera(mode, bg=(bg,)), outputs=OUTPUTS, **inputs)
    w1, w2 = o1, o2 * (1 - o1)
    if mode == "smoe_std":
        w1, w2 = o1, o2
    gate_sum = o1 + o2 if mode in ("smoe_tn", "smoe_std") else w1 + w2
    background = gate_of(mode) * (1 - o1) * (1 - o2)
    color = (w1 * c1 + w2 * c2 + background * bg) / (gate_sum + background)
    inverse_depth = (w1 / 2 + w2 / 3) / (gate_sum + background)
    assert middle(image.color) == pytest.approx([color], rel=EXACT)
    share = gate_sum / (gate_sum + background) if blend_of(mode) == "smoe" else gate_sum
    assert middle(image.alpha) == pytest.approx([share], rel=EXACT)
    assert middle(image.depth) == pytest.approx([(w1 * 2 + w2 * 3) / gate_sum], rel=EXACT)
    assert middle(image.inverse_depth) == pytest.approx([inverse_depth], rel=EXACT)


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_second_opaque_gaussian_stops_the_pixel_and_is_excluded(mode, dtype):
    inputs = {name: tensor.to(dtype) for name, tensor in on_axis(
        [1.0, 2.0, 3.0], [2.0, 2.0, 0.5], [[0.8], [0.4], [0.2]]).items()}
    settings = facing_camera(mode, bg=(0.6,))
    a, background = ALPHA_MAX, gate_of(mode) * (1 - ALPHA_MAX)
    expected = {"smoe_tn": a * 0.8 / (2 * a + 0.5), "smoe_std": (a * 0.8 + a * 0.4 + 0.5 * 0.2) / (2 * a + 0.5)}.get(
        mode, (a * 0.8 + background * 0.6) / (a + background))
    color = middle(render(Scene(inputs, settings).to(dtype)).color)
    assert color == pytest.approx([expected], rel=1e-6 if dtype == torch.float32 else EXACT)


def test_the_gradient_passes_straight_through_the_opacity_clamp():
    inputs = on_axis([2.0], [1.5], [[0.9]], variance=1.0)
    inputs["opacities"].requires_grad_(True)
    inputs["cov3D_precomp"].requires_grad_(True)
    image = reference.rasterize(settings=facing_camera("alpha", bg=(0.3,)), **inputs).color[0]
    assert image[3, 5].item() == pytest.approx(ALPHA_MAX * 0.9 + (1 - ALPHA_MAX) * 0.3, rel=EXACT)
    image[3, 5].backward()
    assert inputs["opacities"].grad.item() == pytest.approx(0.9 - 0.3, rel=EXACT)  # G = 1, as without a clamp
    # One pixel beside the centre 1.5 G is clamped too, and dL/dpower = o G dL/dalpha all the same.
    inputs["cov3D_precomp"].grad = None
    variance = (11 / 4) ** 2 + 0.3
    kernel = math.exp(-0.5 / variance)
    assert 1.5 * kernel > ALPHA_MAX
    reference.rasterize(settings=facing_camera("alpha", bg=(0.3,)), **inputs).color[0, 3, 6].backward()
    expected = 1.5 * kernel * (0.9 - 0.3) * 0.5 / variance ** 2 * (11 / 4) ** 2
    assert inputs["cov3D_precomp"].grad[0, 0].item() == pytest.approx(expected, rel=EXACT)


def test_the_weight_sum_is_one_minus_the_transmittance():
    scene = random_scene("alpha", opacity=(0.1, 0.9), channels=1, bg=torch.ones(1))
    black = scene.with_inputs(colors_precomp=torch.zeros_like(scene.inputs["colors_precomp"]))
    image = render(black, ("alpha",))
    assert image.alpha.max() > 0.9
    assert_close(1 - image.color, image.alpha, EXACT, "1 - T")


def test_eq7_is_the_alpha_colour_without_background_over_the_weight_sum():
    # Splats so large that neither cut-off removes a pair.
    scene = random_scene("alpha", 12, 24, 18, scale=5.0, opacity=(0.2, 0.5), channels=3)
    alpha = render(scene, OUTPUTS)
    smoe = render(scene.with_settings(blend_mode="smoe_eq7"), OUTPUTS)
    assert_close(smoe.alpha, alpha.alpha, EXACT, "gate sum")
    background = (1 - alpha.alpha) * scene.settings.bg[:, None, None]
    assert_close(smoe.color * smoe.alpha + background, alpha.color, EXACT, "colour")
    assert_close(smoe.depth, alpha.depth, EXACT, "depth")
    assert_close(smoe.inverse_depth * smoe.alpha, alpha.inverse_depth, EXACT, "inverse depth")


def test_eq7_shows_the_colour_of_a_lone_gaussian_however_faint():
    inputs = on_axis([2.0], [1e-9], [[0.7, 0.1, 0.4]])
    image = reference.rasterize(settings=facing_camera("smoe_eq7", 9, 9), outputs=("alpha",), **inputs)
    touched = image.alpha[0] > 0
    assert image.alpha[touched[None]].min() < 1e-13
    for channel, value in enumerate([0.7, 0.1, 0.4]):
        assert (image.color[channel][touched] - value).abs().max() < 1e-15


def test_without_a_gate_the_background_takes_the_pixel_and_the_gradient():
    inputs = on_axis([2.0], [1e-31], [[0.7, 0.1, 0.4]])
    inputs = {name: tensor.requires_grad_(True) for name, tensor in inputs.items()}
    settings = facing_camera("smoe", 9, 9)
    settings.bg.requires_grad_(True)
    color = reference.rasterize(settings=settings, **inputs).color
    assert torch.equal(color, settings.bg[:, None, None].expand_as(color))
    color.sum().backward()
    assert settings.bg.grad.tolist() == [81, 81, 81]
    assert not any(tensor.grad.any() for tensor in inputs.values())


def test_the_order_of_the_input_does_not_matter(mode):
    scene = random_scene(mode)
    shuffled = torch.randperm(len(scene.inputs["means3D"]), generator=torch.Generator().manual_seed(0))
    image, permuted = render(scene), render(scene.rows(shuffled))
    assert_not_empty(image, scene.settings)
    assert torch.equal(image.radii[shuffled], permuted.radii)
    assert_close(permuted.color, image.color, EXACT, "colour")


def test_means2D_receives_the_gradient_in_normalised_device_coordinates(mode):
    scene = without_tails(random_scene(mode, 8, 30, 20, seed=1, scale=0.3, opacity=(0.3, 0.8), channels=3))
    assert threshold_margin(scene).min() > 1e-4
    image, analytic = gradients(reference.rasterize, scene)
    assert (image.radii > 0).sum() > 3
    weights = random_weights(image)[1][0]
    step = 1e-6
    for axis in (0, 1):
        losses = []
        for sign in (1, -1):
            # Adding w to x or y of the clip coordinates moves every splat in the image and changes nothing else.
            matrix = scene.settings.projmatrix.clone()
            matrix[:, axis] += sign * step * matrix[:, 3]
            losses.append((render(scene.with_settings(projmatrix=matrix)).color * weights).sum().item())
        # 1e-6: rounding of the loss over the step, and w + 1e-7 in place of w.
        numeric = (losses[0] - losses[1]) / (2 * step)
        assert analytic["means2D"][:, axis].sum().item() == pytest.approx(numeric, rel=1e-6)
    assert not analytic["means2D"][:, 2].any()


@pytest.mark.parametrize("name", ["means3D", "opacities", "shs", "scales", "rotations"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_gaussian_that_is_not_finite_is_as_if_absent(mode, name, value):
    scene = random_scene(mode, 40, 24, 20)
    index = int((render(scene).radii > 0).nonzero()[3])
    others = torch.arange(40) != index
    broken = scene.inputs[name].clone()
    broken[index].view(-1)[-1] = value
    image, gradient = gradients(reference.rasterize, scene.with_inputs(**{name: broken}))
    expected_image, expected = gradients(reference.rasterize, scene.rows(others))
    assert image.radii[index] == 0
    assert torch.equal(image.color, expected_image.color)
    for name in scene.inputs:
        assert not gradient[name][index].any()
        assert_close(gradient[name][others], expected[name], EXACT, name)


@with_gate
def test_float32_agrees_with_float64(mode):
    scene = random_scene(mode)
    safe = threshold_margin(scene) > 1e-3
    single = render(scene.to(torch.float32)).color
    # 1e-5: some hundred float32 roundings of 6e-8 between the inputs and a pixel.
    assert_close(single[:, safe], render(scene).color[:, safe], 1e-5, "colour")


def test_split_and_joint_spherical_harmonics_agree(mode):
    joint, split = random_scene(mode, 30, 24, 20), random_scene(mode, 30, 24, 20, split_dc=True)
    image, gradient = gradients(reference.rasterize, joint)
    split_image, split_gradient = gradients(reference.rasterize, split)
    assert torch.equal(image.color, split_image.color)
    split_gradient["shs"] = torch.cat([split_gradient.pop("dc"), split_gradient["shs"]], 1)
    assert_all_close(split_gradient, gradient, EXACT)


def test_the_jacobian_clamp_has_an_exact_gradient(mode):
    # A wide Gaussian whose centre lies far outside the view, beyond 1.3 tan(fov), still covers the image's edge.
    inputs = on_axis([2.0], [0.8], [[0.9]], variance=2.0)
    inputs["means3D"] = torch.tensor([[3.1, 2.9, 2.0]], dtype=torch.float64)
    inputs = {name: tensor.requires_grad_(True) for name, tensor in inputs.items()}
    settings = facing_camera(mode, bg=(0.4,))

    def function(*tensors):
        return reference.rasterize(settings=settings, outputs=OUTPUTS, **dict(zip(inputs, tensors)))[::2]

    # Channel sums would hide a mistake in a gated image of one colour: the gate sum is checked beside it.
    assert reference.rasterize(settings=settings, outputs=("alpha",), **inputs).alpha.max() > 0.05
    assert torch.autograd.gradcheck(function, list(inputs.values()), fast_mode=True)
