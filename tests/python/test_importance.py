"""What each Gaussian is worth to an image (`Splats.importance`): shares, and what its removal really changes."""
from __future__ import annotations

import pytest
import torch
from by_hand import facing_camera, on_axis
from comparison import assert_close, one_thread
from devices import on_the_cpu, random_normal
from scenes import (
    BACKGROUND_GATES,
    REMOVABLE_MODES,
    blend_of,
    gate_of,
    random_scene,
    transmittance_of,
    with_removal,
)

from diff_smoe_rasterization import Importance, rasterize_with_splats, reference

pytestmark = pytest.mark.usefixtures("device")

# float64: sums of some thousand terms, whose roundings of 1e-16 grow by 1 / (1 - alpha) <= 100 and, if a pixel's
# other owners are faint, by their share of it.
TOLERANCE = 1e-9

SCENES = {
    "harmonics": lambda mode: random_scene(mode, 50, 33, 21, scale=0.2),
    "five_channels": lambda mode: random_scene(mode, 50, 33, 21, scale=0.2, covariance="cov3D", channels=5),
    "one_pixel": lambda mode: random_scene(mode, 50, 1, 1, scale=0.3),
    "sparse": lambda mode: random_scene(mode, 50, 40, 33, scale=0.03, opacity=(0.02, 0.9)),
}

with_removals = pytest.mark.parametrize("mode", REMOVABLE_MODES + tuple(BACKGROUND_GATES))


def maps_for(settings, dtype=torch.float64):
    shape = (settings.image_height, settings.image_width)
    return [random_normal(shape, seed, dtype).abs() + 0.1 for seed in (5, 6)]


def importance_of(scene, *maps, **more):
    return rasterize_with_splats(settings=scene.settings, **scene.inputs, **more)[1].importance(*maps)


def expected_of(scene, *maps):
    """Importance by the reference, which blends the image again without each Gaussian, on the CPU."""
    scene = scene.to("cpu")
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "means2D"}
    with one_thread(), on_the_cpu():
        return reference.importance(settings=scene.settings, pixel_weights=maps[0].cpu(), share_weights=maps[1].cpu(),
                                    **inputs)


def without_full_pixels(scene):
    """The scene with opacities at which no pixel is full: the removal's image is then known wherever it is seen."""
    scene = scene.with_inputs(opacities=scene.inputs["opacities"] * 0.15)
    assert (transmittance_of(scene) > 1e-3).all()
    return scene


@with_removals
@pytest.mark.parametrize("name", SCENES)
def test_equals_the_image_blended_again_without_each_gaussian(mode, name):
    scene = without_full_pixels(SCENES[name](mode))
    maps = maps_for(scene.settings)
    actual, expected = importance_of(scene, *maps), expected_of(scene, *maps)
    assert isinstance(actual, Importance)
    for field, values, other in zip(Importance._fields, actual, expected):
        assert values.is_contiguous() and not values.requires_grad
        assert_close(values, other, TOLERANCE, field)
    assert (expected.removal_costs > 0).sum() > 5


@pytest.mark.parametrize("mode", ["alpha", "smoe", "smoe_eq7", "smoe_learned_gate"])
def test_full_pixels_hide_no_more_than_they_may_reveal(mode):
    """Behind a full pixel nothing is known: its image without a Gaussian may take more, of a weight below T'."""
    scene = random_scene(mode, 150, 20, 16, scale=0.5, opacity=(0.5, 0.9), channels=3)
    scene = scene.with_inputs(colors_precomp=scene.inputs["colors_precomp"].sigmoid())
    scene = scene.with_settings(bg=scene.settings.bg.sigmoid())
    ones = torch.ones(16, 20, dtype=torch.float64)
    splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1]
    actual, expected = splats.importance(ones), expected_of(scene, ones, ones)
    assert_close(actual.shares, expected.shares, TOLERANCE, "shares")
    # A pixel stops if a pair of alpha <= 0.9 would lead below 1e-4, so at T < 1e-3. Without a Gaussian that is 10 T
    # at most, of colours that differ by sqrt(3) at most; D' is 0.99 at least there.
    transmittance = transmittance_of(scene)
    may_reveal = 10 * transmittance[transmittance < 1e-3] * 3**0.5 / 0.99
    assert len(may_reveal) > 10
    difference = (actual.removal_costs.cpu().sqrt() - expected.removal_costs.sqrt()).abs()
    assert 1e-9 < difference.max() < may_reveal.norm().cpu()


@with_removals
def test_the_only_owner_leaves_the_background(mode):
    """One Gaussian: without it every pixel it was in shows the background, whatever the mode."""
    settings = facing_camera(mode, 11, 7)
    settings = settings._replace(bg=torch.tensor([0.1, 0.7, 0.4], dtype=torch.float64))
    scene = on_axis((2.0,), (0.8,), [(1, 0, 0)], 0.04)
    rendering, splats = rasterize_with_splats(settings=settings, **scene)
    change = rendering.color - settings.bg[:, None, None]
    importance = splats.importance()
    assert_close(importance.removal_costs, change.square().sum().reshape(1), 1e-13, "cost")
    assert change.any()


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_a_wall_by_hand(dtype, tolerance):
    """Two Gaussians that fill one pixel, by Eq. 7: without the wall in front the pixel has the colour behind it."""
    settings = facing_camera("smoe", 1, 1)
    settings = settings._replace(**{name: getattr(settings, name).to(dtype)
                                    for name in ("bg", "viewmatrix", "projmatrix", "campos")})
    inputs = on_axis((2.0, 3.0), (0.9, 0.5), [(1, 0, 0), (0, 1, 0)], 0.04)
    splats = rasterize_with_splats(settings=settings, **{name: value.to(dtype) for name, value in inputs.items()})[1]
    # w = 0.9 and 0.1 * 0.5; C = (w_1, w_2, 0) / (w_1 + w_2). Without one of them, C' is the other's colour.
    first, second = 0.9 / 0.95, 0.05 / 0.95
    costs = torch.tensor([2 * first**2, 2 * second**2], dtype=torch.float64)
    importance = splats.importance()
    assert_close(importance.removal_costs, costs, tolerance, "costs")
    assert_close(importance.shares, torch.tensor([first, second], dtype=torch.float64), tolerance, "shares")


@pytest.mark.parametrize("behind", [0.5, 0.01, 0.001])
def test_float32_errs_by_the_rounding_of_a_colour_over_the_part_that_is_left(behind):
    """A wall of 0.99, and what it hides: 0.5 % to 0.001 % of the pixel."""
    costs = []
    for dtype in (torch.float32, torch.float64):
        settings = facing_camera("smoe", 1, 1)
        settings = settings._replace(**{name: getattr(settings, name).to(dtype)
                                        for name in ("bg", "viewmatrix", "projmatrix", "campos")})
        inputs = on_axis((2.0, 3.0), (0.99, behind), [(0.9, 0.2, 0.4), (0.3, 0.7, 0.1)], 0.04)
        splats = rasterize_with_splats(settings=settings, **{name: value.float().to(dtype)
                                                             for name, value in inputs.items()})[1]
        costs.append(splats.importance().removal_costs[0].item())
    left = 0.01 * behind / (0.99 + 0.01 * behind)
    # Two roundings of three numbers below 1: of the colour, and of its distance to the wall's.
    assert abs(costs[0]**0.5 - costs[1]**0.5) < 2 * 3**0.5 * 2**-24 / left and costs[1] > 0.6


@with_removal
def test_float32_keeps_the_digits_that_rank_gaussians(mode):
    scene = random_scene(mode, 200, 64, 48, scale=0.1)
    maps = maps_for(scene.settings)
    double = importance_of(scene, *maps)
    single = importance_of(scene.to(torch.float32), *(values.float() for values in maps))
    for field, values, other in zip(Importance._fields, single, double):
        # Alphas of projected splats differ by 1e-4 at most (test_contributions), and a cost goes with their square.
        assert_close(values, other, 1e-3, field)


@with_removal
def test_shares_and_the_backgrounds_make_one(mode):
    scene = random_scene(mode, 60, 33, 21, scale=0.2)
    rendering, splats = rasterize_with_splats(settings=scene.settings, outputs=("alpha",), **scene.inputs)
    total = splats.importance().shares.sum()
    alpha, gate = rendering.alpha, gate_of(mode)
    if mode == "smoe_tn":
        assert total < (alpha > 0).sum()
        return
    if mode == "smoe_std":
        shares = (alpha > 0).to(alpha)
    elif blend_of(mode) in ("alpha", "smoe"):
        shares = alpha
    else:
        shares = torch.where(alpha > 0, alpha / (alpha + gate * (1 - alpha)).clamp(1e-30), 0.)
    assert_close(total, shares.sum(), 1e-12, "sum of shares")


@with_removal
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_does_not_depend_on_threads(mode, dtype, device):
    if device.type != "cpu":
        pytest.skip("a GPU adds by atomics")
    scene = random_scene(mode, 300, 131, 83, scale=0.1, dtype=dtype)
    maps, before, results = maps_for(scene.settings, dtype), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(importance_of(scene, *maps))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(first, second) for first, second in zip(results[0], other))


@with_removal
def test_other_outputs_and_absent_maps_change_nothing(mode):
    scene = random_scene(mode, 60, 33, 21, scale=0.2)
    ones = torch.ones(21, 33, dtype=torch.float64)
    expected = importance_of(scene, ones, ones)
    for actual in (importance_of(scene), importance_of(scene, outputs=("alpha", "depth", "inverse_depth"))):
        for values, other in zip(actual, expected):
            assert_close(values, other, 1e-12, "sums")
    with pytest.raises(ValueError, match=r"importance: share_weights has shape \[33, 21\].*\[21, 33\]"):
        importance_of(scene, ones, ones.T)
    with pytest.raises(TypeError, match="importance: pixel_weights is of type list"):
        importance_of(scene, [[1.0]])
    with pytest.raises(TypeError, match="importance: pixel_weights is float32.*float64"):
        importance_of(scene, ones.float())


@with_removal
def test_a_background_that_changes_before_sums_are_asked_for_changes_nothing(mode):
    scene = random_scene(mode, 50, 33, 21, scale=0.2)
    stepped = {name: tensor.clone() for name, tensor in scene.camera().items() if name in ("bg", "background_gate")}
    splats = rasterize_with_splats(settings=scene.settings._replace(**stepped), **scene.inputs)[1]
    for tensor in stepped.values():
        tensor += 0.5
    for values, expected in zip(splats.importance(), importance_of(scene)):
        assert_close(values, expected, 1e-12, "sums")


@pytest.mark.parametrize("mode", REMOVABLE_MODES)
def test_no_gaussians_have_no_importance(mode):
    scene = random_scene(mode, 20, 33, 21).rows(slice(0))
    assert all(values.shape == (0,) for values in importance_of(scene))
