"""Without the host: no synchronisation once memory is there, and a CUDA graph of forward and backward that is replayed.

In a replay no memory can be made, so what does not fit the lists that were captured must come out right without them.
"""
from __future__ import annotations

import pytest
import torch
from comparison import assert_same_gradients
from devices import random_normal
from scenes import BACKGROUND_GATES, Scene, op_results, random_scene, with_gate, with_gates

from diff_smoe_rasterization import rasterize
from diff_smoe_rasterization.settings import OUTPUTS

WARM_UP = 3  # calls; torch's own advice before a capture
SLEEP = 2_000_000_000  # GPU cycles, about a second: far longer than the host needs to start one pass


def warm_up(step):
    for _ in range(WARM_UP):
        step()
        torch.cuda.synchronize()


def graph_of(step):
    """Returns a graph of one call and the tensors that its replay fills."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        warm_up(step)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        results = step()
    return graph, results


def result_while_busy(step):
    """Returns the result of a call that returns while the GPU is still busy with earlier work."""
    warm_up(step)
    kept = [step() for _ in range(2)]  # so that no memory has to be made below
    del kept
    torch.cuda.synchronize()
    awake = torch.cuda.Event()
    torch.cuda._sleep(SLEEP)
    awake.record()
    result = step()
    assert not awake.query(), "the host waited for the GPU"
    torch.cuda.synchronize()
    return result


class TrainingStep:
    """Forward and backward of a scene whose tensors stay where they are."""

    def __init__(self, scene, gpu, outputs=OUTPUTS, dtype=torch.float32):
        self.scene = scene.to(dtype).to(gpu).requiring_grad()
        self.outputs = outputs
        settings = self.scene.settings
        shape = (len(settings.bg) + len(outputs), settings.image_height, settings.image_width)
        self.weights = random_normal(shape, 1, dtype).to(gpu)

    def __call__(self):
        """Returns (images, radii, gradients by name)."""
        leaves = self.scene.leaves()
        rendering = rasterize(settings=self.scene.settings, outputs=self.outputs, **self.scene.inputs)
        images = torch.cat([rendering.color] + [getattr(rendering, name) for name in self.outputs])
        gradients = torch.autograd.grad(images, list(leaves.values()), self.weights)
        return images.detach(), rendering.radii, dict(zip(leaves, gradients))

    @torch.no_grad()
    def set_to(self, scene: Scene):
        """Copies another scene of the same shapes over this one."""
        values = {**scene.inputs, **scene.settings._asdict()}
        for name, leaf in self.scene.leaves().items():
            leaf.copy_(values[name])


def assert_same(actual, expected):
    torch.testing.assert_close(actual[0], expected[0], rtol=1e-5, atol=1e-5)  # another kernel may sum in another order
    assert torch.equal(actual[1], expected[1])
    # Long lists are walked in segments, and whole if they are outgrown: T is rounded in other places, thousands of
    # times, before terms that cancel in part are summed.
    assert_same_gradients(actual[2], expected[2], 1e-4)


def scene_of(mode, seed=0, **options):
    options = {"num_gaussians": 2000, "width": 131, "height": 83, "scale": 0.04, "degree": 1, **options}
    return random_scene(mode, seed=seed, **options)


def with_other_gate(scene, value):
    """Returns the scene with a background gate of that value, if it has one that is a tensor."""
    gate = scene.settings.background_gate
    return scene.with_settings(background_gate=torch.full_like(gate, value)) if torch.is_tensor(gate) else scene


def other_camera(scene, other):
    return scene.with_settings(viewmatrix=other.settings.viewmatrix, projmatrix=other.settings.projmatrix,
                               campos=other.settings.campos)


@with_gates
@pytest.mark.parametrize("options", [{}, dict(split_dc=True, antialiasing=True), dict(channels=5, covariance="cov3D")],
                         ids=["harmonics", "dc", "channels"])
def test_a_replayed_graph_equals_a_call(mode, options, gpu):
    step = TrainingStep(scene_of(mode, **options), gpu)
    graph, results = graph_of(step)
    first = scene_of(mode, **options)
    second = with_other_gate(scene_of(mode, seed=1, **options), 0.6)
    turned = with_other_gate(other_camera(first, scene_of(mode, position=(-3.0, 0.5, -2.0), **options)), 0.0)
    for scene in (first, second, turned, first):
        expected = TrainingStep(scene, gpu)()
        step.set_to(scene.to(torch.float32))
        graph.replay()
        assert (results[1] > 0).sum() > 500
        assert_same(results, expected)


def own_width(mode, width):
    """Returns the width of an image that no other mode renders: what is known of a size, `smoe` and its gates share."""
    return width + 1 + list(BACKGROUND_GATES).index(mode) if mode in BACKGROUND_GATES else width


def list_size(scene, gpu):
    """Returns for how many tile instances a call has room, and how many there are."""
    saved = op_results(scene.to(torch.float32).to(gpu))[1]
    torch.cuda.synchronize()
    return len(saved["instances"]), int(saved["tile_offsets"][-1])


@with_gates
# Room for the lists is what earlier calls of the size and mode needed, and up to 65,536 more: only scenes of many
# Gaussians outgrow it, and only at a size of their own.
@pytest.mark.parametrize("outputs, degree, width", [(OUTPUTS, 1, 203), ((), 3, 219)],
                         ids=["all_images", "colour_alone"])
def test_contents_that_outgrow_the_captured_lists(mode, outputs, degree, width, gpu):
    """Scales grow until many times the tiles are touched, and shrink again."""
    small = scene_of(mode, num_gaussians=20_000, width=own_width(mode, width), height=151, scale=0.004,
                     opacity=(0.02, 0.2), degree=degree)
    larger = small.with_inputs(scales=small.inputs["scales"] * 30)
    in_one_tile = small.with_inputs(means3D=small.inputs["means3D"] * 1e-3)
    step = TrainingStep(small, gpu, outputs)
    graph, results = graph_of(step)
    room = list_size(small, gpu)[0]
    assert list_size(larger, gpu)[1] > room, "nothing is outgrown"
    for scene in (small, larger, small, in_one_tile, larger, small):
        expected = TrainingStep(scene, gpu, outputs)()
        step.set_to(scene.to(torch.float32))
        graph.replay()
        assert_same(results, expected)


@with_gate
def test_a_graph_captured_while_nothing_is_visible(mode, gpu):
    scene = scene_of(mode)
    hidden = scene.with_inputs(means3D=scene.inputs["means3D"] + 30 * scene.settings.campos)
    step = TrainingStep(hidden, gpu)
    graph, results = graph_of(step)
    for contents in (scene, hidden, scene):
        expected = TrainingStep(contents, gpu)()
        step.set_to(contents.to(torch.float32))
        graph.replay()
        assert_same(results, expected)


def test_eager_calls_between_replays(mode, gpu):
    """A graph keeps its own memory: a larger rendering beside it must not disturb it."""
    scene, other = scene_of(mode), TrainingStep(scene_of(mode, seed=3, num_gaussians=9000, scale=0.08), gpu)
    expected = TrainingStep(scene, gpu)()
    step = TrainingStep(scene, gpu)
    graph, results = graph_of(step)
    for _ in range(3):
        other()
        graph.replay()
        other()
        assert_same(results, expected)


@with_gates
def test_torch_sees_no_synchronisation(mode, gpu):
    step = TrainingStep(scene_of(mode), gpu)
    warm_up(step)
    expected = step()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        results = [step() for _ in range(3)]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for result in results:
        assert_same(result, expected)


@with_gate
def test_the_host_waits_for_nothing(mode, gpu):
    """Synchronisations that torch does not know of: the GPU is still busy with earlier work when both passes return."""
    step = TrainingStep(scene_of(mode), gpu)
    assert_same(result_while_busy(step), step())


@with_gate
@pytest.mark.sanitize
def test_growing_contents_without_a_graph(mode, gpu):
    """Each call has more than the one before: what was learned from the last never limits the next."""
    base = scene_of(mode, num_gaussians=20_000, width=own_width(mode, 235), height=151, opacity=(0.02, 0.2))
    scenes = [base.with_inputs(scales=base.inputs["scales"] * factor) for factor in (0.1, 1.0, 4.0, 0.1)]
    step, results = TrainingStep(base, gpu), []
    for index, scene in enumerate(scenes):
        if index == 2:
            room = list_size(scenes[1], gpu)[0]
        step.set_to(scene.to(torch.float32))
        results.append(step())
        torch.cuda.synchronize()  # the count is there for the next call
    assert list_size(scenes[2], gpu)[1] > room, "nothing is outgrown"
    for scene, result in zip(scenes, results):
        assert_same(result, TrainingStep(scene, gpu)())  # which now has room


def test_a_gate_of_the_process_is_not_captured(gpu):
    """Each of its steps has other memory, which a replay would not know."""
    step = TrainingStep(scene_of("smoe").with_settings(background_gate="learned"), gpu)
    warm_up(step)
    with pytest.raises(RuntimeError, match="give background_gate as a tensor or a number"):
        with torch.cuda.graph(torch.cuda.CUDAGraph()):
            step()
