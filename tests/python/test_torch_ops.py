"""The registered ops: torch.library.opcheck and torch.compile without a graph break."""
from __future__ import annotations

import pytest
import torch
from comparison import assert_same_gradients
from scenes import gradients, op_arguments, random_scene

import diff_smoe_rasterization
from diff_smoe_rasterization.settings import OUTPUTS

pytestmark = [
    pytest.mark.usefixtures("device"),
    pytest.mark.skipif(not hasattr(torch.library, "opcheck"),
                       reason=f"torch {torch.__version__} has no torch.library.opcheck, so no fake kernels"),
]


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
    assert_same_gradients(actual_gradients, expected_gradients)
