"""`deterministic=True`: the same call gives the same gradients and scores, bit for bit, and those of the usual way."""
from __future__ import annotations

import pytest
import torch
from comparison import assert_all_close, assert_close
from devices import random_normal
from scenes import gradients, op_results, random_scene, with_gate
from test_cuda_graphs import TrainingStep, graph_of, list_size, own_width

from diff_smoe_rasterization import rasterize, rasterize_with_splats
from diff_smoe_rasterization.settings import OUTPUTS

CASES = {
    "harmonics": dict(degree=2),
    "split_harmonics": dict(degree=1, split_dc=True, antialiasing=True),
    "colours_1": dict(channels=1),
    "colours_7": dict(channels=7, covariance="cov3D"),
    "colour_alone": dict(degree=3, split_dc=True),  # what trainers render, by kernels of its own
    "opacities_above_1": dict(degree=1, opacity=(0.5, 5.0)),
}


@with_gate
@pytest.mark.parametrize("dtype, tolerance", [
    (torch.float32, 1e-5), (torch.float64, 1e-12)], ids=["float32", "float64"])  # sums in another order
@pytest.mark.parametrize("case", [pytest.param(name, marks=pytest.mark.sanitize) if name == "split_harmonics" else name
                                  for name in CASES])
def test_ten_runs_give_the_same_bits(mode, case, dtype, tolerance, gpu):
    # Most Gaussians lie in several tiles, some in all: their gradients are sums over tiles.
    scene = random_scene(mode, 4000, 131, 83, scale=0.06, dtype=dtype, **CASES[case]).to(gpu)
    outputs = () if case == "colour_alone" else OUTPUTS
    usual, usual_gradients = gradients(rasterize, scene, outputs)
    assert (usual.radii > 16).sum() > 100
    scene = scene.with_settings(deterministic=True)
    first, first_gradients = gradients(rasterize, scene, outputs)
    names = ("color", "radii", *outputs)
    for _ in range(9):
        rendering, gradient = gradients(rasterize, scene, outputs)
        assert all(torch.equal(getattr(rendering, name), getattr(first, name)) for name in names)
        for name, values in first_gradients.items():
            assert torch.equal(gradient[name], values), name
    assert all(torch.equal(getattr(usual, name), getattr(first, name)) for name in names)
    assert_all_close(first_gradients, usual_gradients, tolerance)


def test_images_are_the_same_bits_without_it(mode, gpu):
    scene = random_scene(mode, 4000, 131, 83, scale=0.06, dtype=torch.float32).to(gpu)
    first = rasterize(settings=scene.settings, outputs=OUTPUTS, **scene.inputs)
    for _ in range(9):
        again = rasterize(settings=scene.settings, outputs=OUTPUTS, **scene.inputs)
        assert all(torch.equal(image, other) for image, other in zip(again, first))


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_images_are_the_same_bits_with_more_long_lists_than_are_shared(mode, gpu):
    """Two warps share a square in 128 tiles with lists above 1,024; which ones is up to the order of atomics."""
    scene = random_scene(mode, 8000, 256, 256, scale=0.6, opacity=(0.01, 0.05), degree=0, dtype=torch.float32).to(gpu)
    outputs, saved = op_results(scene)
    offsets = saved["tile_offsets"][:-2]
    assert (offsets[1:] - offsets[:-1] > 1024).sum() > 128, "too few long lists"
    for _ in range(9):
        assert torch.equal(op_results(scene)[0]["color"], outputs["color"])


def test_nothing_visible(mode, gpu):
    scene = random_scene(mode, 200, 33, 21, dtype=torch.float32, deterministic=True).to(gpu)
    scene = scene.with_inputs(means3D=scene.inputs["means3D"] + 30 * scene.settings.campos)
    rendering, gradient = gradients(rasterize, scene, OUTPUTS)
    assert not rendering.radii.any()
    assert not any(values.any() for name, values in gradient.items() if name != "bg")


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("outputs, degree, width", [(OUTPUTS, 1, 267), ((), 3, 283)],
                         ids=["all_images", "colour_alone"])
def test_a_captured_graph_that_outgrew_its_lists(mode, outputs, degree, width, dtype, gpu):
    """The walk over all Gaussians gives the bits of the lists; at a size of its own, as the tests of graphs have it."""
    width = own_width(mode, width) + 7 * (dtype == torch.float64)
    small = random_scene(mode, 20_000, width, 151, scale=0.004, opacity=(0.02, 0.2), degree=degree, dtype=dtype)
    larger = small.with_inputs(scales=small.inputs["scales"] * 30)
    step = TrainingStep(small.with_settings(deterministic=True), gpu, outputs, dtype)
    graph, results = graph_of(step)
    room = list_size(small, gpu)[0]
    assert list_size(larger, gpu)[1] > room, "nothing is outgrown"
    expected = TrainingStep(larger.with_settings(deterministic=True), gpu, outputs, dtype)()
    step.set_to(larger)
    graph.replay()
    first = {name: values.clone() for name, values in results[2].items()}
    for _ in range(9):
        graph.replay()
        for name, values in first.items():
            assert torch.equal(results[2][name], values), name
    for name, values in expected[2].items():
        assert torch.equal(first[name], values), name
    step.set_to(small)  # with room again
    graph.replay()
    expected = TrainingStep(small.with_settings(deterministic=True), gpu, outputs, dtype)()
    for name, values in expected[2].items():
        assert torch.equal(results[2][name], values), name


@with_gate
def test_scores_are_the_same_bits_each_time_and_near_the_usual_ones(mode, gpu):
    scene = random_scene(mode, 6000, 160, 107, scale=0.1, degree=1, dtype=torch.float32).to(gpu)
    weights = random_normal((107, 160), 3).to(torch.float32).to(gpu)

    def scores(**settings):
        splats = rasterize_with_splats(settings=scene.with_settings(**settings).settings, **scene.inputs)[1]
        return [*splats.contributions(weights), *splats.importance(weights.abs())]

    first = scores(deterministic=True)
    for _ in range(9):
        assert all(map(torch.equal, scores(deterministic=True), first))
    for values, usual in zip(first, scores()):
        # The same terms, added exactly: the usual sums of thousands of terms are rounded by 6e-8 of the largest each.
        assert_close(values.double(), usual.double(), 1e-5, "scores")


def colour_gradients(scene, weights):
    """The gradients by name of sum(weights * color)."""
    scene = scene.requiring_grad(camera=False)
    leaves = scene.leaves()
    color = rasterize(settings=scene.settings, **scene.inputs).color
    values = torch.autograd.grad(color, list(leaves.values()), weights, allow_unused=True)
    return {name: value for name, value in zip(leaves, values) if value is not None}


@with_gate
def test_a_large_gradient_leaves_small_ones_their_digits(mode, gpu):
    """Units are relative to the largest gradient of the image: here that of one pixel, a million times the others."""
    scene = random_scene(mode, 4000, 131, 83, scale=0.02, degree=1, dtype=torch.float32).to(gpu)
    weights = random_normal((3, 83, 131), 1, torch.float32).to(gpu)
    alone = torch.zeros_like(weights)
    alone[:, 40, 60] = 1e6
    beside = weights.clone()
    beside[:, 40, 60] = 1e6
    shares = colour_gradients(scene, alone)["means3D"]
    apart = (shares == 0).all(1)  # Gaussians that the pixel does not see
    assert 1000 < apart.sum() < 4000
    weights[:, 40, 60] = 0
    expected = colour_gradients(scene, weights)
    actual = colour_gradients(scene.with_settings(deterministic=True), beside)
    names = [name for name in expected if expected[name].shape[:1] == (4000,)]
    # As between two orders of the sums.
    assert_all_close({name: actual[name][apart] for name in names}, {name: expected[name][apart] for name in names},
                     1e-5)


@with_gate
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_gradient_that_is_no_number_reaches_the_same_gaussians(mode, bad, gpu):
    scene = random_scene(mode, 4000, 131, 83, scale=0.02, degree=1, dtype=torch.float32).to(gpu)
    weights = random_normal((3, 83, 131), 1, torch.float32).to(gpu)
    weights[1, 40, 60] = bad
    usual = colour_gradients(scene, weights)
    actual = colour_gradients(scene.with_settings(deterministic=True), weights)
    assert 0 < (~torch.isfinite(usual["means3D"])).any(1).sum() < 2000
    for name, values in usual.items():
        assert torch.equal(torch.isfinite(actual[name]), torch.isfinite(values)), name


@pytest.mark.parametrize("dtype, tolerance", [
    (torch.float32, 1e-5), (torch.float64, 1e-12)], ids=["float32", "float64"])
def test_a_background_gate_above_1(dtype, tolerance, gpu):
    scene = random_scene("smoe", 4000, 131, 83, scale=0.06, degree=1, dtype=dtype, background_gate=40.0).to(gpu)
    weights = random_normal((3, 83, 131), 1, dtype).to(gpu)
    assert_all_close(colour_gradients(scene.with_settings(deterministic=True), weights),
                     colour_gradients(scene, weights), tolerance)
