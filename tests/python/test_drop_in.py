"""The contracts of Inria's 2023 rasterizer that trainers rely on."""
from __future__ import annotations

import inspect

import numpy
import pytest
import torch
from comparison import assert_close, threshold_margin
from scenes import camera_settings, gradients, random_scene, random_weights, without_tails

from diff_smoe_rasterization import (
    BLEND_MODES,
    GaussianRasterizationSettings,
    GaussianRasterizer,
    Rendering,
    rasterize,
    rasterize_gaussians,
)

pytestmark = pytest.mark.usefixtures("device")

FIELDS = ("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
          "sh_degree", "campos", "prefiltered", "debug")


@pytest.fixture
def scene(device):
    return random_scene(None, 40, 33, 21, degree=1, dtype=torch.float32)


def test_the_settings_are_built_from_twelve_keywords(scene):
    values = {name: getattr(scene.settings, name) for name in FIELDS}
    settings = GaussianRasterizationSettings(**values)
    assert settings._fields[:12] == FIELDS
    assert settings[:12] == tuple(values.values())
    assert settings.blend_mode is None
    color, radii = GaussianRasterizer(raster_settings=settings)(**scene.inputs)
    assert color.shape == (3, 21, 33) and radii.shape == (40,)


def test_the_settings_are_a_named_tuple(scene):
    larger = scene.settings._replace(image_width=40)
    assert larger.image_width == 40 and scene.settings.image_width == 33
    color, _ = GaussianRasterizer(larger)(**scene.inputs)
    assert color.shape == (3, 21, 40)


def test_the_order_of_arguments(scene):
    assert list(inspect.signature(rasterize_gaussians).parameters) == [
        "means3D", "means2D", "sh", "colors_precomp", "opacities", "scales", "rotations", "cov3Ds_precomp",
        "raster_settings"]
    assert list(inspect.signature(GaussianRasterizer.forward).parameters)[:9] == [
        "self", "means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp"]
    i, empty = scene.inputs, torch.Tensor([])
    rasterizer = GaussianRasterizer(scene.settings)
    expected = rasterizer(**i)
    positional = rasterizer(i["means3D"], i["means2D"], i["opacities"], i["shs"], None, i["scales"], i["rotations"])
    function = rasterize_gaussians(i["means3D"], i["means2D"], i["shs"], empty, i["opacities"], i["scales"],
                                   i["rotations"], empty, scene.settings)
    for result in (positional, function):
        assert len(result) == 2
        assert torch.equal(result[0], expected[0]) and torch.equal(result[1], expected[1])


def test_the_rasterizer_is_a_module_with_its_settings(scene):
    rasterizer = GaussianRasterizer(raster_settings=scene.settings)
    assert isinstance(rasterizer, torch.nn.Module)
    assert rasterizer.raster_settings is scene.settings


def test_two_results_and_whole_numbers_for_radii(mode, scene):
    color, radii = GaussianRasterizer(scene.settings._replace(blend_mode=mode))(**scene.inputs)
    assert color.dtype == torch.float32 and radii.dtype == torch.int32
    assert not radii.requires_grad
    assert radii.any() and not radii.all()


def test_rasterize_returns_a_rendering(scene):
    rendering = rasterize(scene.inputs.pop("means3D"), scene.inputs.pop("opacities"), scene.settings, **scene.inputs)
    assert isinstance(rendering, Rendering)
    assert rendering._fields[:2] == ("color", "radii")


def test_empty_cpu_tensors_are_absent_inputs(scene):
    empty = torch.Tensor([])
    expected, _ = GaussianRasterizer(scene.settings)(**scene.inputs)
    color, _ = GaussianRasterizer(scene.settings)(colors_precomp=empty, cov3D_precomp=empty, **scene.inputs)
    assert torch.equal(color, expected)
    double = scene.to(torch.float64)  # absent means absent, whatever the type of the empty tensor
    color, _ = GaussianRasterizer(double.settings)(colors_precomp=empty, cov3D_precomp=empty, **double.inputs)
    assert color.dtype == torch.float64


def test_the_camera_may_have_a_batch_axis_of_one(scene):
    """SplaTAM passes matrices of shape [1, 4, 4]."""
    settings = scene.settings
    batched = settings._replace(viewmatrix=settings.viewmatrix[None], projmatrix=settings.projmatrix[None])
    assert torch.equal(GaussianRasterizer(batched)(**scene.inputs)[0], GaussianRasterizer(settings)(**scene.inputs)[0])


def test_the_colours_may_be_given(scene):
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "shs"}
    color, _ = GaussianRasterizer(scene.settings)(colors_precomp=torch.ones(40, 3), **inputs)
    white, _ = GaussianRasterizer(scene.settings._replace(bg=torch.ones(3)))(colors_precomp=torch.ones(40, 3), **inputs)
    assert color.max() > 0.9
    assert (white - 1).abs().max() < 1e-5  # weights and transmittance sum to one, up to rounding


def test_mark_visible_is_the_near_plane():
    settings = camera_settings(33, 21, dtype=torch.float32)
    positions = random_scene("alpha", 500, dtype=torch.float32).inputs["means3D"]
    visible = GaussianRasterizer(settings).markVisible(positions)
    depth = positions @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]
    assert visible.dtype == torch.bool and visible.shape == (500,)
    assert visible.any() and not visible.all()
    assert torch.equal(visible, depth > 0.2)


def test_mark_visible_excludes_the_plane_itself():
    plane = numpy.float32(0.2)
    settings = camera_settings(33, 21, dtype=torch.float32)._replace(viewmatrix=torch.eye(4))
    depths = [float(plane), float(numpy.nextafter(plane, numpy.float32(1))), -1.0, 5.0, float("nan")]
    positions = torch.tensor([[100.0, 0.0, depth] for depth in depths])
    assert GaussianRasterizer(settings).markVisible(positions).tolist() == [False, True, False, True, False]
    nearer = GaussianRasterizer(settings._replace(near=0.1)).markVisible(positions)
    assert nearer.tolist() == [True, True, False, True, False]


def test_means2D_receives_the_gradient_in_normalised_device_coordinates(mode):
    scene = without_tails(random_scene(mode, 8, 30, 20, seed=1, scale=0.3, opacity=(0.3, 0.8), channels=3))
    assert threshold_margin(scene).min() > 1e-4
    rendering, analytic = gradients(rasterize, scene)
    assert (rendering.radii > 0).sum() > 3
    weights = random_weights(rendering)[1][0]
    step_in_pixels = 1e-5
    for axis, size in ((0, 30), (1, 20)):
        losses = []
        for sign in (1, -1):
            # Adding w times s to x or y of the clip coordinates moves every splat by s / 2 times the image size.
            matrix = scene.settings.projmatrix.clone()
            matrix[:, axis] += sign * step_in_pixels / (0.5 * size) * matrix[:, 3]
            moved = scene.settings._replace(projmatrix=matrix)
            losses.append((rasterize(settings=moved, **scene.inputs).color * weights).sum().item())
        per_pixel = (losses[0] - losses[1]) / (2 * step_in_pixels)
        # 1e-6: rounding of the loss over the step, and w + 1e-7 in place of w.
        assert analytic["means2D"][:, axis].sum().item() == pytest.approx(0.5 * size * per_pixel, rel=1e-6)
    assert not analytic["means2D"][:, 2].any()


def test_means2D_grad_is_there_after_backward(mode, scene):
    points = torch.zeros_like(scene.inputs["means3D"], requires_grad=True) + 0
    points.retain_grad()
    color, radii = GaussianRasterizer(scene.settings._replace(blend_mode=mode))(**{**scene.inputs, "means2D": points})
    color.mean().backward()
    assert points.grad.shape == (40, 3)
    assert points.grad[radii > 0].any() and not points.grad[radii == 0].any()


def test_the_radius_is_the_same_in_every_mode():
    radii = {mode: rasterize(settings=scene.settings, **scene.inputs).radii for mode in BLEND_MODES
             for scene in [random_scene(mode, 300)]}
    by_kernel = radii["smoe_eq7"]
    assert torch.equal(radii["alpha"], radii["smoe"])
    assert torch.equal(by_kernel, radii["smoe_tn"]) and torch.equal(by_kernel, radii["smoe_std"])
    both = (radii["alpha"] > 0) & (by_kernel > 0)
    assert both.sum() > 100
    assert torch.equal(radii["alpha"][both], by_kernel[both])


def test_what_receives_a_gradient_has_a_radius(mode):
    rendering, gradient = gradients(rasterize, random_scene(mode, 300, opacity=(0.5, 1.0)))
    touched = gradient["opacities"][:, 0] != 0
    assert touched.sum() > 100
    assert (rendering.radii[touched] > 0).all()


def test_an_explicit_blend_mode_wins_over_the_environment(scene, monkeypatch):
    def color(blend_mode):
        return GaussianRasterizer(scene.settings._replace(blend_mode=blend_mode))(**scene.inputs)[0]

    explicit = {mode: color(mode) for mode in BLEND_MODES}
    assert torch.equal(color(None), explicit["alpha"])
    for environment in BLEND_MODES:
        monkeypatch.setenv("DSMOE_BLEND_MODE", environment)
        assert torch.equal(color(None), explicit[environment])
        for mode in BLEND_MODES:
            assert torch.equal(color(mode), explicit[mode])
    monkeypatch.setenv("DSMOE_BLEND_MODE", "")
    assert torch.equal(color(None), explicit["alpha"])


@pytest.mark.parametrize("from_environment", [False, True])
def test_an_unknown_blend_mode_names_the_four(scene, monkeypatch, from_environment):
    if from_environment:
        monkeypatch.setenv("DSMOE_BLEND_MODE", "gamma")
    else:
        scene = scene.with_settings(blend_mode="gamma")
    with pytest.raises(ValueError, match="gamma.*alpha.*smoe.*smoe_tn.*smoe_std"):
        GaussianRasterizer(scene.settings)(**scene.inputs)


def test_the_four_modes_differ(scene):
    images = [rasterize(settings=scene.settings._replace(blend_mode=mode), **scene.inputs).color
              for mode in BLEND_MODES]
    for index, image in enumerate(images):
        for other in images[index + 1:]:
            assert (image - other).abs().max() > 0.01


def test_the_background_shows_through_in_alpha_and_a_little_by_tails(scene):
    wide = scene.with_inputs(scales=torch.full((40, 3), 0.8), opacities=torch.full((40, 1), 0.05))
    for mode in BLEND_MODES:
        black = rasterize(settings=wide.settings._replace(blend_mode=mode, bg=torch.zeros(3)), **wide.inputs).color
        white = rasterize(settings=wide.settings._replace(blend_mode=mode, bg=torch.ones(3)), **wide.inputs).color
        if mode == "alpha":
            assert (white - black).min() > 0.05
        elif mode == "smoe":
            assert 0 <= (white - black).min() and 0 < (white - black).max() < 0.05
        else:
            assert torch.equal(white, black)


def test_scale_modifier_equals_larger_scales(mode):
    scene = random_scene(mode, 40, 33, 21)
    modified = rasterize(settings=scene.settings._replace(scale_modifier=1.5), **scene.inputs)
    scaled = rasterize(settings=scene.settings, **{**scene.inputs, "scales": 1.5 * scene.inputs["scales"]})
    assert torch.equal(modified.radii, scaled.radii)
    assert_close(modified.color, scaled.color, 1e-12, "colour")  # float64; 1.5 s is rounded at another place
