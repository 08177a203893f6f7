"""What a rendering knows of each Gaussian (`Splats`): its place, and the sums over the pixels that blended it."""
from __future__ import annotations

import math

import pytest
import torch
from by_hand import facing_camera, on_axis
from comparison import assert_close, assert_same_gradients, reference_contributions
from devices import default_device, random_normal
from scenes import blend_of, gate_of, gradients, random_scene, transmittance_of, with_gate, with_gates

from diff_smoe_rasterization import Contributions, GateMap, rasterize, rasterize_with_splats
from diff_smoe_rasterization.settings import OUTPUTS

pytestmark = pytest.mark.usefixtures("device")

# A sum of some thousand terms in float64, each with some hundred roundings of 1e-16.
TOLERANCE = 1e-12

SCENES = {
    "harmonics": lambda mode: random_scene(mode, 120, 50, 37),
    "split_harmonics": lambda mode: random_scene(mode, 120, 50, 37, split_dc=True),
    "covariances": lambda mode: random_scene(mode, 120, 50, 37, covariance="cov3D", channels=5),
    "antialiasing": lambda mode: random_scene(mode, 120, 50, 37, scale=0.02, antialiasing=True),
    "alpha_min": lambda mode: random_scene(mode, 120, 50, 37, alpha_min=1 / 255),
    "saturated": lambda mode: random_scene(mode, 200, 40, 33, scale=0.4, opacity=(0.5, 4.0)),
    "one_row": lambda mode: random_scene(mode, 120, 50, 1, scale=0.3),
    "one_pixel": lambda mode: random_scene(mode, 120, 1, 1, scale=0.3),
    "one_tile": lambda mode: random_scene(mode, 120, 16, 16),
    "one_pixel_more_than_tiles": lambda mode: random_scene(mode, 120, 17, 33),
}


def weights_for(settings, seed=5, dtype=torch.float64):
    return random_normal((settings.image_height, settings.image_width), seed, dtype)


def splats_of(scene, **more):
    return rasterize_with_splats(settings=scene.settings, **scene.inputs, **more)[1]


def assert_are(actual, expected, tolerance=TOLERANCE):
    assert isinstance(actual, Contributions)
    for name, values, other in zip(Contributions._fields, actual, expected):
        assert values.is_contiguous() and not values.requires_grad
        if name == "pixels":
            assert values.dtype == torch.int32 and torch.equal(values.cpu(), other.cpu())
        else:
            assert_close(values, other, tolerance, name)


@with_gate
@pytest.mark.parametrize("name", SCENES)
def test_places_and_sums_are_the_references(mode, name):
    scene = SCENES[name](mode)
    pixel_weights = weights_for(scene.settings)
    rendering, splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)
    centers, depths, expected = reference_contributions(scene, pixel_weights)
    assert_close(splats.centers, centers, TOLERANCE, "centers")
    assert_close(splats.depths, depths, TOLERANCE, "depths")
    assert_are(splats.contributions(pixel_weights), expected)
    assert (expected.pixels > 0).sum() > 5
    culled = rendering.radii == 0
    assert culled.any() and not splats.centers[culled].any() and not splats.depths[culled].any()
    assert not splats.contributions(pixel_weights).pixels[culled].any()


def scene_of_weights(mode, scale, dtype, count=40):
    """Its image has a channel for each Gaussian: the map of that Gaussian's weights."""
    scene = random_scene(mode, count, 61, 43, scale=scale, opacity=(0.1, 3.0), channels=count, dtype=dtype,
                         bg=torch.zeros(count))
    return scene.with_inputs(colors_precomp=torch.eye(count, dtype=dtype))


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_pairs_are_those_that_the_image_was_blended_of(mode, dtype):
    scene = scene_of_weights(mode, 0.25, dtype)
    pixel_weights = weights_for(scene.settings, dtype=dtype)
    rendering, splats = rasterize_with_splats(settings=scene.settings, outputs=("alpha",), **scene.inputs)
    blended = rendering.color > 0
    denominator = rendering.alpha + gate_of(mode) * (1 - rendering.alpha)
    if blend_of(mode) == "smoe":  # its alpha is W / D, with W = 1 - T
        denominator = (1 - transmittance_of(scene)) / rendering.alpha.clamp(min=1e-30)
    weights = (rendering.color * denominator).double()
    y, x = torch.meshgrid(torch.arange(43), torch.arange(61), indexing="ij")
    centers = splats.centers.double()[:, :, None, None]
    distances = torch.hypot(x - centers[:, 0], y - centers[:, 1])
    actual = splats.contributions(pixel_weights)
    assert blended.sum() > 5000
    assert torch.equal(actual.pixels, blended.sum((1, 2)).int())
    # float32: sums of up to 2623 numbers, each rounded by 6e-8; of the weights the mean cancels.
    tolerance = TOLERANCE if dtype == torch.float64 else 1e-5
    assert_close(actual.pixel_weights, (pixel_weights.double() * blended).sum((1, 2)), tolerance, "pixel weights")
    assert_close(actual.blend_weights, weights.sum((1, 2)), tolerance, "blend weights")
    assert_close(actual.distances, (distances * blended).sum((1, 2)), tolerance, "distances")


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_gate_map_is_what_the_image_was_blended_of(mode, dtype):
    """What divides the weights of a pixel does not change which is the largest."""
    scene = scene_of_weights(mode, 0.1, dtype)
    rendering, splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)
    actual = splats.gate_map()
    assert isinstance(actual, GateMap)
    assert all(image.shape == (43, 61) and image.dtype == torch.int32 for image in actual)
    best = rendering.color.topk(2, dim=0)
    assert torch.equal(actual.counts, (rendering.color > 0).sum(0).int())
    empty = best.values[0] == 0
    assert empty.any() and torch.equal(actual.gaussians < 0, empty)
    clear = best.values[0] > 1.0001 * best.values[1]  # rounding may turn what is closer
    assert clear.sum() > 500 and torch.equal(actual.gaussians[clear], best.indices[0][clear].int())
    assert len(actual.gaussians.unique()) > 20
    order = torch.arange(len(splats.depths)) if mode == "smoe_std" else splats.depths.argsort()
    sums = rendering.color[order].cumsum(0)
    half = torch.where(sums[-1] >= 0.5, order[(sums >= 0.5).int().argmax(0)], -1)
    clear = ((sums - 0.5).abs() > 1e-4).all(0)
    assert clear.sum() > 500 and torch.equal(actual.medians[clear], half[clear].int())
    assert len(actual.medians.unique()) > 10


@with_gates
def test_two_gaussians_by_hand(mode):
    """On the axis, round, one behind the other: sums over rows and columns of a formula."""
    width, height, variance, opacities, depths = 11, 7, 0.04, (0.8, 0.6), (2.0, 3.0)
    settings = facing_camera(mode, width, height)
    pixel_weights = weights_for(settings)
    splats = rasterize_with_splats(settings=settings, **on_axis(depths, opacities, [(1, 0, 0), (0, 1, 0)], variance))[1]
    actual = splats.contributions(pixel_weights)
    center_x, center_y = (width - 1) / 2, (height - 1) / 2
    sums = [[0.0] * 4 for _ in depths]
    for y in range(height):
        for x in range(width):
            transmittance = 1.0
            for total, opacity, depth in zip(sums, opacities, depths):
                # Focal lengths are half the image's size, in x and in y; 0.3 px^2 are added.
                exponent = -0.5 * ((x - center_x) ** 2 / (variance * (width / 2 / depth) ** 2 + 0.3)
                                   + (y - center_y) ** 2 / (variance * (height / 2 / depth) ** 2 + 0.3))
                alpha = opacity * math.exp(exponent)
                if blend_of(mode) == "smoe":
                    faint = alpha < 1 / 2040
                else:
                    faint = alpha < gate_of(mode) / 255 and (mode == "alpha" or exponent < -4.5)
                    faint |= mode != "alpha" and exponent < math.log(1e-5)
                if faint:
                    continue
                weight = alpha if mode == "smoe_std" else alpha * transmittance
                distance = math.hypot(x - center_x, y - center_y)
                for i, value in enumerate((pixel_weights[y, x].item(), 1, weight, distance)):
                    total[i] += value
                transmittance *= 1 - alpha
    assert 5 < sums[0][1] < width * height
    expected = torch.tensor(sums, dtype=torch.float64, device="cpu").T
    # 1e-7 is added to the clip w, which moves no centre here and no other number.
    assert_are(actual, Contributions(expected[0], expected[1].int(), *expected[2:]), 1e-12)
    assert_close(splats.centers, torch.tensor([[center_x, center_y]] * 2).double(), 1e-12, "centers")
    assert splats.depths.tolist() == list(depths)


@with_gate
def test_what_fills_a_pixel_and_what_is_behind_it_have_no_share(mode):
    """T is 0.01, then 0.001; the third would leave 1e-5, so that it and the last are left out of the numerator."""
    settings = facing_camera(mode, 1, 1)
    opacities = (3.0, 0.9, 0.99, 0.5)  # the first at 0.99 at most
    splats = rasterize_with_splats(settings=settings, **on_axis((1, 2, 3, 4), opacities, [(1, 1, 1)] * 4))[1]
    actual = splats.contributions(torch.full((1, 1), 7.0, dtype=torch.float64))
    if mode == "smoe_std":
        pixels, blend_weights = [1, 1, 1, 1], [0.99, 0.9, 0.99, 0.5]
    else:
        pixels, blend_weights = [1, 1, 0, 0], [0.99, 0.9 * 0.01, 0, 0]
    assert actual.pixels.tolist() == pixels and actual.pixel_weights.tolist() == [7.0 * count for count in pixels]
    # 0.99 is a float32 number there, 1 - 0.99 differs by 1e-6 of itself.
    assert actual.blend_weights.tolist() == pytest.approx(blend_weights, rel=2e-6)
    assert actual.distances.tolist() == pytest.approx([0, 0, 0, 0], abs=1e-6)  # 1e-7 in the clip w


def test_several_maps_on_one_rendering(mode):
    """The sums are linear in the map, and the image's own error may be the map: one rendering does."""
    scene = random_scene(mode, 120, 50, 37)
    rendering, splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)
    first, second = (rendering.color - 0.5).abs().mean(0), weights_for(scene.settings)
    both = splats.contributions(2 * first - 3 * second).pixel_weights
    separate = 2 * splats.contributions(first).pixel_weights - 3 * splats.contributions(second).pixel_weights
    assert_close(both, separate, TOLERANCE, "linear")
    ones = splats.contributions(torch.ones_like(first))
    assert torch.equal(ones.pixel_weights, ones.pixels.double())


def test_a_map_need_not_be_contiguous(mode):
    scene = random_scene(mode, 120, 50, 37)
    splats = splats_of(scene)
    pixel_weights = weights_for(scene.settings)
    turned = pixel_weights.T.contiguous().T
    assert not turned.is_contiguous()
    assert_are(splats.contributions(turned), splats.contributions(pixel_weights))


def test_a_nan_in_the_map_reaches_the_gaussians_of_its_pixel_alone(mode):
    scene = random_scene(mode, 120, 50, 37)
    splats = splats_of(scene)
    pixel_weights, one = weights_for(scene.settings), torch.zeros(37, 50, dtype=torch.float64)
    one[20, 24] = 1
    there = splats.contributions(one).pixel_weights > 0
    expected = splats.contributions(pixel_weights)
    actual = splats.contributions(torch.where(one > 0, torch.full_like(one, math.nan), pixel_weights))
    assert there.any() and not there.all()
    assert torch.equal(actual.pixel_weights.isnan(), there)
    assert_close(actual.pixel_weights[~there], expected.pixel_weights[~there], TOLERANCE, "others")
    assert torch.equal(actual.pixels, expected.pixels)


@with_gate
def test_images_and_gradients_are_those_of_rasterize(mode):
    """And the sums leave what the backward pass needs as it was."""
    def render(settings, outputs, **inputs):
        rendering, splats = rasterize_with_splats(settings=settings, outputs=outputs, **inputs)
        splats.contributions(weights_for(settings).requires_grad_(True))
        splats.centers.fill_(0), splats.depths.fill_(0)
        return rendering

    scene = random_scene(mode, 60, 45, 30, seed=3)
    actual, actual_gradients = gradients(render, scene, OUTPUTS)
    expected, expected_gradients = gradients(rasterize, scene, OUTPUTS)
    for first, second in zip(actual, expected):
        assert torch.equal(first, second)
    assert_same_gradients(actual_gradients, expected_gradients)


def test_nothing_of_splats_has_a_gradient(mode):
    scene = random_scene(mode, 60, 45, 30).requiring_grad()
    rendering, splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)
    assert rendering.color.requires_grad
    sums = splats.contributions(rendering.color.mean(0))
    for values in (splats.centers, splats.depths, *sums):
        assert not values.requires_grad


def test_nothing_to_see(mode):
    scene = random_scene(mode, 60, 45, 30)
    for hidden, count in ((scene.rows(slice(0)), 0),
                          (scene.with_inputs(means3D=scene.inputs["means3D"] + 30 * scene.settings.campos), 60)):
        splats = splats_of(hidden)
        assert splats.centers.shape == (count, 2) and splats.depths.shape == (count,) and not splats.centers.any()
        for values in splats.contributions(weights_for(scene.settings)):
            assert values.shape == (count,) and not values.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_threads_and_repetition_change_no_bit(mode, dtype, device):
    if device.type != "cpu":
        pytest.skip("sums by atomics: real numbers may differ in their last digits")
    scene = random_scene(mode, 5000, 131, 83, scale=0.1, degree=1, dtype=dtype)
    pixel_weights, threads_before, results = weights_for(scene.settings, dtype=dtype), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 2, 1):
            torch.set_num_threads(threads)
            results.append(splats_of(scene).contributions(pixel_weights))
    finally:
        torch.set_num_threads(threads_before)
    assert (results[0].pixels > 0).sum() > 500
    for other in results[1:]:
        for first, second in zip(results[0], other):
            assert torch.equal(first, second)


@pytest.mark.parametrize("wrong, error, pattern", [
    (lambda: torch.ones(37, 49, dtype=torch.float64), ValueError, r"pixel_weights has shape \[37, 49\].*\[37, 50\]"),
    (lambda: torch.ones(1, 37, 50, dtype=torch.float64), ValueError, r"pixel_weights has shape \[1, 37, 50\]"),
    (lambda: torch.ones(0, dtype=torch.float64), ValueError, r"pixel_weights has shape \[0\]"),
    (lambda: torch.ones(37, 50, dtype=torch.float32), TypeError, r"pixel_weights is float32.*float64"),
    (lambda: torch.ones(37, 50, dtype=torch.int32), TypeError, r"pixel_weights is int32.*float64"),
    (lambda: [[1.0] * 50] * 37, TypeError, r"pixel_weights is of type list"),
    (lambda: None, TypeError, r"pixel_weights is of type NoneType"),
], ids=["shape", "batch", "empty", "float32", "int32", "list", "none"])
def test_a_map_that_does_not_fit_is_named(wrong, error, pattern):
    splats = splats_of(random_scene("smoe", 30, 50, 37))
    with pytest.raises(error, match="contributions: " + pattern):
        splats.contributions(wrong())


def test_a_map_on_another_device_is_named(device):
    if device.type == "cpu":
        pytest.skip("there is one device")
    splats = splats_of(random_scene("smoe", 30, 50, 37))
    assert default_device().type == "cuda"
    with pytest.raises(TypeError, match="pixel_weights is on cpu; it must be on cuda"):
        splats.contributions(torch.ones(37, 50, dtype=torch.float64, device="cpu"))


def test_arguments_that_rasterize_refuses_are_refused():
    scene = random_scene("smoe", 30, 50, 37)
    with pytest.raises(ValueError, match="rasterize: opacities has shape"):
        splats_of(scene.with_inputs(opacities=torch.ones(29, 1, dtype=torch.float64)))
    with pytest.raises(ValueError, match="rasterize_with_splats: outputs is"):
        splats_of(scene, outputs=("normals",))
