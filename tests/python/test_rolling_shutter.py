"""Rolling shutters: against the reference, against brute force row by row, and refusals."""
from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from comparison import assert_all_close, assert_close
from devices import on_the_cpu
from lens_scenes import (
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
from scenes import Scene, gradients, op_arguments, random_scene, turned

from diff_smoe_rasterization import (
    GaussianRasterizer,
    blend_footprints,
    project_gaussians,
    rasterize,
    reference,
    settings_from_camera,
    visible_radii,
)
from diff_smoe_rasterization.settings import BLEND_MODES, OUTPUTS, ROLLING_SHUTTERS
from dsmoe.distributed.rows import ViewRows

pytestmark = pytest.mark.usefixtures("device")

MODELS = ("pinhole", *LENSES)
EVERY_LENS = [(model, ROLLING_SHUTTERS[1 + k % 4]) for k, model in enumerate(MODELS)]
"""Every model with one of the shutters."""


def rolling_scene(mode, model, shutter, covariance="scales", **options):
    """The scene of lens_scenes.py, through which the camera turns and moves by 2 to 5 pixels."""
    if model == "pinhole":
        scene = random_scene(mode, 70, 40, 30, covariance=covariance, degree=1)
        scene = scene.with_settings(principal_point=(21.0, 14.5), **options)
    else:
        scene = lens_scene(mode, model, covariance, **options)
    end = turned(scene.settings.viewmatrix, (0.04, -0.05, 0.08), (0.1, 0.12, -0.07))
    return scene.with_settings(rolling_shutter=shutter, viewmatrix_end=end)


@pytest.mark.parametrize("model, shutter", EVERY_LENS)
@pytest.mark.parametrize("mode, covariance", [*zip(BLEND_MODES, ["scales", "cov3D"] * 3), ("smoe", "scales")])
def test_float64(mode, covariance, model, shutter):
    # Newton's last step leaves less than 1e-11 of a time, and derivatives are those of none.
    found = assert_reference_in_float64(rolling_scene(mode, model, shutter, covariance), gradient_tolerance=1e-10)
    assert found["viewmatrix_end"].any()


@pytest.mark.parametrize("model, shutter", EVERY_LENS)
def test_float32(model, shutter):
    assert_reference_in_float32(rolling_scene("smoe", model, shutter, near=1.0))


@pytest.mark.parametrize("shutter", ROLLING_SHUTTERS[1:])
def test_a_camera_that_stands_still_has_the_image_of_a_global_shutter(shutter):
    scene = rolling_scene("smoe", "fisheye", shutter)
    still = scene.with_settings(viewmatrix_end=scene.settings.viewmatrix.clone())
    rendering, found = gradients(rasterize, still, OUTPUTS)
    expected, wanted = gradients(rasterize, scene.with_settings(rolling_shutter="global", viewmatrix_end=None), OUTPUTS)
    assert torch.equal(rendering.radii, expected.radii)
    for name in ("color", *OUTPUTS):
        assert_close(getattr(rendering, name), getattr(expected, name), 1e-13, name)
    end = found.pop("viewmatrix_end")
    found["viewmatrix"] += end
    assert_all_close(found, wanted, 1e-12)


@pytest.mark.parametrize("model, distortion", [("opencv", (-0.25, 0.06, 0.001, -0.002)),
                                               ("fisheye", (0.02, -0.008, 0.002, -0.0003))])
@pytest.mark.parametrize("shutter", ROLLING_SHUTTERS[1:])
def test_footprints_are_those_of_brute_force(model, distortion, shutter):
    """Moments of Gaussians of which each point is seen by the pose of its own row, as in test_camera_models.py.

    The camera moves by up to 60 of 400 pixels. Without the stretch covariances are off by 5 % and more.
    """
    focal, size, count = 300.0, 400, 24
    generator = np.random.default_rng(6)
    pixels = generator.uniform(0.15, 0.85, (count, 2)) * size
    depth = generator.uniform(3, 6, (count, 1))
    means = np.concatenate([(pixels - size / 2) / focal * depth, depth], 1)
    across = np.cross(means, generator.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    ray = means / np.linalg.norm(means, axis=1, keepdims=True)
    axes = (np.geomspace(2, 11, count)[:, None] / focal * depth)[:, :, None] * np.stack(
        [across, 0.5 * np.cross(ray, across), 0.25 * ray], 2)

    first = torch.eye(4, dtype=torch.float64, device=torch.zeros(0).device)
    last = turned(first, (0.08, -0.1, 0.1), (0.1, 0.15, -0.2))
    settings = settings_from_camera(
        [[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], torch.eye(3), torch.zeros(3), size, size,
        bg=first.new_zeros(1), camera_model=model, distortion=distortion, rolling_shutter=shutter,
        end=(last[:3, :3].T, last[3, :3]), low_pass=0.0)
    centres, covariances = projected(means, axes, settings)

    def seen(points):
        """Pixels of points, each by the pose of the row where it is then found."""
        start, end = points, points @ last[:3, :3].cpu().numpy() + last[3, :3].cpu().numpy()
        axis, back = (0 if "left" in shutter else 1), shutter in ("bottom_to_top", "right_to_left")
        time = np.full(len(points), 0.5)
        for _ in range(60):
            at = exact_lens(model, distortion, start + time[:, None] * (end - start), focal) + size / 2 - 0.5
            time = at[:, axis] / (size - 1)
            time = 1 - time if back else time
        return at, time

    errors, still_errors = [], []
    _, times = seen(means)
    for i in range(count):
        mean, covariance, sigma = moments(seen(means[i] + GRID @ axes[i].T)[0])
        assert np.linalg.norm(mean - centres[i]) < 0.025 * sigma
        errors.append(shape_error(covariances[i], covariance))
        still = settings._replace(viewmatrix=first + float(times[i]) * (last - first), rolling_shutter="global",
                                  viewmatrix_end=None)
        still_errors.append(shape_error(projected(means[i:i + 1], axes[i:i + 1], still)[1][0], covariance))
    assert max(errors) < 0.01
    assert np.median(still_errors) > 0.05


@pytest.mark.parametrize("shutter, seen", [("left_to_right", False), ("right_to_left", True)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_point_that_crosses_the_seam_against_the_shutter_is_never_seen(shutter, seen, dtype):
    """The camera turns by 0.2, and a point goes at t = 0.25 from column 62.99 to the left border, to 1.03 at t = 1.

    From left to right the last column is read at t = 1 and the first at t = 0; the point then is at the other side.
    """
    scene = rolling_scene("smoe", "equirectangular", shutter).to(dtype)
    view = torch.eye(4).to(scene.settings.viewmatrix)
    settings = scene.settings._replace(image_width=64, image_height=32, viewmatrix=view, campos=torch.zeros_like(
        scene.settings.campos), viewmatrix_end=turned(view, (0, 0.2, 0), (0, 0, 0)))
    longitude = math.pi - 0.05
    inputs = {name: tensor[:1] for name, tensor in scene.inputs.items()}
    inputs["means3D"] = 2 * view.new_tensor([[math.sin(longitude), 0, math.cos(longitude)]])
    inputs["scales"] = torch.full_like(inputs["scales"], 0.05)
    assert (rasterize(settings=settings, **inputs).radii > 0).tolist() == [seen]
    with on_the_cpu():
        on_cpu = Scene(inputs, settings).to("cpu")
        assert (reference.rasterize(settings=on_cpu.settings, **on_cpu.inputs).radii > 0).tolist() == [seen]


def test_both_halves_of_a_rendering():
    scene = rolling_scene("smoe", "opencv", "top_to_bottom").to(torch.float32)

    def in_halves(*, settings, outputs=(), **inputs):
        return blend_footprints(project_gaussians(settings=settings, outputs=outputs, **inputs), settings, outputs)

    expected, whole = gradients(rasterize, scene, OUTPUTS)
    rendering, halves = gradients(in_halves, scene, OUTPUTS)
    assert torch.equal(rendering.color, expected.color) and torch.equal(rendering.radii, expected.radii)
    assert_all_close(halves, whole, 1e-5)  # sums over tiles are rounded once more
    shape = {name: scene.inputs[name] for name in ("scales", "rotations")}
    assert torch.equal(visible_radii(scene.inputs["means3D"], scene.settings, **shape), expected.radii)


def test_a_batch_takes_views_of_which_some_roll():
    scene = rolling_scene("smoe", "fisheye", "right_to_left").to(torch.float32)
    plain = scene.settings._replace(rolling_shutter="global", viewmatrix_end=None)
    views = [plain, scene.settings, plain._replace(camera_model="pinhole", distortion=(), principal_point=None)]
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "means2D"}
    rows = ViewRows(views, **inputs)
    gates, _ = rows.project(rows.counts.tolist(), range(len(views)))
    starts = [0, *rows.counts.cumsum(0).tolist()]
    for k, (settings, radii) in enumerate(zip(views, rows.radii)):
        prints = project_gaussians(settings=settings, **inputs)
        assert (prints.radii > 0).any() and torch.equal(radii, prints.radii)
        assert_close(gates[starts[k]:starts[k + 1]], prints.gates[prints.radii > 0], 1e-6, "gates")


def test_mark_visible_looks_from_both_poses():
    settings = rolling_scene("smoe", "pinhole", "top_to_bottom").settings
    view = torch.eye(4).to(settings.viewmatrix)
    end = view.clone()
    end[3, 2] = 2.0
    settings = settings._replace(viewmatrix=view, viewmatrix_end=end, near=0.2)
    points = view.new_tensor([[0, 0, 1.0], [0, 0, -1.0], [0, 0, -2.0]])
    assert GaussianRasterizer(settings).markVisible(points).tolist() == [True, True, False]
    still = settings._replace(rolling_shutter="global", viewmatrix_end=None, principal_point=None)
    assert GaussianRasterizer(still).markVisible(points).tolist() == [True, False, False]


def test_opcheck():
    scene = rolling_scene("smoe", "fisheye", "top_to_bottom").to(torch.float32).requiring_grad()
    if not hasattr(torch.library, "opcheck"):
        pytest.skip("torch before 2.4 has no opcheck")
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.rasterize.default, op_arguments(scene),
                          test_utils=("test_schema", "test_faketensor"))


def test_settings_from_camera_of_a_rolling_shutter():
    K, R, t = [[30, 0, 21], [0, 33, 14], [0, 0, 1]], torch.eye(3), torch.tensor([0.0, 0, 4], requires_grad=True)
    end = (torch.diag(torch.tensor([-1.0, 1, -1])), torch.tensor([0.0, 2, 4], requires_grad=True))
    settings = settings_from_camera(K, R, t, 40, 30, rolling_shutter="top_to_bottom", end=end)
    assert settings.principal_point == (21, 14) and settings.camera_model == "pinhole"
    expected = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    expected[3, :3] = torch.tensor([0.0, 2, 4])
    assert torch.equal(settings.viewmatrix_end, expected)
    assert settings.campos.tolist() == [0, -1, 0]  # between (0, 0, -4) and (0, -2, 4)
    settings.viewmatrix_end.sum().backward()
    assert end[1].grad is not None and t.grad is None
    with pytest.raises(ValueError, match="end: R is .*; it must be a rotation"):
        settings_from_camera(K, R, t, 40, 30, rolling_shutter="top_to_bottom", end=(2 * R, t))
    with pytest.raises(ValueError, match=r"end is of type Tensor, shape \[3, 3\]; it must be a tuple of two, R .* t"):
        settings_from_camera(K, R, t, 40, 30, rolling_shutter="top_to_bottom", end=R)
    with pytest.raises(ValueError, match="viewmatrix_end is None, but rolling_shutter is 'left_to_right'; it must be"):
        settings_from_camera(K, R, t, 40, 30, rolling_shutter="left_to_right")


@pytest.mark.parametrize("fields, error, message", [
    (dict(rolling_shutter="sideways"), ValueError,
     f"rolling_shutter is 'sideways'; it must be one of {', '.join(ROLLING_SHUTTERS)}"),
    (dict(rolling_shutter="global"), ValueError,
     "viewmatrix_end is given, but rolling_shutter is 'global'; it must be None"),
    (dict(viewmatrix_end=None), ValueError,
     "viewmatrix_end is None, but rolling_shutter is 'top_to_bottom'; it must be the pose at the last row or column"),
    (dict(viewmatrix_end=torch.eye(3, device="cpu")), ValueError, r"viewmatrix_end has shape \[3, 3\]"),
    (dict(principal_point=None), ValueError,
     "principal_point is None, but rolling_shutter is 'top_to_bottom', with which projmatrix is not read; it must be "
     "given"),
    (dict(distortion=(0.1,)), ValueError, r"distortion is \(0.1,\), but camera_model is 'pinhole'")])
def test_bad_shutters_are_named(fields, error, message):
    scene = rolling_scene("smoe", "pinhole", "top_to_bottom").to(torch.float32)
    if isinstance(fields.get("viewmatrix_end"), torch.Tensor):
        fields = {"viewmatrix_end": fields["viewmatrix_end"].to(scene.settings.bg)}
    with pytest.raises(error, match=message):
        rasterize(settings=scene.settings._replace(**fields), **scene.inputs)


def test_a_pose_that_is_not_finite_is_named():
    scene = rolling_scene("smoe", "pinhole", "top_to_bottom").to(torch.float32)
    if scene.settings.bg.is_cuda:
        pytest.skip("numbers in device memory are not checked")
    end = scene.settings.viewmatrix_end.clone()
    end[1, 2] = math.nan
    with pytest.raises(ValueError, match=r"camera.view_end \(viewmatrix_end\)\[6\] is nan; it must be finite"):
        rasterize(settings=scene.settings._replace(viewmatrix_end=end), **scene.inputs)
    with pytest.raises(ValueError, match=r"camera.view_end \(viewmatrix_end\)\[6\] is nan; it must be finite"):
        GaussianRasterizer(scene.settings._replace(viewmatrix_end=end)).markVisible(scene.inputs["means3D"])
