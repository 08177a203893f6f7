"""The registered ops: torch.library.opcheck and torch.compile without a graph break."""
from __future__ import annotations

import pytest
import torch
from scenes import gradients, random_scene

import diff_smoe_rasterization
from diff_smoe_rasterization.settings import BLEND_MODES, OUTPUTS

pytestmark = pytest.mark.skipif(not hasattr(torch.library, "opcheck"),
                                reason=f"torch {torch.__version__} has no torch.library.opcheck, so no fake kernels")


def op_arguments(scene, outputs=OUTPUTS):
    """Returns the arguments of the op `rasterize` for a scene, in the order of its schema."""
    settings, inputs = scene.settings, scene.inputs
    tensors = [inputs.get(name) for name in ("means3D", "means2D", "opacities", "dc", "shs", "colors_precomp", "scales",
                                             "rotations", "cov3D_precomp")]
    camera = [settings.bg, settings.viewmatrix, settings.projmatrix, settings.campos]
    options = [settings.image_height, settings.image_width, settings.tanfovx, settings.tanfovy, settings.scale_modifier,
               settings.near, settings.alpha_min, settings.sh_degree, BLEND_MODES.index(settings.blend_mode),
               settings.antialiasing, "depth" in outputs, "inverse_depth" in outputs, settings.debug]
    return tuple(tensors + camera + options + [settings.strict, settings.prefiltered])


@pytest.mark.parametrize("case", [dict(degree=1), dict(degree=1, split_dc=True), dict(channels=5, covariance="cov3D")],
                         ids=["shs", "dc", "channels"])
def test_opcheck_of_rasterize(mode, case):
    scene = random_scene(mode, 20, 20, 18, dtype=torch.float32, **case).requiring_grad()
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.rasterize.default, op_arguments(scene))


def test_opcheck_of_rasterize_on_no_gaussians(mode):
    scene = random_scene(mode, 20, 20, 18, dtype=torch.float32).rows(slice(0, 0)).requiring_grad()
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.rasterize.default, op_arguments(scene))


def test_opcheck_of_mark_visible():
    scene = random_scene("alpha", 20, dtype=torch.float32)
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.mark_visible.default,
                          (scene.inputs["means3D"], scene.settings.viewmatrix, 0.2))


@pytest.mark.parametrize("backend", ["eager", "aot_eager"])
def test_compiled_equals_eager(mode, backend):
    scene = random_scene(mode, 60, 40, 30, dtype=torch.float32, degree=1)
    expected, expected_gradients = gradients(diff_smoe_rasterization.rasterize, scene, OUTPUTS)
    torch._dynamo.reset()
    compiled = torch.compile(diff_smoe_rasterization.rasterize, fullgraph=True, backend=backend)
    actual, actual_gradients = gradients(compiled, scene, OUTPUTS)
    for first, second in zip(expected, actual):
        assert torch.equal(first, second)
    for name, gradient in expected_gradients.items():
        assert torch.equal(gradient, actual_gradients[name]), name
