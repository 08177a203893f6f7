"""Scenes through lenses, the lenses by their definitions, and how a lens is compared with the reference."""
from __future__ import annotations

import math

import numpy as np
import torch
from comparison import assert_all_close, assert_close, one_thread, reference_gradients, threshold_margin
from devices import on_the_cpu, random_normal
from scenes import assert_not_empty, gradients, random_scene

from diff_smoe_rasterization import project_gaussians, rasterize, reference
from diff_smoe_rasterization.settings import OUTPUTS

OF_OPENCV = (-0.2, 0.05, 0.01, -0.02, 0.03, 0.01, 0.02, -0.01, 0.01, -0.005, 0.004, 0.003)
LENSES = {
    "orthographic": dict(camera_model="orthographic", tanfovx=2.0, tanfovy=1.5, principal_point=(26.0, 17.5)),
    "opencv": dict(camera_model="opencv", distortion=OF_OPENCV, principal_point=(26.0, 17.5)),
    "fisheye": dict(camera_model="fisheye", distortion=(0.02, -0.01, 0.003, -0.0002), tanfovx=1.25, tanfovy=0.875),
    "thin_prism_fisheye": dict(camera_model="thin_prism_fisheye", tanfovx=1.25, tanfovy=0.875,
                               distortion=(0.02, -0.01, 0.003, -0.002, 0.01, 0.001, 0.02, -0.01)),
    "equirectangular": dict(camera_model="equirectangular"),
}
"""Fields of the settings, one of every model."""
FLOAT64_TOLERANCE = 1e-12  # as in test_against_reference.py, for the same reasons, as is the next
FLOAT32_MARGIN = 1e-3


def lens_scene(mode, lens, covariance="scales", **options):
    """A scene, around the camera if its lens sees around. Two Gaussians are on its axis, where a series begins."""
    position = (0.4, -0.3, -4.0) if lens in ("orthographic", "opencv") else (0.4, -0.3, -1.5)
    scene = random_scene(mode, 70, 40, 30, covariance=covariance, degree=1, position=position)
    means3D = scene.inputs["means3D"].clone()
    for row, share in enumerate((0.5, 1.2)):
        means3D[-1 - row] = scene.settings.campos * (1 - share)
    return scene.with_inputs(means3D=means3D).with_settings(**{"near": 0.5, **options, **LENSES[lens]})


def assert_reference_in_float64(scene, gradient_tolerance=FLOAT64_TOLERANCE):
    """Images and gradients by the scene are those of the reference. Returns the gradients."""
    scene = scene.with_settings(antialiasing=True)
    expected, expected_gradients = reference_gradients(scene, OUTPUTS)
    assert_not_empty(expected, scene.to("cpu").settings)
    rendering, found = gradients(rasterize, scene, OUTPUTS)
    assert torch.equal(rendering.radii.cpu(), expected.radii)
    for name in ("color", *OUTPUTS):
        assert_close(getattr(rendering, name), getattr(expected, name), FLOAT64_TOLERANCE, name)
    assert_all_close(found, expected_gradients, gradient_tolerance)
    return found


def assert_reference_in_float32(scene):
    """Likewise on the same numbers, but for pixels near a threshold. The scene is 40x30."""
    safe = threshold_margin(scene) > FLOAT32_MARGIN
    assert safe.double().mean() > 0.8
    weights = random_normal((3, 30, 40), 1).cpu() * safe

    def masked(function, scene):
        scene = scene.requiring_grad()
        color = function(settings=scene.settings, **scene.inputs).color
        leaves = scene.leaves()
        values = torch.autograd.grad(color, list(leaves.values()), weights.to(color), allow_unused=True)
        return color.detach().cpu(), {name: torch.zeros_like(leaf).cpu() if value is None else value.cpu()
                                      for (name, leaf), value in zip(leaves.items(), values)}

    with one_thread(), on_the_cpu():
        expected, expected_gradients = masked(reference.rasterize, scene.to("cpu"))
    color, found = masked(rasterize, scene.to(torch.float32))
    assert_close(color[:, safe], expected[:, safe], 1e-5, "color")
    assert_all_close(found, expected_gradients, 1e-4)  # as in test_against_reference.py


def exact_lens(model, distortion, view, focal):
    """Pixels of points in view space [n, 3] before the principal point, by numpy and from the models' definitions."""
    x, y, z = view.T
    k = list(distortion)
    if model == "orthographic":
        u, v = x, y
    elif model == "opencv":
        k1, k2, p1, p2 = k
        a, b = x / z, y / z
        r2 = a * a + b * b
        scale = 1 + k1 * r2 + k2 * r2 * r2
        u = a * scale + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        v = b * scale + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    elif model == "equirectangular":
        u, v = np.arctan2(x, z), np.arcsin(y / np.sqrt(x * x + y * y + z * z))
    else:
        rho = np.hypot(x, y)
        theta = np.arccos(z / np.sqrt(x * x + y * y + z * z))
        u, v = theta * x / rho, theta * y / rho
        k1, k2, p1, p2, k3, k4, sx1, sy1 = k if model == "thin_prism_fisheye" else [*k[:2], 0, 0, *k[2:], 0, 0]
        r2 = theta * theta
        scale = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
        u, v = (u * scale + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + sx1 * r2,
                v * scale + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + sy1 * r2)
    return np.stack([u, v], 1) * focal


def projected(means, axes, settings):
    """Centres [n, 2] in pixel indices and covariances [n, 2, 2] of Gaussians, all seen. axes: [n, 3, 3] in columns."""
    def tensor(array):
        return torch.as_tensor(array, dtype=torch.float64, device=settings.bg.device)

    full = (axes @ axes.transpose(0, 2, 1))[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
    prints = project_gaussians(tensor(means), tensor(np.full(len(means), 0.5)), settings, cov3D_precomp=tensor(full),
                               colors_precomp=tensor(np.ones((len(means), 1))))
    assert (prints.radii > 0).all()
    xx, xy, yy = prints.conics.cpu().numpy().T
    return prints.means2D.cpu().numpy(), np.linalg.inv(np.stack([xx, xy, xy, yy], 1).reshape(-1, 2, 2))


NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(9)
GRID = np.stack(np.meshgrid(NODES, NODES, NODES), -1).reshape(-1, 3)
"""[729, 3] points of the unit Gaussian, by Gauss and Hermite."""
WEIGHT = np.prod(np.meshgrid(WEIGHTS, WEIGHTS, WEIGHTS), 0).reshape(-1) / (2 * math.pi) ** 1.5
"""[729] their weights."""


def moments(points):
    """Mean [2], covariance [2, 2] and largest sigma of the image of a Gaussian. points: [729, 2] those of GRID."""
    mean = WEIGHT @ points
    covariance = (points - mean).T @ ((points - mean) * WEIGHT[:, None])
    return mean, covariance, math.sqrt(np.linalg.eigvalsh(covariance)[-1])


def shape_error(covariance, exact):
    return np.linalg.norm(exact - covariance) / np.linalg.norm(exact)
