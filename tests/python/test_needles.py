"""Gradients of long thin Gaussians in float32: they keep as many digits as plain torch in float32 keeps."""
from __future__ import annotations

import math

import pytest
import torch
from scenes import Scene, camera_settings

import diff_smoe_rasterization
from diff_smoe_rasterization import reference

pytestmark = pytest.mark.usefixtures("device")

FOCAL, DEPTH, WIDTH, HEIGHT = 250, 4, 96, 64


def needles(mode, length, covariance, antialiasing, count=40):
    """Gaussians that lie nearly parallel to the image. length: their standard deviation along it, pixels.

    Across it they are thinner than a pixel; with antialiasing wider, where its factor on the opacity has a gradient.
    """
    generator = torch.Generator(device="cpu").manual_seed(1)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator, device="cpu", dtype=torch.float64)

    settings = camera_settings(WIDTH, HEIGHT, position=(0, 0, -DEPTH), fov_x=2 * math.atan(WIDTH / 2 / FOCAL), degree=0,
                               dtype=torch.float32, blend_mode=mode, antialiasing=antialiasing)
    pixel = DEPTH / FOCAL
    scales = pixel * torch.cat([torch.full((count, 1), float(length), device="cpu"), uniform(0.3, 1.0, count, 2)
                                * (1 if antialiasing else 0.2)], 1)
    half = uniform(0, math.pi, count)
    turned = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], 1)
    rotations = turned + uniform(-0.1, 0.1, count, 4)
    inputs = {"means3D": torch.cat([uniform(-0.6, 0.6, count, 1), uniform(-0.4, 0.4, count, 1),
                                    uniform(-0.5, 0.5, count, 1)], 1),
              "opacities": uniform(0.2, 0.6, count, 1), "colors_precomp": uniform(0, 1, count, 3),
              "scales": scales, "rotations": rotations / rotations.norm(dim=1, keepdim=True)}
    if covariance:
        made = reference.Gaussians(**{**dict.fromkeys(reference.Gaussians._fields), "scales": inputs.pop("scales"),
                                      "rotations": inputs.pop("rotations")})
        full = reference.covariance3D(made, 1.0)
        inputs["cov3D_precomp"] = torch.stack([full[:, i, j] for i in range(3) for j in range(i, 3)], 1)
    return Scene({name: tensor.to(settings.bg) for name, tensor in inputs.items()}, settings)


def gradients(function, scene):
    """Returns the gradients by each input, for an image gradient that changes slowly: their sums cancel the most."""
    scene = scene.requiring_grad(camera=False)
    color = function(settings=scene.settings, **scene.inputs).color
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    weights = torch.stack([torch.cos(0.03 * (c + 1) * x + 0.05 * y + c) for c in range(3)])
    leaves = scene.leaves()
    values = torch.autograd.grad([color], list(leaves.values()), [weights.to(color)], allow_unused=True)
    return dict(zip(leaves, values))


def errors(function, scene, exact):
    """Returns the median and the 90 % quantile over Gaussians of each gradient's error, relative to its row."""
    found = gradients(function, scene)
    rows = {name: (found[name].double() - value).norm(dim=1) / value.norm(dim=1) for name, value in exact.items()}
    return {name: torch.stack([row.quantile(0.5), row.quantile(0.9)]) for name, row in rows.items()}


@pytest.mark.parametrize("shape", ["scales", "covariance", "antialiasing"])
@pytest.mark.parametrize("length", [25, 100])
def test_float32_keeps_the_digits_that_plain_torch_keeps(length, shape):
    # One mode: what differs between modes is finished before the projection's backward pass begins.
    scene = needles("alpha", length, shape == "covariance", shape == "antialiasing")
    names = ["means3D"] + (["cov3D_precomp"] if shape == "covariance" else ["scales", "rotations"])
    exact = gradients(diff_smoe_rasterization.rasterize, scene.to(torch.float64))
    exact = {name: exact[name] for name in names}
    assert all((value.norm(dim=1) > 0).all() for value in exact.values())
    own = errors(diff_smoe_rasterization.rasterize, scene, exact)
    plain = errors(reference.rasterize, scene, exact)
    # Quantiles of 40 roundings each, which differ by chance: by less than 2. A backward pass that forms dL/dSigma has 5
    # to 100 times the error in some column of each shape.
    for name in names:
        assert (own[name] <= 2 * plain[name]).all(), (name, own[name].tolist(), plain[name].tolist())
