"""The sums over each Gaussian's pixels, on CUDA: against the CPU, in outgrown lists, and without the host."""
from __future__ import annotations

import pytest
import torch
from comparison import assert_close
from devices import random_normal
from scenes import blend_of, gate_of, random_scene, transmittance_of, with_gate, with_gates
from test_cuda_against_cpu import SCENES, selected
from test_cuda_graphs import SLEEP, graph_of, list_size, own_width, result_while_busy, scene_of

from diff_smoe_rasterization import Contributions, rasterize_with_splats


def map_for(settings, seed=2):
    """A map of positive float32 numbers, so that no sum cancels."""
    shape = (settings.image_height, settings.image_width)
    return random_normal(shape, seed).abs().float() + 0.1


def scores(scene, device, dtype, pixel_weights, **settings):
    """Returns radii, centres, depths and Contributions."""
    scene = scene.to(dtype).to(device).with_settings(**settings)
    rendering, splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)
    return rendering.radii, splats.centers, splats.depths, splats.contributions(pixel_weights.to(device, dtype))


@with_gate
@pytest.mark.parametrize("name", selected(SCENES))
def test_float64_equals_the_cpu(mode, name, gpu):
    scene = SCENES[name](mode)
    pixel_weights = map_for(scene.settings)
    expected = scores(scene, "cpu", torch.float64, pixel_weights)
    actual = scores(scene, gpu, torch.float64, pixel_weights)
    assert torch.equal(actual[0].cpu(), expected[0])
    # Roundings of 1e-16 in positions of some hundred pixels and sums of thousands of positive terms.
    assert_close(actual[1], expected[1], 1e-12, "centers")
    assert_close(actual[2], expected[2], 1e-12, "depths")
    assert torch.equal(actual[3].pixels.cpu(), expected[3].pixels)
    for name in ("pixel_weights", "blend_weights", "distances"):
        assert_close(getattr(actual[3], name), getattr(expected[3], name), 1e-11, name)
    assert (expected[3].pixels > 0).sum() > 5


@with_gate
@pytest.mark.parametrize("name", selected(SCENES))
def test_float32_is_near_the_cpu(mode, name, gpu):
    scene = SCENES[name](mode)
    pixel_weights = map_for(scene.settings)
    expected = scores(scene, "cpu", torch.float64, pixel_weights)[3]
    actual = scores(scene, gpu, torch.float32, pixel_weights)[3]
    different = (actual.pixels.cpu() - expected.pixels).abs()
    # A pair within rounding of a threshold may count on only one side: 1e-5 of what pairs there are, as of pixels in
    # test_cuda_against_cpu. In small scenes that is less than one.
    assert different.sum() <= max(3, 2e-5 * expected.pixels.sum())
    same = different == 0
    for name in ("pixel_weights", "blend_weights", "distances"):
        # FLOAT32 there: positions rounded by 3e-5 px change the alpha of the smallest splats by 2e-4 of itself.
        assert_close(getattr(actual, name).cpu()[same], getattr(expected, name)[same], 1e-4, name)


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_sums_account_for_every_pair_of_the_image(mode, dtype, gpu):
    """All blend weights together are the image of their sums; in `smoe_tn` the numerator of a constant colour is."""
    scene = random_scene(mode, 3000, 160, 107, scale=0.03, channels=1, bg=torch.zeros(1)).with_inputs(
        colors_precomp=torch.ones(3000, 1, dtype=torch.float64)).to(dtype).to(gpu)
    rendering, splats = rasterize_with_splats(settings=scene.settings, outputs=("alpha",), **scene.inputs)
    denominator = rendering.alpha[0] + gate_of(mode) * (1 - rendering.alpha[0])
    if blend_of(mode) == "smoe":  # whose alpha is W / D, with W = 1 - T
        denominator = (1 - transmittance_of(scene)) / rendering.alpha[0].clamp(min=1e-30)
    weights = rendering.color[0] * denominator
    pixel_weights = map_for(scene.settings).to(gpu, dtype)
    sums = splats.contributions(pixel_weights)
    # Sums of some hundred thousand positive numbers.
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    assert_close(sums.blend_weights.double().sum(), weights.double().sum(), tolerance, "blend weights")


@with_gates
@pytest.mark.sanitize
def test_lists_that_are_outgrown(mode, gpu):
    """A graph whose contents outgrow the lists it was captured with: the walk goes over the depth order then."""
    small = scene_of(mode, num_gaussians=20_000, width=own_width(mode, 227), height=151, scale=0.004,
                     opacity=(0.02, 0.2))
    larger = small.with_inputs(scales=small.inputs["scales"] * 30)
    pixel_weights = map_for(small.settings).to(gpu)
    held = small.to(torch.float32).to(gpu)

    def step():
        rendering, splats = rasterize_with_splats(settings=held.settings, **held.inputs)
        return rendering.radii, splats.centers, splats.depths, splats.contributions(pixel_weights)

    graph, results = graph_of(step)
    room = list_size(small, gpu)[0]
    assert list_size(larger, gpu)[1] > room, "nothing is outgrown"
    for scene in (small, larger, small):
        expected = scores(scene, gpu, torch.float32, pixel_weights)
        held.inputs["scales"].copy_(scene.inputs["scales"])
        graph.replay()
        assert torch.equal(results[0], expected[0]) and torch.equal(results[3].pixels, expected[3].pixels)
        assert expected[3].pixels.sum() > 50_000
        for name, actual, other in zip(("centers", "depths") + Contributions._fields,
                                       (*results[1:3], *results[3]), (*expected[1:3], *expected[3])):
            # The same pairs with the same numbers, added in another order: 6e-8 each.
            torch.testing.assert_close(actual, other, rtol=1e-4, atol=1e-5, msg=name)


@with_gate
def test_the_host_waits_for_nothing(mode, gpu):
    """The GPU is still busy with earlier work when the sums return."""
    scene = scene_of(mode).to(torch.float32).to(gpu)
    pixel_weights = map_for(scene.settings).to(gpu)

    def step():
        rendering, splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)
        return splats.centers, splats.depths, splats.contributions(pixel_weights)

    assert torch.equal(result_while_busy(step)[2].pixels, step()[2].pixels)


def test_another_stream_and_no_gaussians(mode, gpu):
    scene = random_scene(mode, 3000, 160, 107, scale=0.03)
    pixel_weights = map_for(scene.settings)
    expected = scores(scene, gpu, torch.float64, pixel_weights)[3]
    torch.cuda.synchronize()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda._sleep(SLEEP // 20)
        actual = scores(scene, gpu, torch.float64, pixel_weights)[3]
    stream.synchronize()
    assert torch.equal(actual.pixels, expected.pixels)
    none = scores(scene.rows(slice(0)), gpu, torch.float64, pixel_weights)[3]
    assert all(values.shape == (0,) for values in none)
