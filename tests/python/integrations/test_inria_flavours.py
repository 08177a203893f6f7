"""What every flavour of Inria's API promises its trainers, against the reference."""
from __future__ import annotations

import inspect
import re

import pytest
import torch
from comparison import (
    assert_all_close,
    assert_close,
    assert_is_the_references,
    assert_same_gradients,
    reference_gradients,
)
from packaged import packages_and_data
from scenes import gradients, random_scene, random_weights, spread

from diff_smoe_rasterization import Rendering, rasterize
from diff_smoe_rasterization.integrations import c3dgs, inria, inria_2024, scaffold

pytestmark = pytest.mark.usefixtures("device")

FIELDS = ["image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
          "sh_degree", "campos", "prefiltered", "debug"]
INPUTS_2023 = ["means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp"]
INPUTS_2024 = INPUTS_2023[:3] + ["dc"] + INPUTS_2023[3:]
FUNCTION_2023 = ["means3D", "means2D", "sh", "colors_precomp", "opacities", "scales", "rotations", "cov3Ds_precomp",
                 "raster_settings"]
FUNCTION_2024 = FUNCTION_2023[:2] + ["dc"] + FUNCTION_2023[2:]

# A sum of some thousand terms in float64, each with some hundred roundings of 1e-16.
TOLERANCE = 1e-12


@pytest.fixture(params=[inria, inria_2024, c3dgs, scaffold], ids=["inria", "inria_2024", "c3dgs", "scaffold"])
def flavour(request):
    return request.param


def settings_of(flavour, settings, **others):
    """The settings as that trainer makes them: by keyword, its own fields and no other, then what the user adds."""
    names = FIELDS + {inria_2024: ["antialiasing"], c3dgs: ["clamp_color"]}.get(flavour, [])
    return flavour.GaussianRasterizationSettings(**{name: getattr(settings, name) for name in names}, **others)


def render_with(flavour, **others):
    """A function with the signature of `rasterize`, as scenes.gradients calls it, that goes through a flavour."""
    def render(settings, outputs, **inputs):
        rasterizer = flavour.GaussianRasterizer(raster_settings=settings_of(
            flavour, settings, **{"blend_mode": settings.blend_mode, **others}))
        results = rasterizer(**inputs)
        return Rendering(*results[:2], inverse_depth=results[2] if outputs else None)

    return render


@pytest.fixture
def scene(device):
    return random_scene(None, 40, 33, 21, degree=1)


def test_how_many_results_is_the_flavours_own_choice(flavour, scene):
    count = 3 if flavour is inria_2024 else 2
    settings = settings_of(flavour, scene.settings)
    inputs = scene.inputs
    results = flavour.GaussianRasterizer(raster_settings=settings)(**inputs)
    dc = [None] if flavour is inria_2024 else []
    of_function = flavour.rasterize_gaussians(
        inputs["means3D"], inputs["means2D"], *dc, inputs["shs"], None, inputs["opacities"], inputs["scales"],
        inputs["rotations"], None, settings)
    for values in (results, of_function):
        assert type(values) is tuple and len(values) == count
        color, radii = values[:2]
        assert color.shape == (3, 21, 33) and color.requires_grad is False
        assert radii.shape == (40,) and radii.dtype == torch.int32
        assert torch.equal(color, results[0])
    if count == 3:
        assert results[2].shape == (1, 21, 33) and results[2].max() > 0


def test_names_and_their_order(flavour):
    new = flavour is inria_2024
    assert list(flavour.GaussianRasterizationSettings._fields)[:12] == FIELDS
    if new:
        assert flavour.GaussianRasterizationSettings._fields[12] == "antialiasing"
    inputs = INPUTS_2024 if new else INPUTS_2023
    forward = list(inspect.signature(flavour.GaussianRasterizer.forward).parameters)[1:]
    assert forward[:len(inputs)] == inputs
    assert list(inspect.signature(flavour.rasterize_gaussians).parameters) == (FUNCTION_2024 if new else FUNCTION_2023)
    assert {"GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"} <= set(flavour.__all__)
    assert issubclass(flavour.GaussianRasterizer, torch.nn.Module)


def test_images_radii_and_gradients_are_the_references(flavour, mode):
    scene = random_scene(mode, 60, 45, 30, seed=3)
    assert_is_the_references(*gradients(render_with(flavour), scene), *reference_gradients(scene), TOLERANCE)


def test_an_opacity_may_exceed_one(flavour, mode):
    scene = random_scene(mode, 60, 45, 30, seed=4, opacity=(1.5, 6.0))
    rendering, actual = gradients(render_with(flavour), scene)
    expected_rendering, expected = reference_gradients(scene)
    assert_close(rendering.color, expected_rendering.color, TOLERANCE, "color")
    assert expected["opacities"].any()
    assert_all_close(actual, expected, TOLERANCE)


def test_inputs_need_not_be_contiguous(flavour, mode):
    """HAC passes columns of wider tensors."""
    scene = random_scene(mode, 60, 45, 30, seed=5)
    strided = scene._replace(inputs={name: spread(tensor) for name, tensor in scene.inputs.items()})
    assert not any(tensor.is_contiguous() for tensor in strided.inputs.values())
    leaves = {name: tensor.requires_grad_(True) for name, tensor in strided.inputs.items()}
    color = render_with(flavour)(scene.settings, (), **leaves).color
    expected, expected_gradients = gradients(render_with(flavour), scene, camera=False)
    assert torch.equal(color, expected.color)
    weights = random_weights(expected)[1][0]
    actual = dict(zip(leaves, torch.autograd.grad(color, list(leaves.values()), weights)))
    assert_same_gradients(actual, expected_gradients)


def test_empty_cpu_tensors_are_absent_inputs(flavour, mode):
    empty = torch.Tensor([]).cpu()  # float32, whatever the others are
    for covariance, channels in (("scales", None), ("cov3D", 3)):
        scene = random_scene(mode, 60, 45, 30, seed=6, covariance=covariance, channels=channels)
        names = INPUTS_2024 if flavour is inria_2024 else INPUTS_2023
        absent = {name: empty for name in names if name not in scene.inputs}
        results = flavour.GaussianRasterizer(settings_of(flavour, scene.settings, blend_mode=mode))(
            **scene.inputs, **absent)
        assert len(absent) >= 2
        assert_close(results[0], reference_gradients(scene)[0].color, TOLERANCE, "color")


@pytest.mark.parametrize("name, shape, right", [
    ("rotations", [4], [40, 4]), ("opacities", [1, 40], [40, 1]), ("scales", [3], [40, 3]),
    ("cov3D_precomp", [40], [40, 6])])
def test_an_error_names_the_right_shape(flavour, scene, name, shape, right):
    inputs = {**scene.inputs, name: torch.ones(shape, dtype=torch.float64)}
    with pytest.raises(ValueError, match=re.escape(f"{name} has shape {shape}; it must be {right}")):
        flavour.GaussianRasterizer(settings_of(flavour, scene.settings))(**inputs)


@pytest.mark.parametrize("wrong", [{"shs": None}, {"colors_precomp": True}, {"scales": None}, {"cov3D_precomp": True}])
def test_both_or_neither_of_two_ways_is_an_error(flavour, scene, wrong):
    given = {"colors_precomp": torch.ones(40, 3, dtype=torch.float64),
             "cov3D_precomp": torch.ones(40, 6, dtype=torch.float64)}
    inputs = {**scene.inputs, **{name: given[name] if value else None for name, value in wrong.items()}}
    with pytest.raises(ValueError, match="rasterize"):
        flavour.GaussianRasterizer(settings_of(flavour, scene.settings))(**inputs)


def test_the_blend_mode_comes_from_the_settings_or_the_environment(flavour, mode, monkeypatch):
    scene = random_scene(mode, 60, 45, 30, seed=7)
    expected = reference_gradients(scene)[0].color

    def color(**others):
        return flavour.GaussianRasterizer(settings_of(flavour, scene.settings, **others))(**scene.inputs)[0]

    assert_close(color(blend_mode=mode), expected, TOLERANCE, "settings")
    alpha = color()
    monkeypatch.setenv("DSMOE_BLEND_MODE", mode)
    assert_close(color(), expected, TOLERANCE, "environment")
    assert torch.equal(color(blend_mode="alpha"), alpha)
    if mode != "alpha":
        assert (alpha - color()).abs().max() > 0.01


def test_the_background_gate_comes_from_the_settings_or_the_environment(flavour, monkeypatch):
    scene = random_scene("smoe", 60, 45, 30, seed=7)
    expected = rasterize(settings=scene.settings._replace(background_gate=0.3), **scene.inputs).color

    def color(**others):
        return flavour.GaussianRasterizer(settings_of(flavour, scene.settings, blend_mode="smoe", **others))(
            **scene.inputs)[0]

    gate = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    given = color(background_gate=gate)
    assert torch.equal(given, expected) and (given - color()).abs().max() > 0.01
    given.sum().backward()
    assert gate.grad != 0
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.3")
    assert torch.equal(color(), expected)


def test_an_unknown_blend_mode_is_refused(flavour, scene):
    with pytest.raises(ValueError, match="gamma"):
        flavour.GaussianRasterizer(settings_of(flavour, scene.settings, blend_mode="gamma"))(**scene.inputs)


def test_mark_visible_is_the_near_plane(flavour, scene):
    settings = settings_of(flavour, scene.settings)
    visible = flavour.GaussianRasterizer(settings).markVisible(scene.inputs["means3D"])
    depths = scene.inputs["means3D"] @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]
    assert visible.dtype == torch.bool and visible.any() and not visible.all()
    assert torch.equal(visible, depths > 0.2)


def test_no_gaussians_leave_the_background(flavour, mode):
    scene = random_scene(mode, 40, 33, 21, degree=1).rows(slice(0)).requiring_grad(camera=False)
    results = flavour.GaussianRasterizer(settings_of(flavour, scene.settings, blend_mode=mode))(**scene.inputs)
    assert torch.equal(results[0], scene.settings.bg[:, None, None].expand(3, 21, 33))
    assert results[1].shape == (0,)
    results[0].sum().backward()
    assert scene.inputs["shs"].grad.shape == (0, 4, 3)


def test_the_package_installs_the_modules():
    assert "diff_smoe_rasterization.integrations" in packages_and_data()[0]
