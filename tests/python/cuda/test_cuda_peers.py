"""Against public rasterizers, if there: $DSMOE_PEERS holds a folder each (inria, dr_aa, gsplat) with its package.

$DSMOE_BIG_MODEL is the model: an .npz that benchmarks/timing/models.py reads (gpu_rasterizer.py --save-npz writes one
of a trained .ply and its scene). Without it a made-up one is used.

Known differences, each with its test or the reason why there is none:
- Inria's backward is not the derivative of its forward if the projection's Jacobian is clamped, beyond 1.3 tan(fov /
  2): it counts a part of dz twice. Those Gaussians' gradients of the means are left out.
- Its antialiasing (dr_aa) differentiates sqrt(det / det') with the low-pass added to both determinants.
- 3dgs_accel subtracts the background twice in its backward; with a black one nothing shows. It is not compared.
"""
from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import torch
from scenes import Scene

from diff_smoe_rasterization import rasterize
from diff_smoe_rasterization.settings import GaussianRasterizationSettings

VIEWS = 10
WORKER = os.path.join(os.path.dirname(os.path.abspath(__file__)), "peer_worker.py")
RADII = 1e-5  # part of the Gaussians whose radius, the ceiling of a rounded root, may differ by 1
# Every pixel that differs is looked into (flips.py): it must show another outcome of a threshold, or what roundings can
# add up to. How many do is limited too, so that a rule that is a little wrong cannot pass for either.
FLIPPED = 5e-4  # part of the pixels: of some tens of pairs a pixel, one within 1e-5 of the cut in ln(alpha)
ROUNDED = 2e-3  # part of the pixels: splats of half a pixel, whose alpha a position's rounding moves by 1e-4 of itself
GRADIENT = 1e-3  # in float32 on both sides, each a sum by atomics in any order


@pytest.fixture
def model(gpu, tmp_path):
    path = os.environ.get("DSMOE_BIG_MODEL")
    if path:
        assert os.path.isfile(path), f"DSMOE_BIG_MODEL: there is no file {path}"
        return path
    sys.path.insert(0, os.path.join(os.path.dirname(WORKER), "..", "..", "..", "benchmarks", "timing"))
    import models
    path = str(tmp_path / "synthetic.npz")
    models.to_npz(models.synthetic(300_000), path)
    return path


def package(name):
    """Folder of a peer; skips the test if it is absent."""
    folder = os.path.join(os.environ.get("DSMOE_PEERS", ""), name)
    if not os.environ.get("DSMOE_PEERS") or not os.path.isdir(folder) or not os.listdir(folder):
        pytest.skip(f"there is no {name} (set DSMOE_PEERS to the folder of installed rasterizers)")
    return folder


def compared(name, model):
    """Rows of peer_worker.py, by view."""
    package(name.split("+")[0])
    run = subprocess.run([sys.executable, WORKER, name, model, str(VIEWS)], stdout=subprocess.PIPE,
                         stderr=subprocess.PIPE, universal_newlines=True)
    assert run.returncode == 0, run.stderr[-3000:]
    rows = json.loads(run.stdout.splitlines()[-1])
    for row in rows:
        print("PEER", name, json.dumps(row))
    return rows


def assert_differences_are_explained(rows):
    keys = ("pixels", "flipped", "rounded", "unexplained")
    pixels, flipped, rounded, unexplained = (sum(row[key] for row in rows) for key in keys)
    counts = f"of {pixels} pixels {flipped} are flipped, {rounded} rounded, {unexplained} differ without a reason"
    print("PEER", counts)
    assert unexplained == 0 and flipped <= FLIPPED * pixels and rounded <= ROUNDED * pixels, counts


def assert_gradients(rows, names):
    for view, row in enumerate(rows):
        for name in names:
            assert row["gradients"][name] <= GRADIENT, f"view {view}, {name}: {row['gradients'][name]:.3g}"


def assert_renders_as_inria(rows):
    assert sum(row["radii_different"] for row in rows) <= max(1, RADII * sum(row["gaussians"] for row in rows))
    assert all(row["radii_largest"] <= 1 and row["visible"] > 100 for row in rows)
    assert_differences_are_explained(rows)


ALL = ("means3D", "means2D", "opacities", "shs", "scales", "rotations")


@pytest.mark.parametrize("name", ["inria", "dr_aa"])
def test_alpha_is_inrias(name, model):
    rows = compared(name, model)
    assert_renders_as_inria(rows)
    assert_gradients(rows, ALL)
    if name == "dr_aa":
        assert all(row["inverse_depth"] <= 1e-4 for row in rows)


def test_antialiasing_renders_as_inrias(model):
    rows = compared("dr_aa+antialiasing", model)
    assert_renders_as_inria(rows)
    assert_gradients(rows, ("opacities", "shs"))  # what the wrong derivative of the compensation does not reach


def test_smoe_is_colour_over_alpha_of_gsplat(model):
    rows = compared("gsplat", model)
    assert all(row["pixels"] > 0 for row in rows)
    assert_differences_are_explained(rows)
    assert_gradients(rows, [name for name in ALL if name != "means2D"])


def lone_subpixel_gaussian(device, dtype):
    """A white Gaussian of 0.3 pixels in the middle of a black image."""
    identity = torch.eye(4, dtype=dtype, device=device)
    projection = torch.zeros(4, 4, dtype=dtype, device=device)
    projection[0, 0] = projection[1, 1] = projection[2, 2] = projection[2, 3] = 1
    settings = GaussianRasterizationSettings(
        33, 33, 1.0, 1.0, torch.zeros(3, dtype=dtype, device=device), 1.0, identity, projection, 0,
        torch.zeros(3, dtype=dtype, device=device), antialiasing=True, blend_mode="alpha")
    scale = 0.3 * 2.0 / (33 / 2)  # pixels x depth / focal length
    inputs = dict(means3D=[[0.0, 0.0, 2.0]], means2D=[[0.0, 0.0, 0.0]], opacities=[[0.5]],
                  colors_precomp=[[1.0, 1.0, 1.0]], scales=[[scale] * 3], rotations=[[1.0, 0.0, 0.0, 0.0]])
    return Scene({name: torch.tensor(values, dtype=dtype, device=device) for name, values in inputs.items()}, settings)


def test_antialiasing_has_the_true_gradient_and_inrias_is_too_small(gpu):
    """The brightness of the image by the size of the Gaussian: finite differences, ours and Inria's."""
    folder = package("dr_aa")

    def brightness(scene, factor=1.0):
        scales = scene.inputs["scales"] * factor
        return rasterize(settings=scene.settings, **{**scene.inputs, "scales": scales}).color.sum()

    exact = lone_subpixel_gaussian("cpu", torch.float64)
    # Central differences of step h leave h^2 of the third derivative.
    true = ((brightness(exact, 1 + 1e-4) - brightness(exact, 1 - 1e-4)) / 2e-4).item()
    scene = lone_subpixel_gaussian(gpu, torch.float32)
    factor = torch.ones((), device=gpu, requires_grad=True)
    brightness(scene, factor).backward()
    assert factor.grad.item() == pytest.approx(true, rel=1e-4)

    code = f"""
import sys; sys.path[:0] = [{os.path.dirname(os.path.abspath(__file__))!r}, {folder!r}]
sys.path.append({os.path.dirname(os.path.dirname(os.path.abspath(__file__)))!r})
import torch, diff_gaussian_rasterization as peer
from test_cuda_peers import lone_subpixel_gaussian
scene = lone_subpixel_gaussian("cuda", torch.float32)
fields = {{name: getattr(scene.settings, name) for name in peer.GaussianRasterizationSettings._fields}}
factor = torch.ones((), device="cuda", requires_grad=True)
inputs = {{**scene.inputs, "scales": scene.inputs["scales"] * factor}}
peer.GaussianRasterizer(peer.GaussianRasterizationSettings(**fields))(**inputs)[0].sum().backward()
print(factor.grad.item())
"""
    run = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                         universal_newlines=True)
    assert run.returncode == 0, run.stderr[-3000:]
    theirs = float(run.stdout.splitlines()[-1])
    print("PEER dr_aa antialiasing gradient", theirs, "true", true)
    assert 0 < theirs < 0.9 * true
