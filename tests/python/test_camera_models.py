"""Cameras that are no pinholes: against the reference, against brute force through exact lenses, and refusals."""
from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from comparison import assert_all_close, assert_close
from lens_scenes import (
    FLOAT64_TOLERANCE,
    GRID,
    LENSES,
    assert_reference_in_float32,
    assert_reference_in_float64,
    exact_lens,
    lens_scene,
    moments,
    projected,
    shape_error,
)
from scenes import camera_settings, gradients, op_arguments, random_scene

from diff_smoe_rasterization import (
    GaussianRasterizer,
    blend_footprints,
    project_gaussians,
    rasterize,
    settings_from_camera,
)
from diff_smoe_rasterization.footprints import Footprints
from diff_smoe_rasterization.settings import BLEND_MODES, CAMERA_MODELS, OUTPUTS
from dsmoe.distributed.rows import ViewRows

pytestmark = pytest.mark.usefixtures("device")

every_lens = pytest.mark.parametrize("lens", LENSES)


@every_lens
@pytest.mark.parametrize("covariance", ["scales", "cov3D"])
@pytest.mark.parametrize("mode", BLEND_MODES)
def test_float64(mode, covariance, lens):
    found = assert_reference_in_float64(lens_scene(mode, lens, covariance))
    assert not found["projmatrix"].any(), "all of the pose is in viewmatrix"


@every_lens
@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_float32(mode, lens):
    assert_reference_in_float32(lens_scene(mode, lens, near=1.0))


def test_a_lens_without_distortion_is_the_pinhole():
    """Up to the epsilon that 3DGS adds to the clip w, 1e-7: also where the slopes of the Jacobian are clamped."""
    scene = random_scene("smoe", 200, degree=1)
    pinhole, expected = gradients(rasterize, scene, OUTPUTS)
    rendering, found = gradients(rasterize, scene.with_settings(camera_model="opencv"), OUTPUTS)
    assert torch.equal(rendering.radii, pinhole.radii)
    for name in ("color", *OUTPUTS):
        assert_close(getattr(rendering, name), getattr(pinhole, name), 1e-6, name)
    del found["viewmatrix"], found["projmatrix"], expected["viewmatrix"], expected["projmatrix"]
    assert_all_close(found, expected, 1e-6)


# The angle to the axis in degrees; of "equirectangular" along the horizon, and a latitude of 50 degrees.
PLACES = [("orthographic", (), 30.0), ("opencv", (-0.25, 0.06, 0.001, -0.002), 5.0),
          ("opencv", (-0.25, 0.06, 0.001, -0.002), 35.0), ("opencv", (0.08, 0.01, 0.001, 0.002), 30.0),
          ("fisheye", (0.02, -0.008, 0.002, -0.0003), 5.0), ("fisheye", (0.02, -0.008, 0.002, -0.0003), 40.0),
          ("fisheye", (0.02, -0.008, 0.002, -0.0003), 80.0), ("fisheye", (0.02, -0.008, 0.002, -0.0003), 95.0),
          ("thin_prism_fisheye", (0.02, -0.008, 0.001, 0.002, 0.002, -0.0003, 0.004, -0.003), 80.0),
          ("equirectangular", (), 120.0), ("equirectangular", (), -50.0)]


@pytest.mark.parametrize("model, distortion, angle", PLACES)
def test_footprints_are_those_of_brute_force(model, distortion, angle):
    """Moments of Gaussians through the exact lens, by 9 x 9 x 9 nodes of Gauss and Hermite, at a focal length of 300.

    Gaussians 4:2:1 with the short axis along the ray. Where sigma is below 12 px the centre is within 2.5 % of sigma
    and the covariance within 1 %; below 40 px 7 % and 5 %, what the affine approximation of a pinhole leaves too.
    """
    focal, count = 300.0, 24
    generator = np.random.default_rng(5)
    turn = math.radians(abs(angle))
    side = generator.uniform(0, 2 * math.pi, count)
    if model == "equirectangular":
        side = np.full(count, 0.0 if angle > 0 else -0.5 * math.pi)
    ray = np.stack([math.sin(turn) * np.cos(side), math.sin(turn) * np.sin(side), np.full(count, math.cos(turn))], 1)
    depth = generator.uniform(3, 6, count)[:, None]
    means = depth * ray
    across = np.cross(ray, generator.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    longest = np.geomspace(2, 38, count)[:, None] / focal * (1.0 if model == "orthographic" else depth)
    axes = longest[:, :, None] * np.stack([across, 0.5 * np.cross(ray, across), 0.25 * ray], 2)

    size = 4000
    K = None if model == "equirectangular" else [[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]
    width, height = (round(2 * math.pi * focal), round(math.pi * focal)) if K is None else (size, size)
    settings = settings_from_camera(K, torch.eye(3), torch.zeros(3), width, height, dtype=torch.float64,
                                    camera_model=model, distortion=distortion, low_pass=0.0,
                                    bg=torch.zeros(1, dtype=torch.float64))

    centres, covariances = projected(means, axes, settings)
    centres = centres + 0.5 - np.array([width, height]) / 2
    scale = np.array([width / (2 * math.pi), height / math.pi]) if K is None else focal
    sigmas = []
    for i in range(count):
        mean, covariance, sigma = moments(exact_lens(model, distortion, means[i] + GRID @ axes[i].T, scale))
        off_centre, off_shape = np.linalg.norm(mean - centres[i]) / sigma, shape_error(covariances[i], covariance)
        most = (0.025, 0.01) if sigma < 12 else (0.07, 0.05)
        assert sigma > 40 or (off_centre < most[0] and off_shape < most[1]), (sigma, off_centre, off_shape)
        sigmas.append(sigma)
    assert min(sigmas) < 6 and max(sigmas) > 20


@pytest.mark.parametrize("model, distortion, angle", [("opencv", (-0.3,), 55.0), ("fisheye", (-0.2,), 80.0),
                                                      ("fisheye", (), 176.0)])
def test_beyond_its_range_a_lens_sees_nothing(model, distortion, angle):
    """r (1 - 0.3 r^2) rises to r = 1.05, theta (1 - 0.2 theta^2) to 74 degrees. Folded back, they would be seen."""
    settings = settings_from_camera([[20, 0, 30], [0, 20, 30], [0, 0, 1]], torch.eye(3), torch.zeros(3), 60, 60,
                                    camera_model=model, distortion=distortion)
    turn = math.radians(angle)
    means3D = torch.tensor([[math.sin(turn), 0.0, math.cos(turn)], [0.1, 0.1, 1.0]], requires_grad=True)
    rendering = rasterize(means3D, torch.full((2,), 0.9), settings, scales=torch.full((2, 3), 0.05),
                          rotations=torch.tensor([[1.0, 0, 0, 0]] * 2), colors_precomp=torch.ones(2, 3))
    assert rendering.radii[0] == 0 and rendering.radii[1] > 0
    rendering.color.sum().backward()
    assert not means3D.grad[0].any() and means3D.grad[1].any()


def test_a_fisheye_sees_beside_and_behind_itself():
    """Depths are distances: 2 on the right and 2.5 at 120 degrees, behind the camera."""
    settings = settings_from_camera([[20, 0, 50], [0, 20, 50], [0, 0, 1]], torch.eye(3), torch.zeros(3), 100, 100,
                                    camera_model="fisheye")
    turn = math.radians(120)
    means3D = torch.tensor([[2.0, 0, 0], [0, 2.5 * math.sin(turn), 2.5 * math.cos(turn)], [0, 0, -2.0]])
    prints = project_gaussians(means3D, torch.full((3,), 0.9), settings, scales=torch.full((3, 3), 0.05),
                               rotations=torch.tensor([[1.0, 0, 0, 0]] * 3), colors_precomp=torch.ones(3, 3))
    assert (prints.radii > 0).tolist() == [True, True, False]
    expected = torch.tensor([[49.5 + 20 * math.pi / 2, 49.5], [49.5, 49.5 + 20 * turn]])
    assert torch.allclose(prints.means2D[:2], expected, atol=1e-4)
    assert torch.allclose(prints.depths[:2], torch.tensor([2.0, 2.5]))
    assert GaussianRasterizer(settings).markVisible(means3D).all()
    near = settings._replace(near=2.2)
    assert GaussianRasterizer(near).markVisible(means3D).tolist() == [False, True, False]


@every_lens
def test_both_halves_of_a_rendering(lens):
    scene = lens_scene("smoe", lens).to(torch.float32)

    def in_halves(*, settings, outputs=(), **inputs):
        return blend_footprints(project_gaussians(settings=settings, outputs=outputs, **inputs), settings, outputs)

    expected, whole = gradients(rasterize, scene, OUTPUTS)
    rendering, halves = gradients(in_halves, scene, OUTPUTS)
    assert torch.equal(rendering.color, expected.color) and torch.equal(rendering.radii, expected.radii)
    assert_all_close(halves, whole, 1e-5)  # sums over tiles are rounded once more


@pytest.mark.parametrize("mode", BLEND_MODES)
def test_footprints_across_the_seam_are_drawn_on_both_sides(mode):
    """As if the camera looked elsewhere: a turn of 180 degrees moves the image by half its width."""
    width, height = 64, 32
    scene = lens_scene(mode, "equirectangular")
    turned = scene.settings.viewmatrix.clone()
    turned[:, (0, 2)] *= -1
    images = []
    for view in (scene.settings.viewmatrix, turned):
        settings = scene.settings._replace(viewmatrix=view, image_width=width, image_height=height)
        prints = project_gaussians(settings=settings, **scene.inputs)
        whole = prints.around(width)
        assert len(whole.radii) > len(prints.radii) == len(scene.inputs["means3D"])
        images.append([blend_footprints(each, settings).color for each in (whole, prints)])
    assert_close(images[1][0].roll(width // 2, 2), images[0][0], FLOAT64_TOLERANCE, "color")
    assert (images[1][1].roll(width // 2, 2) - images[0][1]).abs().max() > 0.05, "a seam without the copies"
    with pytest.raises(ValueError, match="around: width is 0; it must be that of the equirectangular image"):
        prints.around(0)


def test_copies_are_those_of_which_a_pixel_beyond_the_seam_can_see_something():
    """Sigma is 3 pixels, so the radius 9. The faintest tail is 2^-35: of opacity 0.5 it is 6.86 sigmas away."""
    rows = [(25, 1e-10, 100.0), (31, 1e-10, 100.0), (8, 1e-10, 1.0), (9.5, 1e-10, 1.0), (20, 0.5, 1.0), (21, 0.5, 1.0)]
    gates = torch.tensor([[column, 5, 1 / 9, 0, 1 / 9, opacity, reach, 1] for column, opacity, reach in rows]).double()
    ones = torch.ones(len(rows), 1).double()
    for side, columns in enumerate((gates[:, 0], 999 - gates[:, 0])):
        mirrored = torch.cat([columns[:, None], gates[:, 1:]], 1)
        copied = Footprints(mirrored, ones, torch.full((len(rows),), 9, dtype=torch.int32)).copied(1000)
        assert copied[side].tolist() == [0, 2, 4] and not len(copied[1 - side])


@pytest.mark.parametrize("turn", [5, 31])
def test_footprints_as_wide_as_a_panorama_have_no_seam(turn):
    """A reach of 62 of 64 columns, all around and back; a reach of ten panoramas has one copy on each side too."""
    width, height = 64, 32
    settings = settings_from_camera(None, torch.eye(3), torch.zeros(3), width, height, camera_model="equirectangular",
                                    blend_mode="smoe_eq7")
    gates = torch.tensor([[9.25, 16, 1 / 169, 0, 1 / 9, 0.5, 23, 1], [50, 9, 1 / 64, 0, 1 / 16, 0.6, 23, 2]]).double()
    prints = Footprints(gates, torch.eye(2, 3).double(), torch.tensor([39, 24], dtype=torch.int32))
    turned = prints._replace(gates=gates.clone())
    turned.gates[:, 0] = (gates[:, 0] + turn) % width
    images = [blend_footprints(each.around(width), settings._replace(bg=settings.bg.double())).color
              for each in (prints, turned)]
    assert_close(images[1], images[0].roll(turn, 2), FLOAT64_TOLERANCE, "color")
    wide = prints._replace(radii=prints.radii * 10)
    assert [index.tolist() for index in wide.copied(width)] == [[0, 1], [0, 1]]


def test_a_batch_takes_views_of_different_models():
    scene = lens_scene("smoe", "fisheye").to(torch.float32)
    views = [scene.settings] + [scene.settings._replace(**{"distortion": (), "principal_point": None, **lens})
                                for lens in (dict(camera_model="pinhole"), LENSES["opencv"])]
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "means2D"}
    rows = ViewRows(views, **inputs)
    rows.project(rows.counts.tolist(), range(len(views)))
    for settings, radii in zip(views, rows.radii):
        expected = rasterize(settings=settings, **inputs).radii
        assert (expected > 0).any() and torch.equal(radii, expected)


def test_opcheck():
    scene = lens_scene("smoe", "fisheye").to(torch.float32).requiring_grad()
    if not hasattr(torch.library, "opcheck"):
        pytest.skip("torch before 2.4 has no opcheck")
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.project.default, op_arguments(scene, "project"),
                          test_utils=("test_schema", "test_faketensor"))


FISHEYE = dict(camera_model="fisheye")


@pytest.mark.parametrize("fields, message", [
    (dict(camera_model="fish"), f"camera_model is 'fish'; it must be one of {', '.join(CAMERA_MODELS)}"),
    (dict(distortion=(0.1,)), r"distortion is \(0.1,\), but camera_model is 'pinhole'; name the lens that has it"),
    (dict(principal_point=(3.0, 4.0)), "principal_point is .*'pinhole'; its principal point is in projmatrix"),
    (dict(distortion=(0.1, 0.2, 0.3), **FISHEYE), "distortion has 3 numbers; it must have 0, 1, 2 or 4: k1 k2 k3 k4"),
    (dict(distortion=(0.1, math.nan), **FISHEYE), r"distortion\[1\] is nan; it must be finite"),
    (dict(distortion=None, **FISHEYE), "distortion is None; it must be a sequence of numbers"),
    (dict(distortion=0.1, **FISHEYE), "distortion is 0.1; it must be a sequence of numbers"),
    (dict(distortion="12", **FISHEYE), "distortion is '12'; it must be a sequence of numbers"),
    (dict(distortion=torch.ones(2, requires_grad=True), **FISHEYE), "distortion requires a gradient, .* detach it"),
    (dict(distortion=("a",), **FISHEYE), r"distortion is \('a',\); it must be a sequence of numbers"),
    (dict(principal_point=(3.0,), **FISHEYE), r"principal_point is \(3.0,\); it must be two numbers"),
    (dict(principal_point=(3.0, math.inf), **FISHEYE), "principal_point is 3, inf; it must be finite"),
    (dict(distortion=(-1e7,), **FISHEYE), "distortion folds the image back at .* pixels from the principal point"),
    (dict(distortion=(0.1,), camera_model="equirectangular"), "distortion has 1 numbers; it must have 0")])
def test_bad_lenses_are_named(fields, message):
    scene = random_scene("smoe", 20, 20, 18, dtype=torch.float32)
    with pytest.raises(ValueError, match=message):
        rasterize(settings=scene.settings._replace(**fields), **scene.inputs)


def test_settings_from_camera_of_a_lens():
    K, R, t = [[30, 0, 21], [0, 33, 14], [0, 0, 1]], torch.eye(3), torch.tensor([0.0, 0, 4])
    settings = settings_from_camera(K, R, t, 40, 30, camera_model="fisheye", distortion=[0.1, 0.01])
    assert settings.principal_point == (21, 14) and settings.distortion == (0.1, 0.01)
    assert 40 / (2 * settings.tanfovx) == pytest.approx(30) and 30 / (2 * settings.tanfovy) == pytest.approx(33)
    around = settings_from_camera(None, R, t, 40, 30, camera_model="equirectangular")
    assert around.camera_model == "equirectangular"
    with pytest.raises(ValueError, match="K is given; an equirectangular camera has none"):
        settings_from_camera(K, R, t, 40, 30, camera_model="equirectangular")
    with pytest.raises(ValueError, match="camera_model is 'kannala'; it must be one of"):
        settings_from_camera(K, R, t, 40, 30, camera_model="kannala")
    with pytest.raises(ValueError, match="K is None; only an equirectangular camera has none"):
        settings_from_camera(None, R, t, 40, 30, camera_model="fisheye")
    with pytest.raises(ValueError, match="distortion is None; it must be a sequence of numbers"):
        settings_from_camera(K, R, t, 40, 30, camera_model="fisheye", distortion=None)
    with pytest.raises(ValueError, match="K requires a gradient, but a lens has none; detach it"):
        settings_from_camera(torch.eye(3).requires_grad_(), R, t, 40, 30, camera_model="fisheye")
    for numbers in (torch.tensor([0.5, 0.25]), np.array([0.5, 0.25])):
        settings = settings_from_camera(K, R, t, 40, 30, camera_model="fisheye", distortion=numbers)
        assert settings.distortion == (0.5, 0.25)
    assert camera_settings(40, 30).camera_model == "pinhole"
