"""NaN and infinity in any attribute: the Gaussian is culled, the others do not notice; `strict` raises instead."""
from __future__ import annotations

import math

import pytest
import torch
from comparison import assert_close
from scenes import gradients, random_scene

from diff_smoe_rasterization import rasterize
from diff_smoe_rasterization.settings import OUTPUTS

pytestmark = pytest.mark.usefixtures("device")

COUNT = 40
# If another Gaussian is left out, sums over Gaussians and tiles may be formed in another order.
REORDERED = 1e-5
ATTRIBUTES = [
    ("means3D", {}), ("opacities", {}), ("shs", {}), ("scales", {}), ("rotations", {}), ("dc", dict(split_dc=True)),
    ("shs", dict(split_dc=True)), ("colors_precomp", dict(channels=3)), ("colors_precomp", dict(channels=5)),
    ("cov3D_precomp", dict(covariance="cov3D")),
]


def identifier(part):
    return part if isinstance(part, str) else "-".join(part)


def scene_and_visible(mode, **options):
    scene = random_scene(mode, COUNT, 33, 21, degree=1, dtype=torch.float32, **options)
    visible = (rasterize(settings=scene.settings, **scene.inputs).radii > 0).nonzero()[:, 0].tolist()
    assert len(visible) > 10
    return scene, visible


def broken(scene, name, index, value, column=-1):
    tensor = scene.inputs[name].clone()
    tensor[index].view(-1)[column] = value
    return scene.with_inputs(**{name: tensor})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name, options", ATTRIBUTES, ids=identifier)
def test_a_gaussian_that_is_not_finite_is_culled(mode, name, options, value):
    scene, visible = scene_and_visible(mode, **options)
    index = visible[4]
    others = torch.arange(COUNT) != index
    for column in (0, -1):
        rendering, gradient = gradients(rasterize, broken(scene, name, index, value, column), OUTPUTS)
        expected, expected_gradient = gradients(rasterize, scene.rows(others), OUTPUTS)
        assert rendering.radii[index] == 0
        assert torch.equal(rendering.radii[others], expected.radii)
        for image, expected_image in zip(rendering, expected):
            if image.dim() == 3:
                assert_close(image, expected_image, REORDERED, "image")
        for attribute, values in gradient.items():
            if attribute in scene.inputs:
                assert not values[index].any(), attribute  # NaN counts as any
                values = values[others]
            assert_close(values, expected_gradient[attribute], REORDERED, attribute)


def test_an_opacity_has_a_limit_below_which_gradients_are_finite(mode):
    scene, visible = scene_and_visible(mode)
    index, others = visible[4], torch.arange(COUNT) != visible[4]
    rendering, gradient = gradients(rasterize, broken(scene, "opacities", index, 1e20))
    assert rendering.radii[index] > 0 and all(values.isfinite().all() for values in gradient.values())
    for value in (1.1e20, 1e38, -1e38):
        rendering = rasterize(settings=scene.settings, **broken(scene, "opacities", index, value).inputs)
        assert rendering.radii[index] == 0
        expected = rasterize(settings=scene.settings, **scene.rows(others).inputs)
        assert_close(rendering.color, expected.color, REORDERED, "image")
    strict = broken(scene.with_settings(strict=True), "opacities", index, 1e38)
    with pytest.raises(ValueError, match=rf"opacities\[{index}\] is not finite or above 1e20"):
        rasterize(settings=strict.settings, **strict.inputs)


def test_every_gaussian_not_finite_leaves_the_background(mode):
    scene, _ = scene_and_visible(mode)
    scene = scene.with_inputs(means3D=torch.full((COUNT, 3), math.nan))
    rendering, gradient = gradients(rasterize, scene)
    background = scene.settings.bg[:, None, None].expand_as(rendering.color)
    assert torch.equal(rendering.color, background)
    assert not any(values.any() for name, values in gradient.items() if name != "bg")


def test_a_coefficient_above_the_active_degree_counts_as_an_attribute(mode):
    scene, visible = scene_and_visible(mode)
    scene = broken(scene.with_settings(sh_degree=0), "shs", visible[2], math.nan)
    assert rasterize(settings=scene.settings, **scene.inputs).radii[visible[2]] == 0


@pytest.mark.parametrize("name, options", ATTRIBUTES, ids=identifier)
def test_strict_names_argument_and_index(mode, name, options):
    scene, visible = scene_and_visible(mode, **options)
    scene = broken(scene.with_settings(strict=True), name, visible[4], math.nan)
    with pytest.raises(ValueError, match=rf"rasterize.*{name}.*\b{visible[4]}\b"):
        rasterize(settings=scene.settings, **scene.inputs)


def test_strict_accepts_finite_input(mode):
    scene, _ = scene_and_visible(mode)
    strict = scene.with_settings(strict=True)
    assert torch.equal(rasterize(settings=strict.settings, **strict.inputs).color,
                       rasterize(settings=scene.settings, **scene.inputs).color)


def test_the_value_of_means2D_is_ignored(mode):
    scene, _ = scene_and_visible(mode)
    moved = scene.with_inputs(means2D=torch.full((COUNT, 3), 0.7))
    assert torch.equal(rasterize(settings=moved.settings, **moved.inputs).color,
                       rasterize(settings=scene.settings, **scene.inputs).color)
