"""The gradient of means2D_abs: sums over pixels of |dL/d(pixel)|, which densification reads beside means2D."""
from __future__ import annotations

import pytest
import torch
from comparison import assert_all_close, assert_close, one_thread, threshold_margin
from devices import on_the_cpu
from scenes import gradients, random_scene, random_weights, with_gates

from diff_smoe_rasterization import GaussianRasterizer, rasterize, reference
from diff_smoe_rasterization.settings import OUTPUTS

pytestmark = pytest.mark.usefixtures("device")

SCENES = {  # few pixels, because the reference goes through them one by one, but more than one tile
    "colours": lambda mode: random_scene(mode, 24, 19, 6, scale=0.3, channels=3),
    "harmonics": lambda mode: random_scene(mode, 24, 5, 18, scale=0.3),
    "features": lambda mode: random_scene(mode, 24, 18, 4, scale=0.3, channels=5, antialiasing=True),
}


def asking(scene):
    """Returns the scene with means2D_abs, whose values are not to be read."""
    return scene.with_inputs(means2D_abs=torch.full((len(scene.inputs["means3D"]), 2), 7.0, dtype=torch.float64).to(
        scene.inputs["means3D"]))


def expected_sums(scene, outputs):
    """Sums of |dL/dmeans2D| [N, 2], of the reference, with the loss of one pixel at a time."""
    with one_thread(), on_the_cpu():
        scene = scene.to("cpu").requiring_grad()
        rendering = reference.rasterize(settings=scene.settings, outputs=outputs, **scene.inputs)
        images, weights = random_weights(rendering, outputs)
        losses = sum((image * weight).sum(0) for image, weight in zip(images, weights)).reshape(-1)
        points = scene.inputs["means2D"]
        return sum(torch.autograd.grad(loss, points, retain_graph=True)[0][:, :2].abs() for loss in losses)


@with_gates
@pytest.mark.parametrize("outputs", [(), OUTPUTS], ids=["colour", "all_outputs"])
@pytest.mark.parametrize("name", SCENES)
def test_they_are_the_sums_over_pixels_of_the_references_gradients(mode, name, outputs):
    scene = SCENES[name](mode)
    expected = expected_sums(scene, outputs)
    rendering, actual = gradients(rasterize, asking(scene), outputs)
    # A sum of 114 pixels in float64, each with some tens of roundings of 1e-16; most lose a digit or two by
    # cancellation within the pixel.
    assert_close(actual["means2D_abs"], expected, 1e-11, "means2D_abs")
    signed = actual["means2D"][:, :2].abs().cpu()
    assert (expected >= signed * (1 - 1e-9)).all() and (expected > 1.5 * signed).any()
    assert (expected > 0).any() and not actual["means2D_abs"][rendering.radii == 0].any()


@with_gates
def test_in_float32_they_are_those_of_float64(mode):
    """In float32 three features have code of their own, and on a GPU lists of this length have segments."""
    scene = random_scene(mode, 3000, 30, 20, scale=0.1, opacity=(0.01, 0.1), channels=3)
    rendering, expected = gradients(rasterize, asking(scene))
    _, actual = gradients(rasterize, asking(scene.to(torch.float32)))
    assert (rendering.radii > 0).sum() > 1000
    # 1e-3: float32 loses about 1e-5; a pair that is on the other side of a cut moves one Gaussian by 1 part in 1000.
    assert_close(actual["means2D_abs"], expected["means2D_abs"], 1e-3, "means2D_abs")


@with_gates
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("deterministic", [False, True])
def test_the_other_gradients_are_the_same_with_them(mode, dtype, deterministic):
    scene = random_scene(mode, 120, 50, 37, dtype=dtype, deterministic=deterministic)
    _, expected = gradients(rasterize, scene)
    asked = gradients(rasterize, asking(scene))[1]
    absolute = asked.pop("means2D_abs")
    # Roundings of 6e-8 or 1e-16 of some thousand terms, which cancel in part and are added in another order.
    assert_all_close(asked, expected, 1e-4 if dtype == torch.float32 else 1e-11)
    assert absolute.any()
    if deterministic:
        assert torch.equal(gradients(rasterize, asking(scene))[1]["means2D_abs"], absolute)


def test_there_may_be_no_gaussian_and_none_in_sight(mode):
    empty = random_scene(mode, 0, 20, 18, channels=3)
    assert gradients(rasterize, asking(empty))[1]["means2D_abs"].shape == (0, 2)
    behind = random_scene(mode, 5, 20, 18, channels=3, position=(0.0, 0.0, -4.0))
    behind.inputs["means3D"].copy_(torch.tensor([0.0, 0.0, -9.0]))
    rendering, found = gradients(rasterize, asking(behind))
    assert not rendering.radii.any() and not found["means2D_abs"].any()


def test_it_is_an_argument_of_the_function_alone():
    scene = asking(random_scene("smoe", 5, 20, 18, channels=3))
    with pytest.raises(TypeError, match="means2D_abs"):
        GaussianRasterizer(scene.settings)(**scene.inputs)
    with pytest.raises(ValueError, match=r"means2D_abs has shape \[5, 3\]; it must be \[5, 2\]"):
        rasterize(settings=scene.settings, **{**scene.inputs, "means2D_abs": torch.zeros(5, 3).double()})


def test_the_scenes_hold_no_pair_at_a_threshold(mode):
    assert all(threshold_margin(make(mode)).min() > 1e-9 for make in SCENES.values())
