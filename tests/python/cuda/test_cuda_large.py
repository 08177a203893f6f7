"""Where 32-bit numbers end: run on purpose, with DSMOE_LARGE_TESTS=1, on a card with much memory."""
from __future__ import annotations

import os

import pytest
import torch
from comparison import assert_close
from scenes import Scene, camera_settings, gradients, random_scene

from diff_smoe_rasterization import rasterize
from diff_smoe_rasterization.settings import OUTPUTS

MANY = 50_000_000  # Gaussians; their coefficients are 2.4e9 numbers
SIDE, LAYERS = 16384, 2100  # pixels; Gaussians that cover them: 2.2e9 tile instances of 16x16 pixels


@pytest.fixture
def large_gpu(gpu, request):
    """For tests marked with the GB that they need."""
    if not os.environ.get("DSMOE_LARGE_TESTS"):
        pytest.skip("large: set DSMOE_LARGE_TESTS=1")
    free, needed = torch.cuda.mem_get_info()[0] / 1e9, request.param
    if free < needed:
        pytest.skip(f"large: {free:.0f} GB of GPU memory are free, {needed} are needed")
    torch.cuda.reset_peak_memory_stats()
    yield gpu
    assert torch.cuda.max_memory_allocated() < needed * 1e9
    torch.cuda.empty_cache()


def needs(gigabytes):
    return pytest.mark.parametrize("large_gpu", [gigabytes], indirect=True)


@needs(100)
@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_fifty_million_gaussians(mode, large_gpu):
    """A few thousand visible ones among them, up to the last, have the image and gradients they have by themselves."""
    few = random_scene(mode, 5000, 320, 213, scale=0.03, degree=3, dtype=torch.float32).to(large_gpu)
    index = torch.linspace(0, MANY - 1, 5000, dtype=torch.float64, device=large_gpu).long()
    assert index[-1] == MANY - 1
    inputs = {}
    for name, tensor in few.inputs.items():
        inputs[name] = torch.full((MANY, *tensor.shape[1:]), 0.5, device=large_gpu)
        inputs[name][index] = tensor
    behind = torch.ones(MANY, dtype=torch.bool, device=large_gpu)
    behind[index] = False
    inputs["means3D"][behind] = 10 * few.settings.campos
    many = Scene(inputs, few.settings)
    expected, expected_gradients = gradients(rasterize, few, OUTPUTS)
    rendering, gradient = gradients(rasterize, many, OUTPUTS)
    assert (expected.radii > 0).sum() > 1000
    assert torch.equal(rendering.radii[index], expected.radii) and not rendering.radii[behind].any()
    assert torch.equal(rendering.color, expected.color) and torch.equal(rendering.depth, expected.depth)
    for name, values in expected_gradients.items():
        if name in inputs:
            drawn = gradient[name][index]
            assert gradient[name].count_nonzero() == drawn.count_nonzero(), f"{name}: not 0 where culled"
            assert_close(drawn, values, 1e-5, name)  # sums in any order
        else:
            assert_close(gradient[name], values, 1e-5, name)


@needs(30)
@pytest.mark.parametrize("mode", ["alpha", "smoe_std"])
def test_more_tile_instances_than_32_bits_count(mode, large_gpu):
    """Layers without end: every Gaussian is as good as constant over the image, so that the pixels are known.

    In bands; otherwise the lists would take 57 GB while they are sorted.
    """
    assert (SIDE // 16) ** 2 * LAYERS > 2 ** 31
    settings = camera_settings(SIDE, SIDE, position=(0.0, 0.0, -1.0), bg=torch.zeros(1), dtype=torch.float32,
                               blend_mode=mode)
    depth = torch.linspace(1, 2, LAYERS)
    colors = torch.linspace(0, 1, LAYERS)
    inputs = dict(means3D=torch.stack([0 * depth, 0 * depth, depth], 1), means2D=torch.zeros(LAYERS, 3),
                  opacities=torch.full((LAYERS, 1), 0.004), colors_precomp=colors[:, None],
                  scales=torch.full((LAYERS, 3), 1e4), rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(LAYERS, 1))
    scene = Scene(inputs, settings).to(large_gpu)
    rendering, gradient = gradients(rasterize, scene, camera=False)
    # The weights of Eq. 3 and Eq. 6; transmittance stays above 1e-4 (0.996^2100 = 2.2e-4).
    weights = 0.004 * 0.996 ** torch.arange(LAYERS, dtype=torch.float64)
    if mode == "smoe_std":
        weights = torch.full_like(weights, 1 / LAYERS)
    expected = (weights * colors.double()).sum().item()
    # A kernel of standard deviation 1e4 falls by 1e-8 over the view; 2,100 roundings of 6e-8.
    assert (rendering.color - expected).abs().max() < 1e-3 * expected
    pixels = rendering.color.numel()
    # The image gradients are standard normal numbers, the same for all layers, so their sum over pixels is too.
    total = gradient["colors_precomp"][0, 0] / weights[0]
    assert abs(total) < 6 * pixels ** 0.5
    assert_close(gradient["colors_precomp"][:, 0].cpu().double(), weights * total.item(), 1e-3, "colors_precomp")
