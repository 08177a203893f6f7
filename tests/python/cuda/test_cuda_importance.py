"""What each Gaussian is worth to an image, on CUDA: against the CPU, in outgrown lists, and without the host."""
from __future__ import annotations

import pytest
import torch
from comparison import assert_close
from devices import random_normal
from scenes import random_scene, with_gate, with_gates
from test_cuda_against_cpu import LONG_LISTS, SCENES, selected
from test_cuda_graphs import SLEEP, graph_of, list_size, own_width, result_while_busy, scene_of

from diff_smoe_rasterization import Importance, rasterize_with_splats


def maps_for(settings):
    """Maps of positive float32 numbers, so that no sum cancels."""
    shape = (settings.image_height, settings.image_width)
    return [random_normal(shape, seed).abs().float() + 0.1 for seed in (2, 3)]


def importance_of(scene, device, dtype, maps, **settings):
    scene = scene.to(dtype).to(device).with_settings(**settings)
    splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1]
    return splats.importance(*(values.to(device, dtype) for values in maps))


@with_gate
@pytest.mark.parametrize("name", selected(SCENES))
def test_float64_equals_the_cpu(mode, name, gpu):
    scene = SCENES[name](mode)
    maps = maps_for(scene.settings)
    expected = importance_of(scene, "cpu", torch.float64, maps)
    actual = importance_of(scene, gpu, torch.float64, maps)
    for field, values, other in zip(Importance._fields, actual, expected):
        # Roundings of 1e-16 in sums of thousands of positive terms, which grow by 1 / (1 - alpha) <= 100 and, if
        # a pixel's other owners are faint, by their share of it.
        assert_close(values, other, 1e-9, field)
    assert (expected.removal_costs > 0).sum() > 5


@with_gate
@pytest.mark.parametrize("name", selected(SCENES))
def test_float32_is_near_the_cpu(mode, name, gpu):
    scene = SCENES[name](mode)
    maps = maps_for(scene.settings)
    expected = importance_of(scene, "cpu", torch.float64, maps)
    actual = importance_of(scene, gpu, torch.float32, maps)
    for field, values, other in zip(Importance._fields, actual, expected):
        # Positions rounded by 3e-5 px change the alpha of the smallest splats by 2e-4 of itself, and a cost goes with
        # its square; a pair within rounding of a threshold may count on one side only. A lens with angles rounds more:
        # CUDA's atan2f errs by up to 3 units in the last place, a division by half of one.
        assert_close(values, other, 6e-3 if name == "lens_equirectangular" else 2e-3, field)


@with_gate
@pytest.mark.sanitize
@pytest.mark.parametrize("name", ["faint", "filling"])
def test_lists_of_several_segments(mode, name, gpu):
    """With what is kept for a backward pass each warp has a part of a list; without it, a whole one."""
    scene = LONG_LISTS[name](mode).to(torch.float32).to(gpu)
    maps = [values.to(gpu) for values in maps_for(scene.settings)]
    opacities = scene.inputs["opacities"].requires_grad_()
    parts = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1].importance(*maps)
    opacities.requires_grad_(False)
    whole = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1].importance(*maps)
    assert (whole.removal_costs > 0).sum() > 2000
    for field, values, other in zip(Importance._fields, parts, whole):
        # Sums of 500 weights in front of a segment are rounded otherwise, by some 1e-7 of W, and a cost, which goes
        # with the square of a difference of such sums, by more of itself.
        assert_close(values, other, 1e-3, field)


@with_gate
@pytest.mark.parametrize("outputs", [(), ("depth",), ("alpha", "depth", "inverse_depth")])
def test_other_outputs_change_nothing(mode, outputs, gpu):
    """Rows of features are longer with them."""
    scene = random_scene(mode, 2000, 160, 107, scale=0.03).to(torch.float32).to(gpu)
    expected = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1].importance()
    actual = rasterize_with_splats(settings=scene.settings, outputs=outputs, **scene.inputs)[1].importance()
    for field, values, other in zip(Importance._fields, actual, expected):
        # The same terms in another order, each rounded by 6e-8.
        assert_close(values, other, 1e-5, field)


@with_gates
@pytest.mark.sanitize
def test_lists_that_are_outgrown(mode, gpu):
    """A graph whose contents outgrow the lists it was captured with: the walk goes over the depth order then."""
    small = scene_of(mode, num_gaussians=20_000, width=own_width(mode, 331), height=151, scale=0.004,
                     opacity=(0.02, 0.2))
    larger = small.with_inputs(scales=small.inputs["scales"] * 30)
    maps = [values.to(gpu) for values in maps_for(small.settings)]
    held = small.to(torch.float32).to(gpu)

    def step():
        return rasterize_with_splats(settings=held.settings, **held.inputs)[1].importance(*maps)

    graph, results = graph_of(step)
    room = list_size(small, gpu)[0]
    assert list_size(larger, gpu)[1] > room, "nothing is outgrown"
    for scene in (small, larger, small):
        expected = importance_of(scene, gpu, torch.float32, maps)
        held.inputs["scales"].copy_(scene.inputs["scales"])
        graph.replay()
        for field, values, other in zip(Importance._fields, results, expected):
            # The same pairs with the same numbers, added in another order: 6e-8 each.
            assert_close(values, other, 1e-4, field)


@with_gate
def test_the_host_waits_for_nothing(mode, gpu):
    """The GPU is still busy with earlier work when the sums return."""
    scene = scene_of(mode).to(torch.float32).to(gpu)
    maps = [values.to(gpu) for values in maps_for(scene.settings)]

    def step():
        return rasterize_with_splats(settings=scene.settings, **scene.inputs)[1].importance(*maps)

    result_while_busy(step)


def test_another_stream_and_no_gaussians(mode, gpu):
    scene = random_scene(mode, 3000, 160, 107, scale=0.03)
    maps = maps_for(scene.settings)
    expected = importance_of(scene, gpu, torch.float64, maps)
    torch.cuda.synchronize()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda._sleep(SLEEP // 20)
        actual = importance_of(scene, gpu, torch.float64, maps)
    stream.synchronize()
    assert_close(actual.removal_costs, expected.removal_costs, 1e-9, "costs")
    none = importance_of(scene.rows(slice(0)), gpu, torch.float64, maps)
    assert all(values.shape == (0,) for values in none)
