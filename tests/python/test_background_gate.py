"""The background as an expert: what only `background_gate` does, its ends, its cut, its gradient, its errors.

What holds in every mode is tested with a gate where it is tested with the modes (`with_gate` in scenes.py). A test that
takes `function` is asked of the reference too, for which it is by hand.
"""
from __future__ import annotations

import math

import numpy
import pytest
import torch
from by_hand import facing_camera, middle, on_axis
from comparison import assert_all_close, assert_close, assert_same_gradients, threshold_margin
from devices import random_normal
from scenes import Scene, gradients, random_scene

from diff_smoe_rasterization import rasterize, rasterize_with_splats, reference
from diff_smoe_rasterization import settings as settings_module
from diff_smoe_rasterization.settings import BLEND_MODES, GATED_MODES, OUTPUTS

pytestmark = pytest.mark.usefixtures("device")

EXACT = 1e-12  # float64: the same few operations, written in another order
RED, WHITE = (0.9, 0.5, 0.1), (1.0, 1.0, 1.0)
SIGMA = 6.1  # px, of the Gaussian of `row`


@pytest.fixture(params=[rasterize, reference.rasterize], ids=["package", "reference"])
def function(request):
    return request.param


def learned(value, dtype=torch.float64):
    return torch.tensor(value, dtype=dtype, requires_grad=True)


def assert_same_bits(scene, other):
    """Asserts that two scenes have the same images, radii and gradients."""
    (actual, actual_gradients), (expected, expected_gradients) = (
        gradients(rasterize, each, OUTPUTS) for each in (scene, other))
    assert all(torch.equal(first, second) for first, second in zip(actual, expected))
    assert_same_gradients(actual_gradients, expected_gradients)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("options", [dict(degree=2), dict(channels=5, covariance="cov3D", antialiasing=True)],
                         ids=["shs", "channels"])
def test_the_ends_of_the_family(options, dtype):
    """0 is Eq. 7 and 1 is alpha blending, bit for bit."""
    smoe, alpha = (random_scene(mode, opacity=(1e-3, 1.2), dtype=dtype, **options) for mode in ("smoe_eq7", "alpha"))
    for nothing in (0, 0.0):
        assert_same_bits(smoe.with_settings(background_gate=nothing), smoe)
    for one in (1, 1.0):
        assert_same_bits(smoe.with_settings(background_gate=one), alpha)
        assert_same_bits(alpha.with_settings(background_gate=one), alpha)


def test_a_tensor_of_value_0_is_eq_7_and_has_a_gradient():
    smoe = random_scene("smoe_eq7", opacity=(0.02, 0.9))
    expected, expected_gradients = gradients(rasterize, smoe)
    actual, actual_gradients = gradients(rasterize, smoe.with_settings(background_gate=torch.zeros(()).double()))
    assert torch.equal(actual.radii, expected.radii)
    assert_close(actual.color, expected.color, EXACT, "color")
    assert actual_gradients.pop("background_gate") != 0
    assert_all_close(actual_gradients, expected_gradients, EXACT)


def test_a_tensor_of_value_1_is_alpha_where_no_tile_ends(function):
    """One tile; opacities above exp(4.5) / 255 = 0.353, so that both cut at 1/255; no splat beyond the tile's edge."""
    alpha = random_scene("alpha", 80, 16, 16, opacity=(0.36, 0.98), degree=1, seed=5)
    inside = ((alpha.inputs["means3D"] @ alpha.settings.viewmatrix[:3, :2]).abs() < 1.5).all(1)
    alpha = alpha.rows(inside)
    smoe = alpha.with_settings(blend_mode="smoe_eq7", background_gate=torch.ones(()).double())
    expected, expected_gradients = gradients(function, alpha, OUTPUTS)
    actual, actual_gradients = gradients(function, smoe, OUTPUTS)
    assert (expected.radii > 0).sum() > 20 and torch.equal(actual.radii, expected.radii)
    for name in ("color", *OUTPUTS):
        assert_close(getattr(actual, name), getattr(expected, name), EXACT, name)
    assert actual_gradients.pop("background_gate") != 0
    # dL/dalpha is a difference of colours in the one and of that with the pixel's colour, which cancels, in the other.
    assert_all_close(actual_gradients, expected_gradients, 1e-11)


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
def test_a_pixel_and_its_gradients_by_hand(function, shape):
    a, c, b, value, depth = 0.6, RED, (0.1, 0.2, 0.3), 0.3, 2.0
    gate = torch.full(shape, value, dtype=torch.float64, requires_grad=True)
    inputs = {name: tensor.requires_grad_(True) for name, tensor in on_axis([depth], [a], [c]).items()}
    settings = facing_camera("smoe_eq7", bg=b, background_gate=gate)
    settings.bg.requires_grad_(True)
    rendering = function(settings=settings, outputs=OUTPUTS, **inputs)
    d = a + value * (1 - a)
    color = [(a * ci + value * (1 - a) * bi) / d for ci, bi in zip(c, b)]
    assert middle(rendering.color) == pytest.approx(color, rel=EXACT)
    assert middle(rendering.alpha) == pytest.approx([a], rel=EXACT)
    assert middle(rendering.depth) == pytest.approx([depth], rel=EXACT)
    assert middle(rendering.inverse_depth) == pytest.approx([a / depth / d], rel=EXACT)

    leaves = [gate, settings.bg, inputs["opacities"], inputs["colors_precomp"]]
    for channel in range(3):
        by_gate, by_background, by_opacity, by_color = torch.autograd.grad(
            rendering.color[channel, 3, 5], leaves, retain_graph=True)
        assert by_gate.shape == shape
        assert by_gate.item() == pytest.approx((1 - a) * (b[channel] - color[channel]) / d, rel=EXACT)
        assert by_background.tolist() == pytest.approx(
            [value * (1 - a) / d * (i == channel) for i in range(3)], rel=EXACT)
        assert by_color[0].tolist() == pytest.approx([a / d * (i == channel) for i in range(3)], rel=EXACT)
        # The quotient rule: the numerator grows by c - lambda b, the denominator by 1 - lambda. G is 1.
        assert by_opacity.item() == pytest.approx(
            (c[channel] - value * b[channel] - color[channel] * (1 - value)) / d, rel=EXACT)
    by_gate, = torch.autograd.grad(rendering.inverse_depth[0, 3, 5], gate, retain_graph=True)
    assert by_gate.item() == pytest.approx(-a / depth * (1 - a) / d ** 2, rel=EXACT)
    for name in ("alpha", "depth"):
        by_gate, = torch.autograd.grad(getattr(rendering, name)[0, 3, 5], gate, retain_graph=True, allow_unused=True)
        assert by_gate is None or by_gate.item() == 0


def test_the_background_is_behind_the_last_pair_that_was_blended(function):
    """The third would leave T = 1e-5 and is left out, so that T is 0.001 for the background and 0 for the last."""
    gate, opacities, colors = learned(2.0), (0.9, 0.99, 0.99, 0.5), [[0.8], [0.4], [0.2], [0.6]]
    settings = facing_camera("smoe_eq7", 1, 1, bg=(0.1,), background_gate=gate)
    rendering = function(settings=settings, outputs=("alpha",), **on_axis((1, 2, 3, 4), opacities, colors))
    first, second, behind = 0.9, 0.1 * 0.99, 0.1 * 0.01
    total = first + second + 2 * behind
    color = (first * 0.8 + second * 0.4 + 2 * behind * 0.1) / total
    # 0.99 is cut to a float32 number, which changes T by 1e-6 of itself.
    assert middle(rendering.color) == pytest.approx([color], rel=1e-8)
    assert middle(rendering.alpha) == pytest.approx([first + second], rel=1e-8)
    by_gate, = torch.autograd.grad(rendering.color.sum(), gate)
    assert by_gate.item() == pytest.approx(behind * (0.1 - color) / total, rel=2e-6)


def test_the_larger_the_gate_the_nearer_is_the_background(function):
    inputs, distance = on_axis([2.0], [0.8], [RED], variance=0.2), None
    for value in (0.0, 1e-6, 1e-3, 0.1, 1.0, 10.0, 1e4, 1e8):
        settings = facing_camera("smoe_eq7", 21, 21, bg=WHITE, background_gate=learned(value))
        nearer = (function(settings=settings, **inputs).color - 1).abs()
        assert torch.isfinite(nearer).all()
        assert distance is None or (nearer <= distance).all() and nearer[:, 10, 10].sum() < distance[:, 10, 10].sum()
        distance = nearer
    assert 0 < distance.max() < 1e-6


def row(function, opacity, gate, sigma=SIGMA, **fields):
    """Returns a rendering of one Gaussian in the middle of a row of 81 pixels, and its opacity."""
    settings = facing_camera("smoe_eq7", 81, 1, bg=WHITE, background_gate=gate, **fields)
    inputs = on_axis([2.0], [opacity], [RED], (sigma ** 2 - 0.3) / (81 / 4) ** 2)
    inputs["opacities"].requires_grad_(True)
    return function(settings=settings, outputs=("alpha",), **inputs), inputs["opacities"]


@pytest.mark.parametrize("opacity, gate, cut", [
    (1.0, 0.05, 0.05 / 255),  # by opacity, as alpha blending does
    (0.5, 0.3, 0.3 / 255 / 0.5), (0.5, 1e-4, 1e-5), (0.5, 0.0, 1e-5),
    (1e-6, 0.05, math.exp(-4.5)), (0.5, 100.0, math.exp(-4.5)),  # all within 3 sigma count
    (1.0, 1.0, 1 / 255),
])
@pytest.mark.parametrize("kind", [float, learned])
def test_which_pairs_count(function, opacity, gate, cut, kind):
    rendering, opacities = row(function, opacity, kind(gate))
    reach = SIGMA * math.sqrt(-2 * math.log(cut))
    counts = rendering.alpha[0, 0, 40:] > 0
    assert counts.tolist() == [distance <= reach for distance in range(41)] and not counts.all()
    # The colour of the last pixel that counts depends on the opacity; under Eq. 7 a lone Gaussian's does not.
    last = 40 + int(reach)
    gradient, = torch.autograd.grad(rendering.color[0, 0, last], opacities, retain_graph=True)
    assert (gradient.abs().item() > 1e-12) == (gate > 0)
    assert (rendering.color[:, 0, last + 1:] == 1).all()
    beyond, = torch.autograd.grad(rendering.color[0, 0, last + 1], opacities, allow_unused=True)
    assert beyond is None or not beyond.any()


@pytest.mark.parametrize("kind", [float, learned])
def test_the_cut_is_a_float32_number(function, kind):
    """In float64 too: otherwise the two types would cut different pairs."""
    cut, kept = float(numpy.float32(0.05) * numpy.float32(1 / 255)), float(numpy.float32(math.exp(-4.5)))
    assert abs(cut / (0.05 / 255) - 1) > 1e-9 and abs(kept / math.exp(-4.5) - 1) > 1e-9
    kernel, distance = math.exp(-0.5 * (21 / SIGMA) ** 2), 21
    assert 1e-5 < kernel < kept
    for excess, counts in ((1e-11, True), (-1e-11, False)):  # a sum of a few numbers near 10 is known to 1e-14
        assert (row(function, cut / kernel * (1 + excess), kind(0.05))[0].alpha[0, 0, 40 + distance] > 0) == counts
        sigma = distance / math.sqrt(-2 * math.log(kept * (1 + excess)))
        assert (row(function, 1e-6, kind(0.05), sigma)[0].alpha[0, 0, 40 + distance] > 0) == counts


def test_alpha_min_cuts_beside_it(function):
    for alpha_min, cut in ((0.02, 0.02), (1e-5, 0.05 / 255)):
        rendering, _ = row(function, 0.5, 0.05, alpha_min=alpha_min)
        assert (rendering.alpha > 0).sum() == 1 + 2 * int(SIGMA * math.sqrt(2 * math.log(0.5 / cut)))


@pytest.mark.parametrize("opacity, gate", [(0.0, 1e-31), (1e-32, 1e-31), (1e-31, 0.0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_where_all_gates_are_closed_the_background_takes_pixel_and_gradient(function, opacity, gate, dtype):
    settings = facing_camera("smoe_eq7", 9, 7, background_gate=torch.tensor(gate))
    scene = Scene(on_axis([2.0], [opacity], [RED]), settings).to(dtype)
    rendering, gradient = gradients(function, scene, ("depth", "inverse_depth"))
    assert torch.equal(rendering.color, scene.settings.bg[:, None, None].expand_as(rendering.color))
    assert_close(gradient.pop("bg"), random_normal((3, 7, 9), 1).sum((1, 2)), 1e-5, "bg")  # a sum of 63 numbers
    assert not any(values.any() for values in gradient.values())
    assert not rendering.depth.any() and not rendering.inverse_depth.any()


@pytest.mark.parametrize("mode", ["smoe_eq7", "smoe_tn", "smoe_std"])
@pytest.mark.parametrize("background", [math.nan, math.inf])
def test_without_a_gate_a_background_that_is_no_number_shows_in_empty_pixels_alone(function, mode, background, device):
    scene = random_scene(mode, 20, 24, 20, scale=0.05, degree=1,
                         bg=torch.full((3,), background, dtype=torch.float64))
    scene = scene.requiring_grad()
    if function is rasterize and device.type == "cpu":
        with pytest.raises(ValueError, match=rf"background \(bg\)\[0\] is {background}; it must be finite"):
            rasterize(settings=scene.settings, **scene.inputs)
        return
    rendering = function(settings=scene.settings, outputs=("alpha",), **scene.inputs)
    empty = rendering.alpha[0] == 0
    assert torch.equal(torch.isfinite(rendering.color).all(0), ~empty) and empty.any() and not empty.all()
    leaves = {name: leaf for name, leaf in scene.leaves().items() if name != "bg"}
    for values in torch.autograd.grad(rendering.color[:, ~empty].sum(), list(leaves.values()), allow_unused=True):
        assert values is None or torch.isfinite(values).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_empty_pixel_is_the_background_itself(dtype):
    """Not lambda b / lambda, which is another number after rounding."""
    for value in (0.05, 0.3, 0.7, 1e-3, 30.0):
        for gate in (value, torch.tensor(value, dtype=dtype)):
            scene = random_scene("smoe_eq7", 60, scale=0.05, dtype=dtype, background_gate=gate)
            rendering = rasterize(settings=scene.settings, outputs=("alpha",), **scene.inputs)
            empty = rendering.alpha[0] == 0
            assert empty.any() and not empty.all()
            assert (rendering.color[:, empty] == scene.settings.bg[:, None]).all()


@pytest.mark.parametrize("gate", [1e-3, 0.05, 1.0, 20.0])
def test_dL_dlambda_equals_a_finite_difference(function, gate):
    """The gradient of a whole image. Pairs enter and leave at no lambda within the finite-difference step."""
    scene = random_scene("smoe_eq7", 30, 24, 18, seed=3, scale=0.3, opacity=(0.05, 0.9), degree=1)
    weights, step = random_normal((6, 18, 24), 4), 1e-5

    def loss(value):
        rendering = function(settings=scene.settings._replace(background_gate=value), outputs=OUTPUTS, **scene.inputs)
        return (torch.cat([rendering.color, *rendering[2:]]) * weights).sum()

    value = learned(gate)
    assert threshold_margin(scene.with_settings(background_gate=value)).min() > 2 * step
    analytic, = torch.autograd.grad(loss(value), value)
    numeric = (loss(learned(gate * (1 + step))) - loss(learned(gate * (1 - step)))).item() / (2 * gate * step)
    # The step squared, and 1e-16 of the loss over the step.
    assert analytic.item() == pytest.approx(numeric, rel=1e-7, abs=1e-7)


def test_the_common_factor_of_all_opacities_has_a_gradient():
    """Eq. 7 does not see it if opacities are small, which is why its Gaussians could not fade."""
    slopes = {}
    for gate in (0.0, 0.05):
        scene = random_scene("smoe_eq7", opacity=(1e-7, 2e-7), scale=0.3, background_gate=gate).requiring_grad()
        color = rasterize(settings=scene.settings, **scene.inputs).color
        slope, = torch.autograd.grad((color - scene.settings.bg.detach()[:, None, None]).square().sum(),
                                     scene.inputs["opacities"])
        slopes[gate] = (slope * scene.inputs["opacities"]).sum().item()
    assert abs(slopes[0.0]) < 1e-3 and slopes[0.05] > 0


def test_the_environment_is_for_gated_modes(function, monkeypatch):
    scene = random_scene("smoe_eq7", 30, 24, 20, degree=1)

    def color(mode, **fields):
        return function(settings=scene.settings._replace(blend_mode=mode, **fields), **scene.inputs).color

    without = {mode: color(mode) for mode in BLEND_MODES}
    gated = {mode: color(mode, background_gate=0.2) for mode in GATED_MODES}
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.2")
    for mode in BLEND_MODES:
        assert torch.equal(color(mode), gated.get(mode, without[mode]))
    assert torch.equal(color("smoe_eq7", background_gate=0.0), without["smoe_eq7"]), "what is given wins"
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "1")
    assert torch.equal(color("smoe_eq7"), without["alpha"])
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "")
    assert torch.equal(color("smoe_eq7"), without["smoe_eq7"])


def test_splats_keep_the_gate_of_their_rendering(monkeypatch):
    """And sum over its pairs, though the environment has changed since."""
    scene, ones = random_scene("smoe_eq7", 60, degree=1), torch.ones(37, 50, dtype=torch.float64)
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.5")
    splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1]
    monkeypatch.delenv("DSMOE_BACKGROUND_GATE")
    pixels = [splats.contributions(ones).pixels]
    pixels += [rasterize_with_splats(settings=scene.settings._replace(background_gate=gate), **scene.inputs)[1]
               .contributions(ones).pixels for gate in (0.5, 0.0)]
    assert torch.equal(pixels[0], pixels[1]) and (pixels[0] < pixels[2]).any()


@pytest.mark.parametrize("mode, gate", [
    ("smoe", -0.1), ("smoe", math.nan), ("smoe_eq7", math.inf), ("smoe", 1e39), ("smoe", "much"), ("smoe", (0.1, 0.2)),
    ("smoe_eq7", torch.ones(2, device="cpu")), ("smoe_eq7", torch.ones(0, device="cpu")), ("alpha", 0.5), ("alpha", 0),
    ("alpha", torch.tensor(1.0, device="cpu")), ("smoe_tn", 0.0), ("smoe_tn", 0.05),
    ("smoe_std", 1.0)], ids=lambda value: str(value).replace(" ", ""))
def test_a_gate_that_cannot_be_is_named(function, mode, gate):
    scene = random_scene(mode, 5, 20, 18, background_gate=gate)
    with pytest.raises(ValueError, match=r"background_gate .*(must|only 'smoe')"):
        function(settings=scene.settings, **scene.inputs)


def test_a_mode_with_a_gate_of_one_is_no_alpha(monkeypatch):
    """Only `smoe_eq7` becomes `alpha` at gate 1; another mode keeps its name."""
    monkeypatch.setattr(settings_module, "BLEND_MODES", BLEND_MODES + ("own",))
    monkeypatch.setitem(settings_module._FIXED_GATES, "own", 1.0)
    settings = random_scene("smoe_eq7", 1, 2, 2).settings._replace(blend_mode="own", background_gate=None)
    assert settings_module.resolve_blend(settings) == ("own", 1.0)


@pytest.mark.parametrize("value", ["-1", "nan", "inf", "much", "0,05"])
def test_a_gate_in_the_environment_that_cannot_be_is_named(function, value, monkeypatch):
    scene = random_scene("smoe_eq7", 5, 20, 18)
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", value)
    with pytest.raises(ValueError, match=f"DSMOE_BACKGROUND_GATE is '{value}'; it must be a number"):
        function(settings=scene.settings, **scene.inputs)
    function(settings=scene.settings._replace(blend_mode="smoe_tn"), **scene.inputs)
    function(settings=scene.settings._replace(background_gate=0.1), **scene.inputs)


@pytest.mark.parametrize("gate, words", [
    (lambda: torch.tensor(0.1, dtype=torch.float64), "float32"), (lambda: torch.tensor(1), "float32"),
    (lambda: torch.tensor(0.1, device="meta"), "on meta"), (lambda: [0.1], None)],
    ids=["float64", "int64", "device", "list"])
def test_a_tensor_that_does_not_fit_is_named(gate, words):
    scene = random_scene("smoe_eq7", 5, 20, 18, dtype=torch.float32)
    with pytest.raises(TypeError if words else ValueError, match=f"background_gate .*{words or 'must be'}"):
        rasterize(settings=scene.settings._replace(background_gate=gate()), **scene.inputs)


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_the_value_of_a_tensor_is_checked_where_nobody_waits_for_it(value, device):
    if device.type != "cpu":
        pytest.skip("the host would wait for the GPU")
    scene = random_scene("smoe_eq7", 5, 20, 18, background_gate=torch.tensor(value).double())
    with pytest.raises(ValueError, match=f"background_gate is {value}; it must be 0 to 1e\\+30"):
        rasterize(settings=scene.settings, **scene.inputs)
