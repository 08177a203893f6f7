"""`smoe` as the paper's authors run it: strong pairs, tails, and what the tails do to a pixel and its gradients."""
from __future__ import annotations

import math
import re

import pytest
import torch
from by_hand import facing_camera, on_axis
from comparison import assert_all_close, assert_close, one_thread
from devices import on_the_cpu, random_normal
from scenes import gradients, op_results, random_scene, without_tails

from diff_smoe_rasterization import rasterize, rasterize_with_splats, reference

pytestmark = pytest.mark.usefixtures("device")

EXACT = 1e-12  # float64
STRONG = float(torch.tensor(1 / 2040, dtype=torch.float32, device="cpu"))


@pytest.fixture(params=[rasterize, reference.rasterize], ids=["package", "reference"])
def function(request):
    return request.param


def authors_image(scene):
    """[3, H, W]: the authors' sums over a black background, pair by pair, in Python's own numbers."""
    settings = scene.settings
    width, height = settings.image_width, settings.image_height
    with torch.no_grad(), on_the_cpu():
        gaussians = reference._gather(*(scene.inputs.get(name) for name in (
            "means3D", "means2D", "opacities", "dc", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp")))
        order = reference.visible(gaussians, settings, "smoe")[1]
        splats = reference.project(reference._rows(gaussians, order), settings)
    rows = zip(*(column.tolist() for column in splats))
    image = torch.zeros(3, height, width, dtype=torch.float64, device="cpu")
    splats = []
    for (px, py), _, (xx, xy, yy), conic, opacity, color in rows:
        mid = (xx + yy) / 2
        r = math.ceil(3 * math.sqrt(mid + math.sqrt(max(float(torch.tensor(0.1)), mid * mid - (xx * yy - xy * xy)))))
        tiles = [math.floor(edge / 16) for edge in (px - r, py - r, px + r + 15, py + r + 15)]
        splats.append((px, py, conic, opacity, color, tiles))
    for y in range(height):
        for x in range(width):
            transmittance, strong, tails, sums = 1.0, 0.0, 0.0, [0.0, 0.0, 0.0]
            for px, py, (a, b, c), opacity, color, (x0, y0, x1, y1) in splats:
                if not (x0 <= x // 16 < x1 and y0 <= y // 16 < y1):
                    continue
                dx, dy = px - x, py - y
                power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
                alpha = min(float(torch.tensor(0.99)), opacity * math.exp(power))
                if alpha < STRONG:
                    tails += alpha * transmittance
                    continue
                if transmittance * (1 - alpha) < float(torch.tensor(1e-4)):
                    break
                strong += alpha * transmittance
                sums = [total + channel * alpha * transmittance for total, channel in zip(sums, color)]
                transmittance *= 1 - alpha
            for k in range(3):
                image[k, y, x] = sums[k] / max(strong + tails, 1e-6)
    return image


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-6), (torch.float32, 2e-5)])
def test_equals_the_authors_sums_over_black(function, dtype, tolerance):
    """tolerance: tails below 2^-35 are left out, some of 60, of a sum of 1/2040 or more. float32: its rounding."""
    scene = random_scene("smoe", 60, 37, 29, seed=3, scale=0.08, opacity=(0.01, 0.9), channels=3,
                         bg=torch.zeros(3)).with_settings(faint_below=2.0)
    expected = authors_image(scene.to("cpu"))
    with one_thread():
        rendering = function(settings=scene.to(dtype).settings, **scene.to(dtype).inputs)
    assert_close(rendering.color, expected.to(rendering.color), tolerance, "colour")
    # The tails are felt: without them the image is another one.
    plain = rasterize(settings=without_tails(scene).settings, **scene.inputs).color
    assert (plain.cpu() - expected).abs().max() > 0.1


def line(function, opacities, depths, distance, **fields):
    """One row of 41 pixels: the first Gaussian in the middle, the second `distance` pixels beside it; alpha too."""
    settings = facing_camera("smoe", 41, 1, **fields)
    inputs = on_axis(depths, opacities, [[0.9, 0.5, 0.1], [0.2, 0.7, 0.4]], variance=(16 - 0.3) / (41 / 4) ** 2)
    inputs["means3D"][1, 0] = distance / (41 / 2) * depths[1]
    inputs["opacities"].requires_grad_(True)
    return function(settings=settings, outputs=("alpha",), **inputs), inputs["opacities"], settings


BEHIND, IN_FRONT = (2.0, 2.0 + 1e-9), (2.0, 2.0 - 1e-9)


@pytest.mark.parametrize("depths", [BEHIND, IN_FRONT], ids=["behind", "in front"])
def test_a_tail_by_hand(function, depths):
    """At the centre of a Gaussian of opacity 0.2 another one of 0.05, 16 pixels away, is a tail."""
    o, background = (0.2, 0.05), (0.1, 0.2, 0.3)
    rendering, opacities, _ = line(function, o, depths, 16)
    # A sphere beside the axis is longer on the image, by its slope of 16 / 20.5.
    kernel = math.exp(-0.5 * 16 ** 2 / (15.7 * (1 + (16 / 20.5) ** 2) + 0.3))
    tail = o[1] * kernel * ((1 - o[0]) if depths[1] > depths[0] else 1)
    assert 1e-5 < tail < STRONG
    expected = [(o[0] * c + tail * b) / (o[0] + tail) for c, b in zip((0.9, 0.5, 0.1), background)]
    assert rendering.color[:, 0, 20].tolist() == pytest.approx(expected, rel=1e-6)  # 1e-7 in the clip w
    assert rendering.alpha[0, 0, 20].item() == pytest.approx(o[0] / (o[0] + tail), rel=1e-9)
    # The tail's Gaussian has no gradient there, and the other one only that of its own weight.
    by_opacity, = torch.autograd.grad(rendering.color[0, 0, 20], opacities)
    assert by_opacity[1].item() == 0
    assert by_opacity[0].item() == pytest.approx((0.9 - expected[0]) / (o[0] + tail), rel=1e-6)


def test_tails_count_below_a_gate_sum(function):
    images = [line(function, (0.3, 0.05), BEHIND, 16, faint_below=below)[0].color[:, 0, 20]
              for below in (0.0, 0.29, 0.31, 2.0)]
    assert torch.equal(images[0], images[1]) and torch.equal(images[2], images[3])
    assert (images[1] - images[2]).abs().min() > 1e-5


def test_tails_below_what_8_bits_show_count_only_where_all_pairs_do(function):
    """A tail of alpha 5e-7, between 2^-35 and 1/520200, beside a Gaussian of opacity 0.2."""
    for below, counts in ((1.0, False), (2.0, True)):
        images = [line(function, (0.2, opacity), BEHIND, 26, faint_below=below)[0].color[:, 0, 20]
                  for opacity in (0.002, 0.0)]
        assert bool((images[0] != images[1]).any()) == counts


def near_weight(opacities, distance):
    """The weight behind a Gaussian at the pixel of one `distance` pixels beside the pixel, and its alpha there."""
    kernel = math.exp(-0.5 * distance ** 2 / (15.7 * (1 + (distance / 20.5) ** 2) + 0.3))
    return opacities[1] * kernel * (1 - opacities[0]), opacities[1] * kernel


@pytest.mark.parametrize("opacity, distance, near", [
    (0.9, 15, True),  # alpha 0.0089 is above 1/255, at 3.04 sigma
    (0.3, 15, False),  # alpha 0.0030, at 3.04 sigma
    (0.002, 4, True),  # alpha 0.0012, at 0.98 sigma
    (0.024, 11, True),  # alpha 0.0013, at 2.43 sigma
    (0.012, 11, False),  # alpha 0.00063 is below 1/1020
    (0.02, 13, False),  # alpha 0.00045 is not strong
])
def test_a_faint_pair_counts_where_the_near_ones_do_not_cover(function, opacity, distance, near):
    """Behind a Gaussian of opacity 0.26 only near pairs count; behind one of 0.23 all strong ones."""
    for front in (0.26, 0.23):
        o = (front, opacity)
        rendering, opacities, _ = line(function, o, BEHIND, distance)
        alone, _, _ = line(function, (front, 0.0), BEHIND, distance)
        weight, alpha = near_weight(o, distance)
        by_opacity, = torch.autograd.grad(rendering.color[0, 0, 20], opacities)
        counts = alpha >= STRONG and (near or front < 0.25)
        assert (by_opacity[1].item() != 0) == counts
        if counts:
            expected = (front * 0.9 + weight * 0.2) / (front + weight)
            assert rendering.color[0, 0, 20].item() == pytest.approx(expected, rel=1e-6)  # 1e-7 in the clip w
        elif front > 0.25:  # neither faint pairs nor tails
            assert torch.equal(rendering.color[:, 0, 20], alone.color[:, 0, 20])
            # What is left out is less than what its bound says.
            assert alpha / front < 1 / 255 / 0.25


@pytest.mark.parametrize("mode", ["smoe", "smoe_learned_gate", "smoe_eq7", "eq7_gate"])
@pytest.mark.parametrize("channels", [None, 5])
def test_equals_the_reference_on_both_sides_of_the_threshold(mode, channels):
    """The image, its gradients and what `Splats` says; each of the two rules has its pixels."""
    background = torch.tensor([0.2, 0.5, 0.8, 0.3, 0.6], dtype=torch.float64)[:channels or 3]
    scene = random_scene(mode, 400, 61, 45, seed=6, scale=0.1, opacity=(0.01, 1.0), channels=channels, degree=1,
                         bg=background).with_settings(faint_below=0.9)
    wide = (op_results(scene)[1]["final_transmittance"] < 0).reshape(45, 61)
    everywhere = rasterize(settings=scene.with_settings(faint_below=1.0).settings, **scene.inputs).color
    nowhere = rasterize(settings=without_tails(scene).settings, **scene.inputs).color
    image, actual = gradients(rasterize, scene, ("alpha",))
    assert 0.1 < wide.double().mean() < 0.9
    assert_close(image.color[:, wide], everywhere[:, wide], EXACT, "wide pixels")
    assert_close(image.color[:, ~wide], nowhere[:, ~wide], EXACT, "covered pixels")
    moved = (everywhere - nowhere).abs().amax(0)
    assert (moved[~wide] > 1e-5).double().mean() > 0.5 and moved[wide].max() > 0.005
    with one_thread(), on_the_cpu():
        expected_image, expected = gradients(reference.rasterize, scene.to("cpu"), ("alpha",))
    assert_close(image.color.cpu(), expected_image.color, EXACT, "colour")
    assert_all_close({name: value.cpu() for name, value in actual.items()}, expected, EXACT)
    maps = [random_normal((45, 61), seed, torch.float64).abs() for seed in (1, 2)]
    splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1]
    given = {name: tensor for name, tensor in scene.to("cpu").inputs.items() if name != "means2D"}
    with one_thread(), on_the_cpu():
        settings = scene.to("cpu").settings
        contributions = reference.contributions(settings=settings, pixel_weights=maps[0].cpu(), **given)[2]
        worth = reference.importance(settings=settings, pixel_weights=maps[0].cpu(), share_weights=maps[1].cpu(),
                                     **given)
    assert torch.equal(splats.contributions(maps[0]).pixels.cpu(), contributions.pixels)
    assert_all_close(splats.contributions(maps[0])._asdict(), contributions._asdict(), EXACT)
    # Roundings grow by 1 / (1 - alpha), up to 100, and if a pixel's other owners are faint.
    assert_all_close(splats.importance(*maps)._asdict(), worth._asdict(), 1e-9)


def test_a_pair_outside_the_tiles_of_the_square_is_none(function):
    """The radius is 14: with its centre at 29.5 a Gaussian's tiles begin at pixel 0, at 30.5 they begin at pixel 16."""
    for distance, reaches in ((9.5, True), (10.5, False)):
        rendering, _, _ = line(function, (0.5, 0.004), BEHIND, distance)
        alone, _, _ = line(function, (0.5, 0.0), BEHIND, distance)
        differs = bool((rendering.color[:, 0, 15] != alone.color[:, 0, 15]).any())
        assert differs == reaches, distance


def test_gradients_hold_the_tails_constant():
    """Against autograd through the reference, which detaches B: the tails are felt in the loss, and move nothing."""
    scene = random_scene("smoe", 80, 37, 29, seed=4, scale=0.08, opacity=(0.01, 0.9), degree=1)
    _, actual = gradients(rasterize, scene, ("alpha",))
    with one_thread(), on_the_cpu():
        _, expected = gradients(reference.rasterize, scene.to("cpu"), ("alpha",))
    assert_all_close({name: value.cpu() for name, value in actual.items()}, expected, EXACT)
    _, plain = gradients(rasterize, without_tails(scene), ("alpha",))
    assert (plain["opacities"] - actual["opacities"]).abs().max() > 1e-3


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf"), 1e300, "0.9", [0.9]])
def test_refuses_what_is_no_faint_below(value):
    scene = random_scene("smoe", 3).with_settings(faint_below=value)
    with pytest.raises(ValueError, match=re.escape(f"faint_below is {value!r}; it must be a number, 0 or more")):
        rasterize(settings=scene.settings, **scene.inputs)
