"""How programs use the rasterizer beside one plain call: views, no_grad, many calls, second derivatives."""
from __future__ import annotations

import importlib
import os
import pkgutil

import pytest
import torch
from comparison import assert_same_gradients
from devices import random_normal
from scenes import gradients, op_arguments, random_scene
from torch.autograd import forward_ad

import diff_smoe_rasterization
from diff_smoe_rasterization import (
    DirectRendering,
    Footprints,
    GaussianRasterizer,
    blend_footprints,
    distCUDA2,
    fused_ssim,
    project_gaussians,
    rasterize,
    rasterize_with_splats,
    reference,
    visible_radii,
)
from diff_smoe_rasterization.autograd import _FirstDerivatives
from diff_smoe_rasterization.gaussians import activate
from diff_smoe_rasterization.integrations import speedy_splat
from diff_smoe_rasterization.losses import l1_ssim_loss
from diff_smoe_rasterization.settings import OUTPUTS

pytestmark = pytest.mark.usefixtures("device")


def used_bytes(device):
    """Returns the GPU memory that tensors take, or, for the CPU, the resident memory of the process."""
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    with open("/proc/self/statm") as statistics:
        return int(statistics.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def not_contiguous(tensor):
    """Returns the same values as every second column of a wider tensor."""
    wide = torch.stack([tensor, torch.full_like(tensor, float("nan"))], -1).flatten(-2)
    view = wide[..., ::2]
    assert torch.equal(view, tensor) and not view.is_contiguous()
    return view


@pytest.mark.parametrize("options", [{}, dict(split_dc=True), dict(channels=4, covariance="cov3D")],
                         ids=["shs", "dc", "colours"])
def test_views_that_are_not_contiguous(mode, options):
    scene = random_scene(mode, 30, 20, 18, degree=1, dtype=torch.float32, **options)
    settings = scene.settings._replace(**{name: not_contiguous(getattr(scene.settings, name))
                                          for name in ("bg", "viewmatrix", "projmatrix", "campos")})
    leaves = {name: tensor.clone().requires_grad_(True) for name, tensor in scene.inputs.items()}
    views = {name: not_contiguous(leaf) for name, leaf in leaves.items()}
    color = rasterize(settings=settings, **views).color
    expected, expected_gradients = gradients(rasterize, scene, camera=False)
    assert torch.equal(color, expected.color)
    actual = torch.autograd.grad(color, list(leaves.values()), random_normal(color.shape, 1).to(color))
    assert_same_gradients(dict(zip(leaves, actual)), expected_gradients)


def test_an_image_gradient_that_is_not_contiguous(mode):
    scene = random_scene(mode, 30, 20, 18, degree=1, dtype=torch.float32).requiring_grad()
    leaves = scene.leaves()
    color = rasterize(settings=scene.settings, **scene.inputs).color

    def backward(*arguments):
        return dict(zip(leaves, torch.autograd.grad(*arguments, retain_graph=True)))

    expanded = backward(color.sum(), list(leaves.values()))
    dense = backward(color, list(leaves.values()), torch.ones_like(color))
    transposed = backward(color, list(leaves.values()), torch.ones(18, 20, 3).permute(2, 0, 1))
    assert_same_gradients(dense, expanded)
    assert_same_gradients(transposed, expanded)


def test_only_the_wanted_gradients_are_made(mode):
    scene = random_scene(mode, 30, 20, 18, degree=1, dtype=torch.float32)
    _, expected = gradients(rasterize, scene)
    for name in scene.inputs:
        leaf = scene.inputs[name].clone().requires_grad_(True)
        color = rasterize(settings=scene.settings, **{**scene.inputs, name: leaf}).color
        color.backward(random_normal(color.shape, 1).to(color))
        assert_same_gradients({name: leaf.grad}, {name: expected[name]})


def test_means2D_may_be_left_out(mode):
    scene = random_scene(mode, 30, 20, 18, degree=1, dtype=torch.float32).requiring_grad()
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "means2D"}
    color = rasterize(settings=scene.settings, **inputs).color
    assert torch.equal(color, rasterize(settings=scene.settings, **scene.inputs).color)
    color.sum().backward()
    assert scene.inputs["means3D"].grad.any()


@pytest.mark.parametrize("option", ["debug", "deterministic"])
def test_what_only_checks_or_orders_changes_no_result(mode, option):
    """On the CPU gradients always are reproducible; cuda/test_cuda_determinism.py has what a GPU promises."""
    scene = random_scene(mode, 30, 20, 18, degree=1, dtype=torch.float32)
    plain, plain_gradient = gradients(rasterize, scene, OUTPUTS)
    images, gradient = gradients(rasterize, scene.with_settings(**{option: True}), OUTPUTS)
    assert all(torch.equal(a, b) for a, b in zip(plain, images))
    assert_same_gradients(gradient, plain_gradient)


@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode])
def test_without_gradients(mode, context):
    scene = random_scene(mode, 30, 20, 18, degree=1, dtype=torch.float32)
    leaf = scene.requiring_grad()
    expected = rasterize(settings=leaf.settings, outputs=OUTPUTS, **leaf.inputs)
    assert expected.color.requires_grad and not expected.radii.requires_grad
    with context():
        rendering = rasterize(settings=leaf.settings, outputs=OUTPUTS, **leaf.inputs)
    for first, second in zip(rendering, expected):
        assert not first.requires_grad and torch.equal(first, second.detach())


def rendering_leaves(seed=0):
    scene = random_scene("smoe_learned_gate", 30, 20, 18, degree=1, seed=seed, dtype=torch.float32)
    scene = scene.requiring_grad()
    return scene, scene.leaves()


def second_of_rasterize():
    scene, leaves = rendering_leaves()
    return leaves, rasterize(settings=scene.settings, **scene.inputs).color


def second_of_splats():
    scene, leaves = rendering_leaves()
    return leaves, rasterize_with_splats(settings=scene.settings, **scene.inputs)[0].color


def second_of_projection():
    scene, leaves = rendering_leaves()
    footprints = project_gaussians(settings=scene.settings, **scene.inputs).visible()
    leaves = {name: leaf for name, leaf in leaves.items() if name not in ("bg", "background_gate")}
    return leaves, footprints.gates.sum() + footprints.features.sum()


def second_of_blend():
    scene, leaves = rendering_leaves()
    with torch.no_grad():
        gates, features, radii = project_gaussians(settings=scene.settings, **scene.inputs)
    leaves = {"gates": gates.requires_grad_(), "features": features.requires_grad_(),
              **{name: leaves[name] for name in ("bg", "background_gate")}}
    return leaves, blend_footprints(Footprints(gates, features, radii), scene.settings).color


def second_of_halves():
    scene, leaves = rendering_leaves()
    return leaves, blend_footprints(project_gaussians(settings=scene.settings, **scene.inputs), scene.settings).color


def second_of_activate():
    leaves = {str(columns): random_normal((7, columns), columns, torch.float32).requires_grad_()
              for columns in (1, 3, 4)}
    return leaves, sum(value.sum() for value in activate(*leaves.values()))


def second_of_loss(loss):
    image, target = (random_normal((3, 20, 18), seed, torch.float32) for seed in (1, 2))
    return {"image": image.requires_grad_()}, loss(image, target)


def second_of_scores():
    scene, leaves = rendering_leaves()
    scores = torch.zeros(30, 1, requires_grad=True)
    settings = speedy_splat.GaussianRasterizationSettings(*scene.settings)
    color = speedy_splat.GaussianRasterizer(settings)(**scene.inputs, scores=scores)[0]
    return {**leaves, "scores": scores}, color


SECOND = {"rasterize": second_of_rasterize, "rasterize_with_splats": second_of_splats,
          "project_gaussians": second_of_projection, "blend_footprints": second_of_blend, "halves": second_of_halves,
          "activate": second_of_activate, "l1_ssim_loss": lambda: second_of_loss(l1_ssim_loss),
          "fused_ssim": lambda: second_of_loss(fused_ssim), "speedy_splat": second_of_scores}
"""Every function with a gradient: what makes its leaves by name, and its result."""


@pytest.mark.parametrize("name", SECOND)
def test_second_derivatives_are_refused(name):
    """By each leaf of each gradient, of a loss that is linear in the result and has further terms."""
    leaves, result = SECOND[name]()
    loss = result.sum() + sum((leaf ** 2).sum() for leaf in leaves.values())
    firsts = torch.autograd.grad(loss, list(leaves.values()), create_graph=True)
    for by, first in zip(leaves, firsts):
        for other, leaf in leaves.items():
            if other == "scores" != by:  # the image does not depend on scores
                continue
            with pytest.raises(RuntimeError, match="second derivatives are not implemented"):
                torch.autograd.grad(first.sum() + (leaf ** 2).sum(), leaf, retain_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives are not implemented"):
        sum(first.sum() for first in firsts).backward()


def test_second_derivatives_are_tried_of_every_function_with_a_gradient():
    """Those are the package's autograd.Functions and, by their schemas, the ops with a backward op."""
    for module in pkgutil.walk_packages(diff_smoe_rasterization.__path__, "diff_smoe_rasterization."):
        if not module.name.endswith((".libdsmoe", "._ops")):  # which are libraries for C++
            importlib.import_module(module.name)
    theirs = {each.__name__ + "Backward" for each in torch.autograd.Function.__subclasses__()
              if each.__module__.startswith("diff_smoe_rasterization.")
              and each not in (_FirstDerivatives, reference._PassThroughClamp)}
    seen = set()
    for make in SECOND.values():
        result = make()[1]  # torch 2.11 tells of the nodes of Python's Functions while it lives
        nodes = [result.grad_fn]
        while nodes:
            node = nodes.pop()
            seen.add(type(node).__name__)
            nodes += [each for each, _ in node.next_functions if each is not None]
    assert theirs and theirs <= seen
    ops = {schema.name.partition("::")[2] for schema in torch._C._jit_get_all_schemas()
           if schema.name.startswith("diff_smoe_rasterization::")}
    with_backward = {op for op in ops if f"{op}_backward" in ops}
    assert with_backward == {"rasterize", "project", "blend", "activate", "project_rows"}  # the last: not by autograd


@pytest.mark.skipif(not hasattr(torch, "func"), reason=f"torch {torch.__version__} has no torch.func")
def test_torch_func_is_refused():
    scene = random_scene("smoe", 20, 20, 18, degree=1, dtype=torch.float32)
    image = rasterize(settings=scene.settings, **scene.inputs).color

    def with_means(function):
        return lambda means: function(settings=scene.settings, **{**scene.inputs, "means3D": means})

    means, shape = scene.inputs["means3D"], {name: scene.inputs[name] for name in ("scales", "rotations")}
    splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1]
    functions = {
        "rasterize": (with_means(lambda **inputs: rasterize(**inputs).color.sum()), means),
        "project_gaussians": (with_means(lambda **inputs: project_gaussians(**inputs).features.sum()), means),
        "DirectRendering": (with_means(lambda **inputs: DirectRendering(**inputs).render().color.sum()), means),
        "activate": (lambda scales: activate(torch.ones(20, 1), scales, scene.inputs["rotations"])[1].sum(),
                     scene.inputs["scales"]),
        "visible_radii": (lambda means: visible_radii(means, scene.settings, **shape).sum().float(), means),
        "markVisible": (lambda means: GaussianRasterizer(scene.settings).markVisible(means).sum().float(), means),
        "distCUDA2": (lambda means: distCUDA2(means).sum(), means),
        "contributions": (lambda weights: splats.contributions(weights).pixel_weights.sum(), torch.ones(18, 20)),
        "importance": (lambda weights: splats.importance(weights).shares.sum(), torch.ones(18, 20)),
        "SSIM and the image loss": (lambda one: l1_ssim_loss(one, image), image)}
    for name, (function, value) in functions.items():
        for transformed, argument in ((torch.func.grad(function), value), (torch.vmap(function), value[None])):
            with pytest.raises(NotImplementedError, match=rf"{name}: torch.func \(grad, .* is not implemented; take"):
                transformed(argument)
        with pytest.raises(NotImplementedError, match=f"{name}: (forward-mode|torch.func).* not implemented"):
            torch.func.jvp(function, (value,), (value,))


def test_forward_mode_is_refused():
    """If it were not, every tangent would be zero. Plain tensors may be rendered meanwhile."""
    scene = random_scene("smoe", 20, 20, 18, degree=1, dtype=torch.float32)
    image = rasterize(settings=scene.settings, **scene.inputs).color

    def render(scales, settings=scene.settings):
        return rasterize(settings=settings, **{**scene.inputs, "scales": scales}).color

    def refused(function, *arguments, words="forward-mode derivatives .* are not implemented"):
        with pytest.raises(NotImplementedError, match=words):
            function(*arguments)

    scales = scene.inputs["scales"]
    leaf = scales.clone().requires_grad_(True)
    color = render(leaf)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(scales, torch.ones_like(scales))
        assert torch.equal(render(scales), image)
        refused(render, dual)
        refused(render, forward_ad.make_dual(leaf, scales))
        refused(render, scales, scene.settings._replace(bg=forward_ad.make_dual(scene.settings.bg, scales[0])))
        refused(torch.autograd.grad, color, leaf, forward_ad.make_dual(image, image))
        refused(activate, scene.inputs["opacities"].view(-1, 1), dual, scene.inputs["rotations"])
        refused(fused_ssim, forward_ad.make_dual(image, image), image)
        refused(l1_ssim_loss, forward_ad.make_dual(image, image), image)
        # PyTorch 2.4 itself refuses this one, before the op is called.
        refused(torch.ops.diff_smoe_rasterization.rasterize, *op_arguments(scene.with_inputs(scales=dual)),
                words="forward-mode derivatives .* are not implemented|implement the jvp function")
        refused(torch.ops.diff_smoe_rasterization.radii, *op_arguments(scene.with_inputs(scales=dual), "radii"))
    if hasattr(torch, "func"):
        for function in [render] + [torch.compile(render, backend="eager")] * hasattr(torch.library, "opcheck"):
            refused(torch.func.jvp, function, (scales,), (scales,))
            refused(torch.func.jacfwd(function), scales)


def test_backward_can_run_again_on_a_retained_graph(mode):
    scene = random_scene(mode, 30, 20, 18, degree=1, dtype=torch.float32).requiring_grad()
    leaves = scene.leaves()
    color = rasterize(settings=scene.settings, **scene.inputs).color
    first = torch.autograd.grad(color.sum(), list(leaves.values()), retain_graph=True)
    second = torch.autograd.grad(color.sum(), list(leaves.values()))
    assert_same_gradients(dict(zip(leaves, second)), dict(zip(leaves, first)))


def test_an_input_changed_in_place_before_backward_is_noticed():
    scene = random_scene("smoe", 30, 20, 18, degree=1, dtype=torch.float32)
    leaf = scene.inputs["shs"].clone().requires_grad_(True)
    means3D = scene.inputs["means3D"].clone()
    color = rasterize(settings=scene.settings, **{**scene.inputs, "shs": leaf, "means3D": means3D}).color
    means3D.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        color.sum().backward()


def test_many_identical_calls_keep_the_memory_flat(mode, device):
    scene = random_scene(mode, 30, 33, 21, degree=1, dtype=torch.float32).requiring_grad()
    leaves = list(scene.leaves().values())

    def call():
        rendering = rasterize(settings=scene.settings, outputs=OUTPUTS, **scene.inputs)
        torch.autograd.grad(rendering.color.sum() + rendering.depth.sum(), leaves)

    for _ in range(200):
        call()
    before = used_bytes(device)
    for _ in range(1000):
        call()
    # One image of 8 KiB kept a call would be 8 MiB.
    assert used_bytes(device) - before < 3 * 2 ** 20
