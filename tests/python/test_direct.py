"""DirectRendering against `rasterize` under autograd: the same radii, images and gradients, and no row too many."""
from __future__ import annotations

import pytest
import torch
from scenes import random_scene, with_gate

from diff_smoe_rasterization import DirectRendering, rasterize, rasterize_with_splats, visible_radii
from diff_smoe_rasterization.settings import OUTPUTS

OLD = 77.0  # what memory holds before a gradient is written to it


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("layout", ["shs", "dc and shs", "all of degree 3", "colors", "covariances"])
def test_direct_is_rasterize_bit_for_bit(device, mode, dtype, layout):
    degree = 3 if layout == "all of degree 3" else 2
    scene = random_scene(mode, 300, 61, 43, degree=degree, dtype=dtype, channels=4 if layout == "colors" else None,
                         covariance="cov3D" if layout == "covariances" else "scales",
                         split_dc=layout in ("dc and shs", "all of degree 3"))
    scene = scene.with_settings(deterministic=True)
    graph = scene.requiring_grad()
    wanted = rasterize(settings=graph.settings, outputs=OUTPUTS, **graph.inputs)
    images = {"color": wanted.color, **{name: getattr(wanted, name) for name in OUTPUTS}}
    weights = {name: torch.linspace(-1, 1, image.numel(), dtype=dtype).view_as(image)
               for name, image in images.items()}
    torch.autograd.backward(list(images.values()), [weights[name] for name in images])

    direct = DirectRendering(settings=scene.settings, outputs=OUTPUTS, **scene.inputs)
    assert torch.equal(direct.visible_radii(), wanted.radii)
    rendering = direct.render()
    assert torch.equal(rendering.radii, wanted.radii) and not rendering.color.requires_grad
    assert all(torch.equal(getattr(rendering, name), image) for name, image in images.items())
    camera = scene.camera()
    gradients = {name: torch.full_like(tensor, OLD) for name, tensor in {**scene.inputs, **camera}.items()}
    direct.backward(weights, gradients)
    seen = wanted.radii > 0
    assert seen.any() and not seen.all()
    for name, tensor in graph.inputs.items():
        assert torch.equal(gradients[name][seen], tensor.grad[seen]), name
        assert (gradients[name][~seen] == OLD).all(), name
    for name, tensor in graph.camera().items():
        assert torch.equal(gradients[name], tensor.grad), name


@pytest.mark.parametrize("dc_apart", [False, True])
def test_colour_alone_is_rasterize_bit_for_bit(device, dc_apart):
    """What a trainer asks for: three colours of degree 3 in float, and no camera. It has kernels of its own."""
    scene = random_scene("alpha", 1200, 61, 43, degree=3, dtype=torch.float32, split_dc=dc_apart)
    scene = scene.with_settings(deterministic=True)
    graph = scene.requiring_grad()
    wanted = rasterize(settings=graph.settings, **graph.inputs)
    weight = torch.linspace(-1, 1, wanted.color.numel()).view_as(wanted.color)
    wanted.color.backward(weight)

    direct = DirectRendering(settings=scene.settings, **scene.inputs)
    assert torch.equal(direct.render().color, wanted.color)
    gradients = {name: torch.full_like(tensor, OLD) for name, tensor in scene.inputs.items()}
    direct.backward({"color": weight}, gradients)
    seen = wanted.radii > 0
    assert 0.1 < seen.float().mean() < 0.9
    for name, tensor in graph.inputs.items():
        assert torch.equal(gradients[name][seen], tensor.grad[seen]), name
        assert (gradients[name][~seen] == OLD).all(), name


def test_what_needs_arguments_says_so_once_they_are_forgotten(device):
    """And what needs a rendering, before there is one."""
    scene = random_scene("alpha", 50)
    direct = DirectRendering(settings=scene.settings, **scene.inputs)
    with pytest.raises(RuntimeError, match="DirectRendering.room: nothing is rendered yet; call render first"):
        direct.room  # noqa: B018
    color = direct.render().color
    assert direct.room >= 0
    direct.forget_gaussians()
    for name, arguments in (("visible_radii", ()), ("render", ()), ("backward", ({"color": color}, {}))):
        words = f"DirectRendering.{name}: forget_gaussians has let go of the arguments; call {name} before it"
        with pytest.raises(RuntimeError, match=words):
            getattr(direct, name)(*arguments)
    assert direct.splats().depths.shape == (50,)


def test_only_what_is_asked_for_is_computed(device):
    scene = random_scene("alpha", 50)
    direct = DirectRendering(settings=scene.settings, **scene.inputs)
    color = direct.render().color
    means, shs = torch.zeros_like(scene.inputs["means3D"]), torch.zeros_like(scene.inputs["shs"])
    direct.backward({"color": torch.ones_like(color)}, {"means3D": means})
    direct.backward({"color": torch.ones_like(color)}, {"shs": shs})
    assert means.any() and shs.any()
    assert torch.equal(direct.visible_radii(), visible_radii(scene.inputs["means3D"], scene.settings,
                                                             scales=scene.inputs["scales"],
                                                             rotations=scene.inputs["rotations"]))


def test_splats_of_a_direct_rendering(device):
    """What its pixels say of each Gaussian, before the gradients; on CUDA sums are added in any order."""
    scene = random_scene("smoe", 300, 61, 43)
    direct = DirectRendering(settings=scene.settings, **scene.inputs)
    direct.render()
    wanted = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1].importance()
    for actual, expected in zip(direct.splats().importance(), wanted):
        assert expected.any()
        torch.testing.assert_close(actual, expected)


def test_what_does_not_fit_is_refused(device):
    scene = random_scene("alpha", 20)
    direct = DirectRendering(settings=scene.settings, **scene.inputs)
    color = torch.ones_like(direct.render().color)
    means = scene.inputs["means3D"]
    with pytest.raises(ValueError, match="gradients has colors_precomp; they may have"):
        direct.backward({"color": color}, {"colors_precomp": means})
    with pytest.raises(ValueError, match="dL_dimages has colour"):
        direct.backward({"colour": color}, {"means3D": means})
    with pytest.raises(ValueError, match="the gradient of means3D has shape"):
        direct.backward({"color": color}, {"means3D": means[1:].clone()})
    with pytest.raises(ValueError, match="the gradient of means3D"):
        direct.backward({"color": color}, {"means3D": torch.zeros(3, 20, dtype=means.dtype).t()})


@pytest.mark.parametrize("name", ["means3D", "opacities", "shs", "bg", "color", "gate_sum"])
def test_what_changes_between_rendering_and_gradients_is_refused(device, name):
    scene = random_scene("smoe", 50)
    direct = DirectRendering(settings=scene.settings, outputs=("alpha",), **scene.inputs)
    scene.inputs["means3D"].mul_(1.0)  # before the rendering anything may change
    rendering = direct.render()
    tensors = {**scene.inputs, "bg": scene.settings.bg, "color": rendering.color, "gate_sum": rendering.alpha}
    weights, gradients = {"color": torch.ones_like(rendering.color)}, {"means3D": torch.zeros(50, 3).double()}
    direct.backward(weights, gradients)
    tensors[name].add_(0.1)
    with pytest.raises(RuntimeError, match=f"backward: {name} was changed in place since render"):
        direct.backward(weights, gradients)
    direct.render()
    direct.backward(weights, gradients)


def test_what_comes_before_render_is_refused(device):
    scene = random_scene("smoe", 20, 20, 18, degree=1, dtype=torch.float32)
    direct = DirectRendering(settings=scene.settings, **scene.inputs)
    for name, call in (("backward", lambda: direct.backward({}, {})), ("splats", direct.splats)):
        with pytest.raises(RuntimeError, match=f"^DirectRendering.{name}: nothing is rendered yet; call render first$"):
            call()


@pytest.mark.parametrize("wrong, words", [
    (lambda image: image.to_sparse(), "is sparse"), (lambda image: image.tolist(), "is of type list"),
    (lambda image: image.to("meta"), "is on meta")])
def test_gradients_that_no_op_takes_are_named(device, wrong, words):
    scene = random_scene("smoe", 20, 20, 18, degree=1, dtype=torch.float32)
    direct = DirectRendering(settings=scene.settings, **scene.inputs)
    weight = torch.ones_like(direct.render().color)
    with pytest.raises(TypeError, match=rf"DirectRendering.backward: dL_dimages\['color'\] {words}"):
        direct.backward({"color": wrong(weight)}, {})
    with pytest.raises(TypeError, match=rf"DirectRendering.backward: gradients\['scales'\] {words}"):
        direct.backward({"color": weight}, {"scales": wrong(scene.inputs["scales"])})
