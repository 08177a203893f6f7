"""The registered ops: torch.library.opcheck and torch.compile without a graph break."""
from __future__ import annotations

import pytest
import torch
from comparison import assert_same_gradients
from devices import random_normal
from scenes import REMOVABLE_MODES, gradients, op_arguments, op_results, random_scene

import diff_smoe_rasterization
from diff_smoe_rasterization.settings import BLEND_MODES, OUTPUTS

# torch.compile of 2.4.1 breaks the graph when the package looks at its arguments; 2.11 and 2.15 do not.
WHOLE = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 11)
NUM_IMAGES = 2 + len(OUTPUTS)  # results of the op that are the caller's: color and radii too

pytestmark = [
    pytest.mark.usefixtures("device"),
    pytest.mark.skipif(not hasattr(torch.library, "opcheck"),
                       reason=f"torch {torch.__version__} has no torch.library.opcheck, so no fake kernels"),
]


def opcheck_rasterize(scene):
    """torch.library.opcheck of the op `rasterize`.

    Its last part, test_aot_dispatch_dynamic, runs the op twice and wants every result equal. On a GPU some of what is
    kept for the backward pass is memory that is never written: rows of culled Gaussians, instances behind the last
    one. So there that part is done here, on what a caller gets: the images, the radii and the gradients.
    """
    op, arguments = torch.ops.diff_smoe_rasterization.rasterize.default, op_arguments(scene)
    if scene.inputs["means3D"].device.type == "cpu":
        torch.library.opcheck(op, arguments)
        return
    torch.library.opcheck(op, arguments,
                          test_utils=("test_schema", "test_autograd_registration", "test_faketensor"))
    check_aot_dispatch(op, scene)


def check_aot_dispatch(op, scene):
    """Compares the op traced by AOTDispatcher, shapes symbolic, with the op called directly."""
    def images(*arguments):
        return op(*arguments)[:NUM_IMAGES]

    torch._dynamo.reset()
    traced = torch.compile(images, fullgraph=True, dynamic=True, backend="aot_eager")
    (expected, expected_gradients), (actual, actual_gradients) = (
        images_and_gradients(function, scene.requiring_grad()) for function in (images, traced))
    for first, second in zip(expected, actual):
        assert torch.equal(first, second)
    assert_same_gradients(actual_gradients, expected_gradients)


def images_and_gradients(function, scene):
    images = function(*op_arguments(scene))
    differentiable = [image for image in images if image.requires_grad]
    leaves = scene.leaves()
    values = torch.autograd.grad(differentiable, list(leaves.values()),
                                 [random_normal(image.shape, seed, image.dtype)
                                  for seed, image in enumerate(differentiable)], allow_unused=True)
    return images, {name: torch.zeros_like(leaf) if value is None else value
                    for (name, leaf), value in zip(leaves.items(), values)}


# With and without a tensor for the background's gate, with and without depth order: other modes have the same shapes.
SHAPES = pytest.mark.parametrize("mode", ["smoe", "smoe_std", "smoe_learned_gate"])


@pytest.mark.parametrize("mode, case", [
    ("smoe", dict(degree=1)), ("smoe_std", dict(degree=1)), ("smoe_learned_gate", dict(degree=1)),
    ("alpha", dict(degree=1, split_dc=True)), ("smoe", dict(channels=5, covariance="cov3D"))])
def test_opcheck_of_rasterize(mode, case):
    scene = random_scene(mode, 20, 20, 18, dtype=torch.float32, **case).requiring_grad()
    opcheck_rasterize(scene)


@pytest.mark.parametrize("case", [dict(degree=1), dict(channels=5, covariance="cov3D")])
def test_opcheck_of_project(case):
    """Nobody has written the rows of culled Gaussians on a GPU, so there results are not compared."""
    scene = random_scene("smoe", 20, 20, 18, dtype=torch.float32, **case)
    op, arguments = torch.ops.diff_smoe_rasterization.project.default, op_arguments(scene, "project")
    on_gpu = scene.inputs["means3D"].device.type == "cuda"
    torch.library.opcheck(op, arguments, test_utils=("test_schema", "test_faketensor", *(
        () if on_gpu else ("test_aot_dispatch_dynamic",))))


@SHAPES
def test_opcheck_of_rasterize_on_no_gaussians(mode):
    scene = random_scene(mode, 20, 20, 18, dtype=torch.float32).rows(slice(0, 0)).requiring_grad()
    opcheck_rasterize(scene)


@SHAPES
def test_opcheck_of_radii(mode):
    scene = random_scene(mode, 20, 20, 18, dtype=torch.float32)
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.radii.default, op_arguments(scene, "radii"))


def test_opcheck_of_mark_visible():
    scene = random_scene("alpha", 20, dtype=torch.float32)
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.mark_visible.default,
                          (scene.inputs["means3D"], scene.settings.viewmatrix, 0.2))


@SHAPES
@pytest.mark.parametrize("name, maps, of_images", [
    ("contributions", ["pixel_weights"], ["radii"]),
    ("importance", ["pixel_weights", "share_weights"], ["radii", "color", "gate_sum"])])
def test_opcheck_of_scores(mode, name, maps, of_images):
    scene = random_scene(mode, 20, 20, 18, dtype=torch.float32)
    images, saved = op_results(scene)
    weights = random_normal((18, 20), 1, torch.float32)
    arguments = op_arguments(scene, name, saved=list(saved.values()), **dict.fromkeys(maps, weights),
                             **{image: images[image] for image in of_images})
    # Sums by atomics differ in their last digits, which the last part of opcheck does not allow.
    parts = {} if weights.device.type == "cpu" else {
        "test_utils": ("test_schema", "test_autograd_registration", "test_faketensor")}
    torch.library.opcheck(getattr(torch.ops.diff_smoe_rasterization, name).default, arguments, **parts)


@SHAPES
def test_opcheck_of_gate_map(mode):
    scene = random_scene(mode, 20, 20, 18, dtype=torch.float32)
    images, saved = op_results(scene)
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.gate_map.default,
                          op_arguments(scene, "gate_map", saved=list(saved.values()),
                                       **{name: images[name] for name in ("gate_sum", "radii")}))


@pytest.mark.parametrize("mode", REMOVABLE_MODES)
def test_compiled_contributions_equal_eager(mode):
    def score(settings, pixel_weights, **inputs):
        rendering, splats = diff_smoe_rasterization.rasterize_with_splats(settings=settings, **inputs)
        return (rendering.color, splats.centers, splats.depths, *splats.contributions(pixel_weights),
                *splats.importance(pixel_weights), *splats.gate_map())

    scene = random_scene(mode, 60, 40, 30, dtype=torch.float32, degree=1)
    pixel_weights = random_normal((30, 40), 1, torch.float32).abs()
    torch._dynamo.reset()
    compiled = torch.compile(score, fullgraph=WHOLE, backend="aot_eager")
    for actual, expected in zip(compiled(scene.settings, pixel_weights, **scene.inputs),
                                score(scene.settings, pixel_weights, **scene.inputs)):
        # Positive numbers: a GPU adds them in any order, each rounded by 6e-8.
        torch.testing.assert_close(actual, expected, rtol=0 if actual.device.type == "cpu" else 1e-5, atol=0)


@pytest.mark.skipif(not WHOLE, reason=f"torch.compile of torch {torch.__version__} breaks the graph")
def test_compiled_renderings_without_gradients_have_no_backward_pass_to_come():
    """The op's last argument, in the graphs that torch.compile makes with gradients and without them."""
    scene, wanted = random_scene("smoe", 60, 40, 30, dtype=torch.float32, degree=1), []
    op = torch.ops.diff_smoe_rasterization.rasterize

    def backend(graph, inputs):
        calls = [node for node in graph.graph.nodes if node.target in (op, op.default)]
        wanted.extend(node.args[len(op.default._schema.arguments) - 1] for node in calls)
        return graph

    torch._dynamo.reset()
    compiled = torch.compile(diff_smoe_rasterization.rasterize, fullgraph=True, backend=backend)
    expected = diff_smoe_rasterization.rasterize(settings=scene.settings, **scene.inputs).color
    for with_gradients in (True, False, True):
        with torch.set_grad_enabled(with_gradients):
            assert torch.equal(compiled(settings=scene.settings, **scene.inputs).color, expected)
    assert wanted == [True, False]


@pytest.mark.parametrize("mode, backend", [
    *((mode, "aot_eager") for mode in BLEND_MODES + ("smoe_learned_gate",)), ("smoe", "eager")])
def test_compiled_equals_eager(mode, backend):
    scene = random_scene(mode, 60, 40, 30, dtype=torch.float32, degree=1)
    expected, expected_gradients = gradients(diff_smoe_rasterization.rasterize, scene, OUTPUTS)
    torch._dynamo.reset()
    compiled = torch.compile(diff_smoe_rasterization.rasterize, fullgraph=WHOLE, backend=backend)
    actual, actual_gradients = gradients(compiled, scene, OUTPUTS)
    for first, second in zip(expected, actual):
        assert torch.equal(first, second)
    assert_same_gradients(actual_gradients, expected_gradients)
