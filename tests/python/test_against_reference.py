"""The package against the reference: images and every gradient, in both types, over scenes that each stress one thing.

In float64 the two must agree to rounding. In float32 the package is compared with the reference in float64 on the same
numbers; pixels in which a pair lies within rounding of a threshold (cut-off, early stop) may show another outcome, so
they are counted and take no part. The reference always runs on the CPU.
"""
from __future__ import annotations

import functools

import pytest
import torch
from comparison import assert_all_close, assert_close, assert_same_gradients, one_thread, threshold_margin
from devices import on_the_cpu, random_normal
from scenes import assert_not_empty, random_scene, with_gate

import diff_smoe_rasterization
from diff_smoe_rasterization import reference
from diff_smoe_rasterization.core import _core
from diff_smoe_rasterization.settings import BLEND_MODES, OUTPUTS, GaussianRasterizationSettings

pytestmark = pytest.mark.usefixtures("device")

# A gradient is a sum of some thousand terms that cancel in part, each with some hundred roundings of 1e-16.
FLOAT64_TOLERANCE = 1e-12
# The same with roundings of 6e-8.
FLOAT32_IMAGE_TOLERANCE = 1e-5
FLOAT32_GRADIENT_TOLERANCE = 1e-4
# ln(value / threshold) that float32 can get wrong: power is a difference of terms of up to 1e4, times 6e-8.
FLOAT32_MARGIN = 1e-3


def _with_negative_opacities(mode):
    scene = random_scene(mode, seed=8)
    opacities = scene.inputs["opacities"].clone()
    opacities[::5] *= -1
    opacities[1::10] = 0
    return scene.with_inputs(opacities=opacities)


def _with_flat_opacities(mode):
    scene = random_scene(mode, 60, 30, 20, seed=9)
    return scene.with_inputs(opacities=scene.inputs["opacities"][:, 0])


def _with_unused_coefficients(mode):
    return random_scene(mode, 60, seed=10, degree=3).with_settings(sh_degree=1)


def _with_scale_modifier(mode):
    return random_scene(mode, seed=11).with_settings(scale_modifier=0.6)


def _with_any_camera(mode):
    """Different focal lengths, a view matrix that is not a rotation, a projection and a centre that match neither."""
    scene = random_scene(mode, seed=24)
    settings = scene.settings

    def disturbed(tensor, amount):
        return tensor + amount * random_normal(tensor.shape, 24).to(tensor)

    view = settings.viewmatrix.clone()
    view[:, :3] = disturbed(view[:, :3], 0.05)
    return scene.with_settings(tanfovx=0.6, tanfovy=0.3, viewmatrix=view.float().double(),
                               projmatrix=disturbed(settings.projmatrix, 0.05).float().double(),
                               campos=disturbed(settings.campos, 1.0).float().double())


def _scene(*arguments, **options):
    return lambda mode: random_scene(mode, *arguments, **options)


# Each takes a mode.
SCENES = {
    "default": random_scene,
    "degree_0": _scene(degree=0, seed=1),
    "degree_3": _scene(degree=3, seed=2),
    "split_dc": _scene(degree=2, split_dc=True, seed=3),
    "split_dc_alone": _scene(60, degree=0, split_dc=True, seed=3),
    "unused_coefficients": _with_unused_coefficients,
    "cov3D": _scene(covariance="cov3D", seed=4),
    "channels_1": _scene(60, channels=1, seed=5),
    "channels_3": _scene(channels=3, seed=6),
    "channels_4": _scene(60, channels=4, seed=7),
    "channels_7": _scene(60, channels=7, seed=7),
    "channels_33": _scene(60, channels=33, covariance="cov3D", seed=7),
    "antialiasing": _scene(250, scale=0.05, antialiasing=True, seed=12),
    "antialiasing_cov3D": _scene(antialiasing=True, covariance="cov3D", seed=13),
    "low_pass": _scene(700, scale=0.03, antialiasing=True, low_pass=0.1, seed=28),
    "low_pass_cov3D": _scene(covariance="cov3D", low_pass=1.5, seed=29),
    "principal_point": _scene(principal_point=(7.3, -4.6), seed=14),
    "saturating": _scene(500, 24, 20, scale=0.3, opacity=(0.3, 1.3), seed=15),
    "large_splats": _scene(40, 70, 41, scale=1.2, opacity=(0.05, 0.5), seed=16),
    "tiny_splats": _scene(800, scale=0.01, opacity=(0.3, 1.0), seed=17),
    "one_tile": _scene(60, 16, 16, seed=18),
    "one_pixel_more_than_tiles": _scene(60, 33, 17, seed=19),
    "narrow": _scene(60, 3, 60, fov_x=0.05, seed=20),
    "near": _scene(near=3.6, seed=21),
    "alpha_min": _scene(alpha_min=1 / 255, seed=22),
    "many_faint": _scene(1500, 24, 20, scale=0.3, opacity=(0.002, 0.01), seed=25),
    "any_camera": _with_any_camera,
    "faint": _scene(opacity=(1e-4, 2e-2), scale=0.2, seed=23),
    "negative_opacities": _with_negative_opacities,
    "flat_opacities": _with_flat_opacities,
    "scale_modifier": _with_scale_modifier,
    "unclamped": _scene(degree=3, clamp_color=False, seed=26),
    "unclamped_split_dc": _scene(degree=2, split_dc=True, covariance="cov3D", clamp_color=False, seed=27),
}
# Scenes that run with the gradients of the optional outputs beside that of the colour.
WITH_OUTPUTS = ("default", "split_dc", "channels_7", "antialiasing", "saturating", "alpha_min", "faint", "large_splats")
# What is in front of the blend is one code for all modes: the two that are trained with go through all of it.
BLENDING = WITH_OUTPUTS + ("channels_3", "many_faint", "negative_opacities", "one_pixel_more_than_tiles")
CASES = [(mode, name) for mode in BLEND_MODES + ("smoe_learned_gate",)
         for name in (SCENES if mode in ("alpha", "smoe") else BLENDING)] + [("eq7_gate", "default")]


@functools.lru_cache(maxsize=None)
def build(name, mode):
    """Returns (scene, outputs, image gradients, where no threshold is near, reference results, those without the rest).

    All on the CPU, once for all devices.
    """
    with one_thread(), on_the_cpu():
        scene = SCENES[name](mode)
        outputs = OUTPUTS if name in WITH_OUTPUTS else ()
        shape = (len(scene.settings.bg) + len(outputs), scene.settings.image_height, scene.settings.image_width)
        weights = random_normal(shape, 1)
        safe = threshold_margin(scene) > FLOAT32_MARGIN
        *expected, expected_safe = render(reference.rasterize, scene, outputs, weights, weights * safe)
    return scene, outputs, weights, safe, expected, expected_safe


def render(function, scene, outputs, *weights):
    """Returns (rendering, images by name, gradients by name for each of the weights)."""
    scene = scene.requiring_grad()
    rendering = function(settings=scene.settings, outputs=outputs, **scene.inputs)
    images = {"color": rendering.color, **{name: getattr(rendering, name) for name in outputs}}
    leaves = scene.leaves()
    stacked = torch.cat(list(images.values()))
    gradients = []
    for weight in weights:
        values = torch.autograd.grad(stacked, list(leaves.values()), weight.to(stacked), allow_unused=True,
                                     retain_graph=weight is not weights[-1])
        gradients.append({name: torch.zeros_like(leaf) if value is None else value
                          for (name, leaf), value in zip(leaves.items(), values)})
    return (rendering, {name: image.detach() for name, image in images.items()}, *gradients)


@pytest.mark.parametrize("mode, name", CASES)
def test_float64(mode, name, device):
    scene, outputs, weights, _, (expected, expected_images, expected_gradients), _ = build(name, mode)
    if name != "faint" or mode != "alpha":
        assert_not_empty(expected, scene.settings)
    if name == "saturating" and mode in ("alpha", "smoe"):
        assert (expected_images["alpha"] > 0.999).double().mean() > 0.5
    rendering, images, gradients = render(diff_smoe_rasterization.rasterize, scene.to(device), outputs, weights)
    assert torch.equal(rendering.radii.cpu(), expected.radii)
    assert_all_close(images, expected_images, FLOAT64_TOLERANCE)
    assert_all_close(gradients, expected_gradients, FLOAT64_TOLERANCE)


@pytest.mark.parametrize("mode, name", CASES)
def test_float32(mode, name, device):
    scene, outputs, weights, safe, (expected, expected_images, _), expected_gradients = build(name, mode)
    assert safe.double().mean() > 0.8
    rendering, images, gradients = render(diff_smoe_rasterization.rasterize, scene.to(device).to(torch.float32),
                                          outputs, weights * safe)
    assert rendering.color.dtype == torch.float32 and rendering.radii.dtype == torch.int32
    assert torch.equal(rendering.radii.cpu(), expected.radii)
    for output, image in images.items():
        assert_close(image.cpu()[:, safe], expected_images[output][:, safe], FLOAT32_IMAGE_TOLERANCE, output)
        assert torch.isfinite(image).all()
    assert_all_close(gradients, expected_gradients, FLOAT32_GRADIENT_TOLERANCE)


@with_gate
def test_the_optional_outputs_do_not_change_the_colour(mode):
    scene = random_scene(mode, dtype=torch.float32)
    alone = diff_smoe_rasterization.rasterize(settings=scene.settings, **scene.inputs)
    assert alone.alpha is None and alone.depth is None and alone.inverse_depth is None
    for output in OUTPUTS:
        rendering = diff_smoe_rasterization.rasterize(settings=scene.settings, outputs=(output,), **scene.inputs)
        assert torch.equal(rendering.color, alone.color)
        assert [name for name in OUTPUTS if getattr(rendering, name) is not None] == [output]


def test_clamp_color_decides_on_colours_below_zero(mode, device):
    """Only those of harmonics: given colours are used as they are."""
    scene = random_scene(mode, degree=3, seed=26, bg=torch.zeros(3))
    least = {clamp: diff_smoe_rasterization.rasterize(
        settings=scene.settings._replace(clamp_color=clamp), **scene.inputs).color.min() for clamp in (True, False)}
    assert least[True] >= 0 and least[False] < -0.01
    given = random_scene(mode, channels=3, seed=26)
    given = given.with_inputs(colors_precomp=given.inputs["colors_precomp"] - 0.5)
    unclamped, clamped = (render(diff_smoe_rasterization.rasterize, given.with_settings(clamp_color=clamp), (),
                                 random_normal((3, 37, 50), 1)) for clamp in (False, True))
    assert clamped[0].color.min() < -0.01 and torch.equal(clamped[0].color, unclamped[0].color)
    assert_same_gradients(clamped[2], unclamped[2])


@with_gate
def test_each_optional_output_has_its_own_gradient(mode):
    scene = random_scene(mode, 60, seed=30)
    for output in OUTPUTS:
        weights = random_normal((1, scene.settings.image_height, scene.settings.image_width), 2)

        def gradients(function, scene, output=output, weights=weights):
            scene = scene.requiring_grad()
            image = getattr(function(settings=scene.settings, outputs=(output,), **scene.inputs), output)
            leaves = scene.leaves()
            values = torch.autograd.grad(image, list(leaves.values()), weights.to(image), allow_unused=True)
            return {name: torch.zeros_like(leaf) if value is None else value
                    for (name, leaf), value in zip(leaves.items(), values)}

        with one_thread(), on_the_cpu():
            expected = gradients(reference.rasterize, scene.to("cpu"))
        assert expected["means3D"].any()
        assert_all_close(gradients(diff_smoe_rasterization.rasterize, scene), expected, FLOAT64_TOLERANCE)


def test_the_core_has_the_constants_of_the_reference():
    expected = {"alpha_max": reference.ALPHA_MAX, "alpha_cut": reference.ALPHA_MIN, "gate_cut": reference.KERNEL_MIN,
                "transmittance_cut": reference.TRANSMITTANCE_MIN, "gate_sum_cut": reference.GATE_SUM_MIN,
                "radius_root_floor": reference.EIGENVALUE_SPREAD_MIN,
                "low_pass": GaussianRasterizationSettings._field_defaults["low_pass"],
                "compensation_floor": reference.COMPENSATION_MIN, "frustum_margin": reference.FRUSTUM_MARGIN,
                "homogeneous_epsilon": reference.W_EPSILON, "tile_size": reference.TILE,
                "core_kernel": reference.KERNEL_KEPT, "core_alpha": reference.CORE_MIN,
                "tail_alpha": reference.TAIL_MIN, "every_tail_alpha": reference.EVERY_TAIL_MIN,
                "max_opacity": reference.OPACITY_MAX}
    assert {name: _core.constants[name] for name in expected} == expected
