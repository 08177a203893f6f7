"""Defined results at the borders of the input: nothing to draw, tiny images, extreme opacities, shapes and places."""
from __future__ import annotations

import numpy
import pytest
import torch
from comparison import assert_all_close, assert_close, reference_gradients
from devices import random_normal
from scenes import camera_settings, gradients, random_scene, with_gate

from diff_smoe_rasterization import rasterize
from diff_smoe_rasterization.settings import BLEND_MODES, OUTPUTS

pytestmark = pytest.mark.usefixtures("device")

EXACT = 1e-9  # float64; the determinant of a flat splat seen edge-on is a difference that loses some digits
REORDERED = 1e-5  # float32; another Gaussian left out may change the order of sums


def render(scene, outputs=()):
    return rasterize(settings=scene.settings, outputs=outputs, **scene.inputs)


def small_scene(mode, **options):
    return random_scene(mode, 40, 33, 21, degree=1, **options)


def one_gaussian(mode, mean, scale=(0.1, 0.1, 0.1), opacity=0.8, width=33, height=21, dtype=torch.float64, **fields):
    """One red Gaussian before a camera at (0, 0, 0) that looks along z."""
    settings = camera_settings(width, height, position=(0.0, 0.0, -1.0), dtype=dtype, blend_mode=mode, **fields)
    view = torch.eye(4, dtype=torch.float64)
    projection = torch.linalg.inv(settings.viewmatrix.double()) @ settings.projmatrix.double()
    settings = settings._replace(viewmatrix=view.to(dtype), projmatrix=projection.to(dtype),
                                 campos=torch.zeros(3, dtype=dtype))
    inputs = dict(means3D=[mean], opacities=[[opacity]], colors_precomp=[[1.0, 0.0, 0.0]], scales=[scale],
                  rotations=[[1.0, 0.0, 0.0, 0.0]], means2D=[[0.0, 0.0, 0.0]])
    scene = random_scene(mode, 1)
    return scene._replace(settings=settings, inputs={name: torch.tensor(values, dtype=dtype)
                                                     for name, values in inputs.items()})


def assert_equals_reference(scene, outputs=OUTPUTS):
    rendering, gradient = gradients(rasterize, scene, outputs)
    expected, expected_gradient = reference_gradients(scene, outputs)
    assert torch.equal(rendering.radii.cpu(), expected.radii)
    for name in ("color",) + tuple(outputs):
        assert_close(getattr(rendering, name), getattr(expected, name), EXACT, name)
    assert_all_close(gradient, expected_gradient, EXACT)
    return rendering


def assert_background_only(scene):
    rendering, gradient = gradients(rasterize, scene, OUTPUTS)
    assert torch.equal(rendering.color, scene.settings.bg[:, None, None].expand_as(rendering.color))
    for name in OUTPUTS:
        assert not getattr(rendering, name).any()
    for name, values in gradient.items():
        if name != "bg":
            assert not values.any(), name
            assert values.shape == (scene.inputs.get(name) if name in scene.inputs else
                                    getattr(scene.settings, name)).shape
    weights = random_normal(rendering.color.shape, 1)
    # The order of the sum over the pixels is free.
    assert_close(gradient["bg"], weights.sum((1, 2)), 1e-4 if rendering.color.dtype == torch.float32 else EXACT, "bg")
    return rendering


@with_gate
@pytest.mark.parametrize("options", [{}, dict(split_dc=True), dict(channels=4, covariance="cov3D")],
                         ids=["shs", "dc", "colours"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_gaussians(mode, dtype, options):
    scene = small_scene(mode, dtype=dtype, **options).rows(slice(0, 0))
    rendering = assert_background_only(scene)
    assert rendering.radii.shape == (0,) and rendering.radii.dtype == torch.int32


@with_gate
def test_nothing_visible(mode):
    scene = small_scene(mode, dtype=torch.float32)
    scene = scene.with_inputs(means3D=scene.inputs["means3D"] - torch.tensor([0.0, 0.0, 30.0]))
    assert not assert_background_only(scene).radii.any()


@with_gate
@pytest.mark.parametrize("width, height", [(1, 1), (1, 40), (40, 1), (16, 16), (17, 16), (15, 33), (5, 3)])
def test_image_sizes(mode, width, height):
    scene = random_scene(mode, 40, width, height, scale=0.3, degree=1)
    assert (assert_equals_reference(scene).radii > 0).any()


@pytest.mark.parametrize("mode", ["alpha", "smoe_learned_gate"])  # the two kinds of footprint
def test_few_gaussians_on_many_tiles(mode):
    scene = random_scene(mode, 6, 264, 152, scale=0.05)
    assert (assert_equals_reference(scene).radii > 0).any()


@with_gate
@pytest.mark.parametrize("opacity", [0.0, -0.5])
def test_a_gaussian_without_opacity_is_not_drawn(mode, opacity):
    scene = small_scene(mode, dtype=torch.float32)
    index = int((render(scene).radii > 0).nonzero()[5])
    others = torch.arange(40) != index
    opacities = scene.inputs["opacities"].clone()
    opacities[index] = opacity
    rendering, gradient = gradients(rasterize, scene.with_inputs(opacities=opacities))
    expected = render(scene.rows(others))
    assert_close(rendering.color, expected.color, REORDERED, "colour")
    assert torch.equal(rendering.radii[others], expected.radii)
    for name in scene.inputs:
        assert not gradient[name][index].any(), name


@with_gate
def test_opacities_under_one_part_in_255(mode):
    scene = small_scene(mode, opacity=(1e-4, 3e-3))
    rendering, gradient = gradients(rasterize, scene)
    if mode == "alpha":
        assert_background_only(scene)
        assert (rendering.radii > 0).any()
    else:
        assert_equals_reference(scene)
        assert gradient["shs"].any() and gradient["means3D"].any()


@with_gate
@pytest.mark.parametrize("opacity", [1.0, 1.5, 100.0])
def test_opacities_of_one_and_above(mode, opacity):
    scene = small_scene(mode)
    assert_equals_reference(scene.with_inputs(opacities=torch.full((40, 1), opacity, dtype=torch.float64)))


def test_a_zero_quaternion_turns_nothing(mode):
    scene = small_scene(mode)
    zero, identity = torch.zeros(40, 4, dtype=torch.float64), torch.zeros(40, 4, dtype=torch.float64)
    identity[:, 0] = 1
    scene = scene.with_inputs(rotations=zero)
    assert_equals_reference(scene)
    assert_close(render(scene).color, render(scene.with_inputs(rotations=identity)).color, EXACT, "colour")


@pytest.mark.parametrize("antialiasing", [False, True])
@pytest.mark.parametrize("axes", [[0], [0, 1], [0, 1, 2]], ids=["flat", "line", "point"])
def test_scales_of_zero(mode, axes, antialiasing):
    scene = small_scene(mode, antialiasing=antialiasing)
    scales = scene.inputs["scales"].clone()
    scales[:, axes] = 0
    assert_equals_reference(scene.with_inputs(scales=scales))


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e3, 1e6, 1e9, 1e18, 1e30, 3e38])
def test_huge_scales_give_finite_results(mode, scale, dtype):
    scene = small_scene(mode, dtype=dtype)
    scales = scene.inputs["scales"].clone()
    scales[::3] = scale
    rendering, gradient = gradients(rasterize, scene.with_inputs(scales=scales), OUTPUTS)
    assert all(torch.isfinite(values).all() for values in rendering)
    assert (rendering.radii >= 0).all()
    for name, values in gradient.items():
        assert torch.isfinite(values).all(), name


@pytest.mark.parametrize("value", [1e-38, 1e18, 3e38])
@pytest.mark.parametrize("name", ["means3D", "opacities", "shs", "rotations"])
def test_extreme_finite_values_do_not_reach_the_others(mode, name, value):
    scene = small_scene(mode, dtype=torch.float32)
    tensor = scene.inputs[name].clone()
    tensor[7] = value
    rendering = render(scene.with_inputs(**{name: tensor}), OUTPUTS)
    assert (rendering.radii >= 0).all()
    if name in ("means3D", "rotations"):
        assert torch.isfinite(rendering.color).all()


def test_an_infinite_colour_of_finite_coefficients_is_culled(mode):
    """Each coefficient is a float; their sum over the basis is not. Pixels beside the Gaussian must not see 0 * inf."""
    scene = random_scene(mode, 40, 33, 21, degree=3, dtype=torch.float32)
    index = int((render(scene).radii > 0).nonzero()[5])
    shs = scene.inputs["shs"].clone()
    shs[index] = 1e-3  # no channel is clamped, so each derivative by a coefficient has the sign of its basis function
    leaf = shs.clone().requires_grad_()
    render(scene.with_inputs(shs=leaf)).color.sum().backward()
    assert (leaf.grad[index] != 0).all()
    shs[index] = 3e38 * torch.sign(leaf.grad[index])  # every term is positive
    others = torch.arange(len(shs)) != index
    rendering = render(scene.with_inputs(shs=shs))
    assert rendering.radii[index] == 0
    assert_close(rendering.color, render(scene.rows(others)).color, REORDERED, "colour")


@with_gate
def twice(scene):
    """One Gaussian twice, in two colours: the gate of a lone one is 1, and its opacity has no gradient to compare."""
    return scene.rows([0, 0]).with_inputs(colors_precomp=torch.eye(3, dtype=torch.float64)[:2])


def test_alpha_min_is_compared_before_the_clamp(mode):
    scene = one_gaussian(mode, (0.0, 0.0, 1.0), opacity=2.0, alpha_min=0.995)
    image = render(scene).color
    assert (image[0] > 0).any()
    assert_close(image, reference_gradients(scene)[0].color, EXACT, "colour")


def test_a_gaussian_at_the_camera_centre_is_culled(mode):
    scene = small_scene(mode, dtype=torch.float32)
    index = int((render(scene).radii > 0).nonzero()[5])
    others = torch.arange(40) != index
    means3D = scene.inputs["means3D"].clone()
    means3D[index] = scene.settings.campos
    rendering, gradient = gradients(rasterize, scene.with_inputs(means3D=means3D))
    assert rendering.radii[index] == 0
    assert_close(rendering.color, render(scene.rows(others)).color, REORDERED, "colour")
    assert all(torch.isfinite(values).all() for values in gradient.values())
    assert not gradient["means3D"][index].any()


def test_a_visible_gaussian_at_campos_has_no_view_direction(mode):
    """campos is an input of its own: nothing forces it to agree with the viewmatrix."""
    scene = small_scene(mode)
    index = int((render(scene).radii > 0).nonzero()[3])
    scene = scene.with_settings(campos=scene.inputs["means3D"][index].clone())
    assert assert_equals_reference(scene).radii[index] > 0


@pytest.mark.parametrize("dtype, as_float", [(torch.float32, numpy.float32), (torch.float64, numpy.float64)])
@pytest.mark.parametrize("near", [0.2, 0.5])
def test_the_near_plane_itself_is_culled(mode, dtype, as_float, near):
    plane = as_float(numpy.float32(near))  # the threshold is the float32 value in both types
    behind = one_gaussian(mode, (0.0, 0.0, float(plane)), (0.01,) * 3, dtype=dtype, near=near)
    beyond = one_gaussian(mode, (0.0, 0.0, float(numpy.nextafter(plane, as_float(1)))), (0.01,) * 3, dtype=dtype,
                          near=near)
    assert not assert_background_only(behind).radii.any()
    assert render(beyond).radii.all()
    assert (render(beyond).color[0] > 0.5).any()


@pytest.mark.parametrize("depth", [-1.0, -0.01, 0.0])
def test_behind_the_camera(mode, depth):
    assert not assert_background_only(one_gaussian(mode, (0.0, 0.0, depth))).radii.any()


@pytest.mark.parametrize("dtype, nearer", [(torch.float32, 0.0), (torch.float64, 0.0), (torch.float64, 1e-12)])
def test_equal_depths_keep_the_order_of_the_input(mode, dtype, nearer):
    """In float64 depths differ that would be equal in float32."""
    scene = one_gaussian(mode, (0.0, 0.0, 2.0)).rows([0, 0])
    means3D, colors = scene.inputs["means3D"].clone(), torch.eye(3, dtype=torch.float64)[:2]
    means3D[1, 2] -= nearer
    scene = scene.with_inputs(means3D=means3D, colors_precomp=colors).to(dtype)
    red, green, _ = render(scene).color[:, 10, 16].tolist()
    if mode == "smoe_std":
        assert red == pytest.approx(green, rel=1e-6)  # it knows no order
    else:
        front, back = (green, red) if nearer else (red, green)
        # The one behind gets 1 - 0.8 of the weight; the kernels and, in alpha, the background do not change that.
        assert front > 3 * back


@pytest.mark.parametrize("covariance", [[-1.0, 0.0, 0.0, -1.0, 0.0, -1.0], [1.0, 3.0, 0.0, 1.0, 0.0, 1.0]],
                         ids=["negative", "indefinite"])
def test_a_covariance_that_is_not_positive_is_culled(mode, covariance):
    scene = one_gaussian(mode, (0.0, 0.0, 2.0))
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name not in ("scales", "rotations")}
    scene = scene._replace(inputs={**inputs, "cov3D_precomp": torch.tensor([covariance], dtype=torch.float64)})
    assert not assert_background_only(scene).radii.any()


@with_gate
@pytest.mark.parametrize("pixel", [15.0, 15.5, 16.0, 31.5, 32.0, -0.5, 0.0])
def test_a_splat_on_a_tile_edge_is_drawn_on_both_sides(mode, pixel):
    width, depth = 64, 2.0
    scene = one_gaussian(mode, (0.0, 0.0, depth), width=width, height=48)
    x = ((2 * pixel + 1) / width - 1) * scene.settings.tanfovx * depth
    y = ((2 * 15.5 + 1) / 48 - 1) * scene.settings.tanfovy * depth
    scene = twice(scene.with_inputs(means3D=torch.tensor([[x, y, depth]], dtype=torch.float64)))
    rendering = assert_equals_reference(scene)
    left, right = max(0, int(pixel)), min(width - 1, int(pixel) + 1)
    assert (rendering.alpha[0, 15:17, [left, right]] > 0.5).all()


def test_eq7_shows_the_exact_colour_of_a_lone_gaussian():
    scene = one_gaussian("smoe_eq7", (0.0, 0.0, 2.0), opacity=1e-6, dtype=torch.float32)
    rendering, gradient = gradients(rasterize, scene, ("alpha",))
    gated = rendering.alpha[0] > 0
    assert 0 < rendering.alpha[rendering.alpha > 0].min() < 1e-9
    assert rendering.color[0][gated].tolist() == pytest.approx([1.0] * int(gated.sum()), abs=1e-6)
    assert rendering.color[1][gated].abs().max() == 0
    assert all(torch.isfinite(values).all() for values in gradient.values())


def test_without_a_gate_the_background_takes_pixel_and_gradient():
    for mode in BLEND_MODES[1:]:
        scene = one_gaussian(mode, (0.0, 0.0, 2.0), opacity=1e-32, dtype=torch.float32)
        assert render(scene).radii.all()
        rendering, gradient = gradients(rasterize, scene)
        assert torch.equal(rendering.color, scene.settings.bg[:, None, None].expand_as(rendering.color))
        assert not any(gradient[name].any() for name in scene.inputs)
        assert gradient["bg"].any()


def test_an_object_in_front_hides_what_is_behind_it():
    """Alpha and both smoe have transmittance; the ablations without it ghost (Figure 8)."""
    near = one_gaussian("alpha", (0.0, 0.0, 1.0), opacity=0.99)
    four = near.rows([0, 0, 0, 0])
    means3D, colors = four.inputs["means3D"].clone(), four.inputs["colors_precomp"].clone()
    means3D[:, 2] = torch.tensor([1.0, 1.1, 1.2, 3.0])
    colors[3] = torch.tensor([0.0, 1.0, 0.0])
    four = four.with_inputs(means3D=means3D, colors_precomp=colors)
    green = {mode: render(four.with_settings(blend_mode=mode)).color[1, 10, 16].item() for mode in BLEND_MODES}
    assert max(green["alpha"], green["smoe"], green["smoe_eq7"]) < 0.01 and green["smoe_std"] > 0.1
