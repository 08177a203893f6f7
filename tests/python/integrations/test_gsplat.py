"""The call of gsplat: what it renders, with which gradients, and what it refuses; against the reference."""
from __future__ import annotations

import inspect
import math
from types import SimpleNamespace

import pytest
import torch
from comparison import assert_all_close, assert_close, one_thread, threshold_margin
from devices import on_the_cpu, random_normal
from scenes import camera_settings, random_scene, with_gates

from diff_smoe_rasterization import project_gaussians, rasterize, reference
from diff_smoe_rasterization.integrations.gsplat import (
    compute_relocation,
    quat_scale_to_covar_preci,
    rasterization,
)
from diff_smoe_rasterization.settings import BLEND_MODES

pytestmark = pytest.mark.usefixtures("device")

WIDTH, HEIGHT = 45, 30
POSITIONS = ((0.4, -0.3, -4.0), (-1.5, 0.6, -3.0))
PRINCIPAL_POINTS = ((0.0, 0.0), (2.5, -1.5))  # px off the image centre
FIELDS_OF_VIEW = (0.9, 1.1)
# A sum of some thousand terms in float64, each with some hundred roundings of 1e-16; the two sides build their camera
# matrices in different ways, which differ by as much.
TOLERANCE = 1e-11


def make_cameras(mode, channels, degree=0, **fields):
    """Two cameras as settings, in float64; the background of each is its own."""
    return [camera_settings(WIDTH, HEIGHT, position, fov, principal_point, degree, blend_mode=mode, near=0.01,
                            bg=random_normal((channels,), 31 + index).sigmoid(), **fields)
            for index, (position, fov, principal_point)
            in enumerate(zip(POSITIONS, FIELDS_OF_VIEW, PRINCIPAL_POINTS))]


def arguments_of(scene, cameras):
    """The same for `rasterization`; the quaternions are not of length 1."""
    Ks = [[[c.image_width / (2 * c.tanfovx), 0, WIDTH / 2 + x], [0, c.image_height / (2 * c.tanfovy), HEIGHT / 2 + y],
           [0, 0, 1]] for c, (x, y) in zip(cameras, PRINCIPAL_POINTS)]
    inputs = scene.inputs
    colors = inputs["shs"] if "shs" in inputs else inputs["colors_precomp"]
    return {"means": inputs["means3D"], "quats": 2 * inputs["rotations"], "scales": inputs["scales"],
            "opacities": inputs["opacities"][:, 0], "colors": colors,
            "viewmats": torch.stack([c.viewmatrix.T for c in cameras]).contiguous(),
            "Ks": torch.tensor(Ks, dtype=torch.float64), "width": WIDTH, "height": HEIGHT,
            "backgrounds": torch.stack([c.bg for c in cameras])}


def reference_renderings(inputs, cameras, outputs=("alpha", "depth")):
    with one_thread(), on_the_cpu():
        inputs = {name: tensor.cpu() for name, tensor in inputs.items()}
        rotations = inputs["rotations"]
        inputs["rotations"] = rotations / rotations.norm(dim=1, keepdim=True)
        return [reference.rasterize(settings=c._replace(**{
            name: getattr(c, name).cpu() for name in ("bg", "viewmatrix", "projmatrix", "campos", "viewmatrix_end")
            if getattr(c, name) is not None}), outputs=outputs, **inputs) for c in cameras]


def shares(inputs, cameras):
    """What `alphas` are: the reference's pictures of Gaussians that are all 1, over black.

    In `smoe_tn`, whose weights do not sum to 1, the background has no share where such a picture is not black.
    """
    ones = {name: tensor for name, tensor in inputs.items() if name not in ("shs", "colors_precomp")}
    ones["colors_precomp"] = torch.ones(len(inputs["means3D"]), 1, dtype=torch.float64)
    black = [camera._replace(bg=torch.zeros(1, dtype=torch.float64)) for camera in cameras]
    pictures = channels_last([image.color for image in reference_renderings(ones, black)])
    return (pictures > 0).to(pictures) if cameras[0].blend_mode == "smoe_tn" else pictures


def gaussians_of(inputs):
    """The reference's own table of the inputs."""
    return reference._gather(*(inputs.get(name) for name in (
        "means3D", "means2D", "opacities", "dc", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp")))


def channels_last(images):
    return torch.stack([image.permute(1, 2, 0) for image in images])


def assert_projections(meta, scene, cameras):
    """Radii, centres and depths of `meta` are those of `project_gaussians`; of gsplat a first pixel's centre is 0.5."""
    rotations = torch.nn.functional.normalize(scene.inputs["rotations"])
    for camera, settings in enumerate(cameras):
        prints = project_gaussians(settings=settings, **{**scene.inputs, "means2D": None, "rotations": rotations})
        seen = prints.radii > 0
        assert seen.any() and torch.equal(meta["radii"][camera, :, 0], prints.radii)
        assert_close(meta["means2d"][camera][seen], prints.means2D[seen] + 0.5, TOLERANCE, "means2d")
        assert_close(meta["depths"][camera][seen], prints.depths[seen], TOLERANCE, "depths")


def test_the_order_of_arguments():
    """Those that gsplat's callers pass by position, and the names of the others."""
    names = list(inspect.signature(rasterization).parameters)
    assert names[:9] == ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height"]
    assert names[9:28] == ["near_plane", "far_plane", "radius_clip", "eps2d", "sh_degree", "packed", "tile_size",
                           "backgrounds", "render_mode", "sparse_grad", "absgrad", "rasterize_mode", "channel_chunk",
                           "distributed", "camera_model", "segmented", "covars", "blend_mode", "background_gate"]


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("degree", [None, 2])
def test_a_batch_of_cameras_is_the_references(mode, degree, rasterize_mode):
    scene = random_scene(mode, 60, seed=31, degree=degree or 0, channels=5 if degree is None else None, scale=0.05)
    channels = 5 if degree is None else 3
    cameras = make_cameras(mode, channels, degree or 0, antialiasing=rasterize_mode == "antialiased")
    renders, alphas, meta = rasterization(**arguments_of(scene, cameras), sh_degree=degree, blend_mode=mode,
                                          rasterize_mode=rasterize_mode)
    expected = reference_renderings(scene.inputs, cameras)
    assert renders.shape == (2, HEIGHT, WIDTH, channels) and alphas.shape == (2, HEIGHT, WIDTH, 1)
    assert_close(renders, channels_last([image.color for image in expected]), TOLERANCE, "renders")
    assert_close(alphas, shares(scene.inputs, cameras), TOLERANCE, "alphas")
    radii = torch.stack([image.radii for image in expected])
    assert (radii > 0).any() and (radii == 0).any()
    assert meta["radii"].dtype == torch.int32
    assert torch.equal(meta["radii"].cpu(), torch.stack([radii, radii], 2))
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (WIDTH, HEIGHT, 2)
    assert meta["gaussian_ids"] is None and meta["camera_ids"] is None


RADIAL = torch.tensor([[-0.2, 0.05, 0.03, 0.01, 0.02, -0.01], [0.1, 0.02, -0.01, 0.02, 0.01, 0.005]], device="cpu")
TANGENTIAL = torch.tensor([[0.01, -0.02], [-0.005, 0.01]], device="cpu")
PRISM = torch.tensor([[0.01, -0.005, 0.004, 0.003], [0.002, 0.001, -0.004, 0.002]], device="cpu")


@pytest.mark.parametrize("camera_model, coefficients, own", [
    ("ortho", {}, ("orthographic", [()] * 2)), ("fisheye", {}, ("fisheye", [()] * 2)),
    ("fisheye", dict(radial_coeffs=RADIAL[:, :4]), ("fisheye", RADIAL[:, :4].tolist())),
    ("pinhole", dict(radial_coeffs=RADIAL, tangential_coeffs=TANGENTIAL, thin_prism_coeffs=PRISM),
     ("opencv", torch.cat([RADIAL[:, :2], TANGENTIAL, RADIAL[:, 2:], PRISM], 1).tolist())),
    ("pinhole", dict(tangential_coeffs=TANGENTIAL), ("opencv", [[0, 0, *p] for p in TANGENTIAL.tolist()]))])
def test_lenses_are_the_references(camera_model, coefficients, own):
    scene = random_scene("smoe", 60, seed=31, channels=3, scale=0.05)
    model, distortions = own
    cameras = [camera._replace(camera_model=model, distortion=tuple(distortion),
                               principal_point=(WIDTH / 2 + x, HEIGHT / 2 + y))
               for camera, distortion, (x, y) in zip(make_cameras("smoe", 3), distortions, PRINCIPAL_POINTS)]
    if camera_model == "ortho":
        cameras = [camera._replace(tanfovx=2.0, tanfovy=1.5) for camera in cameras]
    renders, _, meta = rasterization(**arguments_of(scene, cameras), blend_mode="smoe", camera_model=camera_model,
                                     **{name: value.to(scene.inputs["means3D"]) for name, value in
                                        coefficients.items()})
    expected = reference_renderings(scene.inputs, cameras)
    assert_close(renders, channels_last([image.color for image in expected]), TOLERANCE, "renders")
    assert_projections(meta, scene, cameras)


@pytest.mark.parametrize("shutter, own", [
    (SimpleNamespace(name="ROLLING_TOP_TO_BOTTOM"), "top_to_bottom"), (3, "right_to_left")])
def test_rolling_shutters_are_the_references(shutter, own):
    scene = random_scene("smoe", 60, seed=31, channels=3, scale=0.05)
    cameras = make_cameras("smoe", 3)
    ends = []
    for k, (camera, (x, y)) in enumerate(zip(cameras, PRINCIPAL_POINTS)):
        end = camera.viewmatrix.clone()
        end[3, :3] += end.new_tensor([0.1, -0.15, 0.05])
        centre = -end[3, :3] @ torch.linalg.inv(end[:3, :3])
        cameras[k] = camera._replace(rolling_shutter=own, viewmatrix_end=end, campos=(camera.campos + centre) / 2,
                                     principal_point=(WIDTH / 2 + x, HEIGHT / 2 + y))
        ends.append(end.T)
    viewmats_rs = torch.stack(ends).requires_grad_()
    renders, _, meta = rasterization(**arguments_of(scene, cameras), blend_mode="smoe", rolling_shutter=shutter,
                                     viewmats_rs=viewmats_rs)
    expected = reference_renderings(scene.inputs, cameras)
    assert_close(renders, channels_last([image.color for image in expected]), TOLERANCE, "renders")
    assert_projections(meta, scene, cameras)
    renders.sum().backward()
    assert viewmats_rs.grad.abs().sum((1, 2)).min() > 0


@pytest.mark.parametrize("arguments, message", [
    (dict(rolling_shutter=2), "viewmats_rs is None, but rolling_shutter is ROLLING_BOTTOM_TO_TOP; it must be given"),
    (dict(viewmats_rs=torch.eye(4, device="cpu")), "viewmats_rs is given, but rolling_shutter is GLOBAL; it must be "
     "None"),
    (dict(rolling_shutter=True, viewmats_rs=torch.eye(4, device="cpu")), "rolling_shutter is True; it must be one of"),
    (dict(rolling_shutter="SIDEWAYS"), "rolling_shutter is 'SIDEWAYS'; it must be one of ROLLING_TOP_TO_BOTTOM"),
    (dict(rolling_shutter=0, viewmats_rs=torch.eye(4, device="cpu")), r"viewmats_rs has shape \[4, 4\]; it must be")])
def test_bad_shutters_are_named(small, arguments, message):
    with pytest.raises(ValueError, match=message):
        rasterization(**small, **arguments)


def test_a_last_pose_on_another_device_is_named(small):
    with pytest.raises(TypeError, match=f"viewmats_rs is on meta; it must be on {small['viewmats'].device}, as "):
        rasterization(**small, rolling_shutter=0, viewmats_rs=small["viewmats"].to("meta"))


def test_coefficients_that_a_lens_has_not_are_refused(small):
    with pytest.raises(NotImplementedError, match="tangential_coeffs is given; camera_model 'fisheye' has none here"):
        rasterization(**small, camera_model="fisheye", tangential_coeffs=torch.zeros(2, 2))
    with pytest.raises(ValueError, match=r"radial_coeffs has shape \[2, 4\]; it must be \[2, 6\]"):
        rasterization(**small, radial_coeffs=torch.zeros(2, 4))


@pytest.mark.parametrize("render_mode, width", [("RGB", 3), ("D", 1), ("ED", 1), ("RGB+D", 4), ("RGB+ED", 4)])
def test_render_modes(mode, render_mode, width):
    scene = random_scene(mode, 60, seed=32, channels=3)
    cameras = make_cameras(mode, 3)
    renders, alphas, _ = rasterization(**arguments_of(scene, cameras), blend_mode=mode, render_mode=render_mode)
    expected = reference_renderings(scene.inputs, cameras)
    assert renders.shape == (2, HEIGHT, WIDTH, width)
    assert_close(alphas, shares(scene.inputs, cameras), TOLERANCE, "alphas")
    if "RGB" in render_mode:
        assert_close(renders[..., :3], channels_last([image.color for image in expected]), TOLERANCE, "color")
    if "D" in render_mode:
        depths = channels_last([image.depth for image in expected])
        assert_close(renders[..., -1:], depths * (1 if "ED" in render_mode else alphas.cpu()), TOLERANCE, "depth")


@with_gates
def test_what_callers_composite_is_the_rendering_over_that_background(mode):
    """splatfacto renders over black, and adds (1 - alphas) times a background; gradients go the same way."""
    scene = random_scene(mode, 20, seed=39, channels=3, scale=0.02)
    cameras = make_cameras(mode, 3)
    kind = {"blend_mode": cameras[0].blend_mode, "background_gate": cameras[0].background_gate}
    weights, gradients, images = random_normal((2, HEIGHT, WIDTH, 3), 40), [], []
    names = ("means", "opacities", "colors", "scales")
    for composites in (False, True):
        arguments = arguments_of(scene, cameras)
        leaves = [arguments[name].detach().clone().requires_grad_() for name in names]
        arguments.update(zip(names, leaves))
        backgrounds = arguments.pop("backgrounds")
        image, alphas, _ = rasterization(**arguments, backgrounds=None if composites else backgrounds, **kind)
        images.append(image + (1 - alphas) * backgrounds[:, None, None] if composites else image)
        gradients.append(torch.autograd.grad((images[-1] * weights).sum(), leaves))
    assert (alphas == 0).any() and (alphas > 0.2).any()
    assert_close(images[1], images[0], TOLERANCE, "image")
    for name, one, other in zip(names, *gradients):
        assert_close(other, one, TOLERANCE, name)


def test_depth_is_a_sum_of_weighted_depths(mode):
    """Rendered another way: each Gaussian's view depth as its colour, without a background."""
    scene = random_scene(mode, 60, seed=33, channels=3)
    cameras = make_cameras(mode, 3)
    arguments = arguments_of(scene, cameras)
    depth, alphas, meta = rasterization(**arguments, blend_mode=mode, render_mode="D")
    points = torch.cat([scene.inputs["means3D"], torch.ones(60, 1, dtype=torch.float64)], 1)
    in_view = torch.stack([points @ c.viewmatrix for c in cameras])
    assert_close(meta["depths"], in_view[..., 2], TOLERANCE, "depths")
    arguments.update(colors=in_view[..., 2:3], backgrounds=None)
    image, _, _ = rasterization(**arguments, blend_mode=mode)
    assert_close(depth, image, TOLERANCE, "depth")


def test_every_camera_may_have_its_colours(mode):
    scene = random_scene(mode, 60, seed=34, degree=1)
    cameras = make_cameras(mode, 3, degree=1)
    arguments = arguments_of(scene, cameras)
    both = torch.stack([scene.inputs["shs"], scene.inputs["shs"].flip(0)])
    renders, _, _ = rasterization(**{**arguments, "colors": both}, sh_degree=1, blend_mode=mode)
    for index in range(2):
        expected = reference_renderings({**scene.inputs, "shs": both[index]}, cameras)[index]
        assert_close(renders[index], expected.color.permute(1, 2, 0), TOLERANCE, f"camera {index}")


def test_gradients_are_the_references(mode):
    """Those of means2d among them: in pixels, one row for each camera."""
    scene = random_scene(mode, 60, seed=35, degree=1)
    cameras = make_cameras(mode, 3, degree=1)
    arguments = arguments_of(scene, cameras)
    names = {"means": "means3D", "scales": "scales", "quats": "rotations", "opacities": "opacities", "colors": "shs"}
    for name in names:
        arguments[name] = arguments[name].detach().clone().requires_grad_(True)
    renders, alphas, meta = rasterization(**arguments, sh_degree=1, blend_mode=mode, render_mode="RGB+ED")
    means2d = meta["means2d"]
    means2d.retain_grad()  # as gsplat's strategies do
    weights, alpha_weights = random_normal(renders.shape, 36), random_normal(alphas.shape, 37)
    alpha_weights *= mode == "alpha"  # in the other modes, without a gate, alphas are constant
    ((renders * weights).sum() + (alphas * alpha_weights).sum()).backward()

    leaves = {name: tensor.detach().cpu().requires_grad_(True) for name, tensor in scene.inputs.items()}
    leaves["rotations"] = (2 * scene.inputs["rotations"]).detach().cpu().requires_grad_(True)
    points = [torch.zeros(60, 3, dtype=torch.float64, device="cpu", requires_grad=True) for _ in cameras]
    for index in range(2):
        image = reference_renderings({**leaves, "means2D": points[index]}, cameras)[index]
        ((torch.cat([image.color, image.depth]).permute(1, 2, 0) * weights[index].cpu()).sum()
         + (image.alpha.permute(1, 2, 0) * alpha_weights[index].cpu()).sum()).backward()
    expected = {name: leaves[other].grad for name, other in names.items()}
    expected["opacities"] = expected["opacities"][:, 0]
    expected["means2d"] = torch.stack([point.grad[:, :2] for point in points]) * torch.tensor(
        [2 / WIDTH, 2 / HEIGHT], dtype=torch.float64, device="cpu")
    actual = {name: arguments[name].grad for name in names}
    actual["means2d"] = means2d.grad
    assert expected["means2d"].any()
    assert_all_close(actual, expected, TOLERANCE)


def test_means2d_are_pixels_whose_first_centre_is_a_half():
    scene = random_scene("alpha", 60, seed=38, channels=3)
    cameras = make_cameras("alpha", 3)
    means2d = rasterization(**arguments_of(scene, cameras))[2]["means2d"]
    splats = [reference.project(gaussians_of(scene.inputs), camera) for camera in cameras]
    # The reference counts from the first pixel's centre, and adds 1e-7 to w.
    assert_close(means2d, torch.stack([splat.position for splat in splats]) + 0.5, 1e-6, "means2d")
    assert not means2d.requires_grad


@pytest.mark.parametrize("mode", [mode for mode in BLEND_MODES if mode != "smoe"])  # which holds its tails constant
def test_the_gradient_of_the_camera_is_a_whole_derivative(mode):
    """By finite differences: moving a camera moves its matrices and its centre, and with that the colours."""
    scene = random_scene(mode, 8, seed=1, scale=0.3, opacity=(0.3, 0.8), degree=1)
    cameras = make_cameras(mode, 3, degree=1)
    for camera in cameras:
        assert threshold_margin(scene._replace(settings=camera)).min() > 5e-5  # the step below moves it by about 1e-6
    arguments = arguments_of(scene, cameras)
    viewmats = arguments.pop("viewmats")
    weights = random_normal((2, HEIGHT, WIDTH, 3), 39)

    def loss(viewmats):
        return (rasterization(viewmats=viewmats, sh_degree=1, blend_mode=mode, **arguments)[0] * weights).sum()

    leaf = viewmats.clone().requires_grad_(True)
    analytic, = torch.autograd.grad(loss(leaf), leaf)
    step = 1e-6
    for index in ((0, 0, 3), (0, 2, 3), (1, 1, 3), (1, 0, 1), (0, 2, 0), (1, 1, 1)):
        change = torch.zeros_like(viewmats)
        change[index] = step
        numeric = ((loss(viewmats + change) - loss(viewmats - change)) / (2 * step)).item()
        # The loss, up to 1e3, is rounded by 1e-13, and 2e-6 divides that; the step's own error is of order 1e-12.
        assert analytic[index].item() == pytest.approx(numeric, rel=1e-5, abs=1e-5), index


def test_covariances_in_place_of_quaternions_and_scales(mode):
    scene = random_scene(mode, 60, seed=40, channels=3)
    cameras = make_cameras(mode, 3)
    arguments = arguments_of(scene, cameras)
    rotations = scene.inputs["rotations"]
    normalised = {**scene.inputs, "rotations": rotations / rotations.norm(dim=1, keepdim=True)}
    covars = reference.covariance3D(gaussians_of(normalised), 1.0)
    expected = rasterization(**arguments, blend_mode=mode)[0]
    renders = rasterization(**{**arguments, "quats": None, "scales": None}, covars=covars, blend_mode=mode)[0]
    assert_close(renders, expected, TOLERANCE, "renders")


def test_without_a_background_it_is_black(mode):
    scene = random_scene(mode, 60, seed=41, channels=3)
    arguments = arguments_of(scene, make_cameras(mode, 3))
    black = rasterization(**{**arguments, "backgrounds": torch.zeros(2, 3, dtype=torch.float64)}, blend_mode=mode)[0]
    assert torch.equal(rasterization(**{**arguments, "backgrounds": None}, blend_mode=mode)[0], black)
    assert not torch.equal(rasterization(**arguments, blend_mode=mode)[0], black)


def test_the_near_plane_is_an_argument():
    means = torch.tensor([[0.0, 0.0, depth] for depth in (0.005, 0.05, 0.5)])
    arguments = {"means": means, "quats": torch.tensor([[1.0, 0, 0, 0]] * 3), "scales": torch.full((3, 3), 0.01),
                 "opacities": torch.ones(3), "colors": torch.ones(3, 3), "viewmats": torch.eye(4)[None],
                 "Ks": torch.tensor([[[20.0, 0, 16], [0, 20, 16], [0, 0, 1]]]), "width": 32, "height": 32}
    assert rasterization(**arguments)[2]["radii"][0].gt(0).tolist() == [[False] * 2, [True] * 2, [True] * 2]
    far = rasterization(**arguments, near_plane=0.1)[2]["radii"][0]
    assert far.gt(0).tolist() == [[False] * 2, [False] * 2, [True] * 2]


def test_an_opacity_above_one_and_the_environments_blend_mode(mode, monkeypatch):
    scene = random_scene(mode, 60, seed=42, channels=3, opacity=(1.5, 6.0))
    cameras = make_cameras(mode, 3)
    monkeypatch.setenv("DSMOE_BLEND_MODE", mode)
    renders = rasterization(**arguments_of(scene, cameras))[0]
    expected = reference_renderings(scene.inputs, cameras)
    assert_close(renders, channels_last([image.color for image in expected]), TOLERANCE, "renders")


def test_the_background_gate_is_an_argument_or_in_the_environment(monkeypatch):
    scene = random_scene("smoe", 60, seed=42, channels=3)
    cameras, gate = make_cameras("smoe", 3), torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    arguments = arguments_of(scene, cameras)
    renders = rasterization(**arguments, blend_mode="smoe", background_gate=gate)[0]
    inputs = {**scene.inputs, "rotations": torch.nn.functional.normalize(scene.inputs["rotations"], dim=1)}
    expected = [rasterize(settings=camera._replace(background_gate=0.3), **inputs).color for camera in cameras]
    assert_close(renders, channels_last(expected), TOLERANCE, "renders")
    assert (renders - rasterization(**arguments, blend_mode="smoe")[0]).abs().max() > 0.01
    renders.sum().backward()
    assert gate.grad != 0
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.3")
    assert torch.equal(rasterization(**arguments, blend_mode="smoe")[0], renders)


def test_inputs_need_not_be_contiguous(mode):
    arguments = arguments_of(random_scene(mode, 60, seed=43, channels=3), make_cameras(mode, 3))
    expected = rasterization(**arguments, blend_mode=mode)[0]
    strided = {name: torch.stack([value, torch.full_like(value, math.nan)], -1)[..., 0]
               if isinstance(value, torch.Tensor) else value for name, value in arguments.items()}
    assert not strided["viewmats"].is_contiguous()
    assert_close(rasterization(**strided, blend_mode=mode)[0], expected, TOLERANCE, "renders")


def test_no_gaussians_leave_the_background(mode):
    cameras = make_cameras(mode, 3)
    arguments = arguments_of(random_scene(mode, 12, channels=3).rows(slice(0)), cameras)
    means = arguments["means"].clone().requires_grad_(True)
    renders, alphas, meta = rasterization(**{**arguments, "means": means}, blend_mode=mode)
    assert torch.equal(renders, arguments["backgrounds"][:, None, None].expand(2, HEIGHT, WIDTH, 3))
    assert not alphas.any() and meta["means2d"].shape == meta["radii"].shape == (2, 0, 2)
    renders.sum().backward()
    assert means.grad.shape == (0, 3)


@pytest.fixture
def small():
    return arguments_of(random_scene("alpha", 12, seed=44, channels=3), make_cameras("alpha", 3))


@pytest.mark.parametrize("name, value", [
    ("sparse_grad", True), ("distributed", True), ("camera_model", "ftheta"), ("with_ut", True),
    ("ftheta_coeffs", torch.zeros(2, 6)), ("global_z_order", False),
    ("extra_signals", torch.zeros(5, 1))])
def test_what_is_not_offered_is_refused_by_name(small, name, value):
    with pytest.raises(NotImplementedError, match=name):
        rasterization(**small, **{name: value})


def test_what_is_switched_off_or_changes_nothing_is_accepted(small):
    expected = rasterization(**small)[0]
    renders = rasterization(**small, packed=False, tile_size=8, channel_chunk=2, segmented=True, with_ut=False,
                            with_eval3d=False, radial_coeffs=None, viewmats_rs=None, global_z_order=True,
                            rolling_shutter=SimpleNamespace(name="GLOBAL"), extra_signals=None, renderer_config=None,
                            far_plane=1e10, radius_clip=0.0, eps2d=0.3, absgrad=False)[0]
    assert torch.equal(renders, expected)


@pytest.fixture
def cloud(mode):
    return random_scene(mode, 60, seed=45, channels=3, scale=0.05)


@pytest.mark.parametrize("name, value", [("far_plane", 4.0), ("radius_clip", 4.0)])
def test_what_is_far_or_small_is_not_there(mode, cloud, name, value):
    cameras = make_cameras(mode, 3)
    arguments = arguments_of(cloud, cameras)
    everything = rasterization(**arguments, blend_mode=mode)[2]
    measure = everything["depths"] if name == "far_plane" else -everything["radii"][..., 0]
    limit = value if name == "far_plane" else -value - 0.5
    for camera in range(2):  # a mask may differ from camera to camera
        kept = measure[camera] <= limit
        assert (kept & (everything["radii"][camera, :, 0] > 0)).sum() > 5 and not kept.all()
        one = {**arguments, "viewmats": arguments["viewmats"][camera:camera + 1],
               "Ks": arguments["Ks"][camera:camera + 1], "backgrounds": arguments["backgrounds"][camera:camera + 1]}
        rows = {name: one[name][kept] for name in ("means", "quats", "scales", "opacities", "colors")}
        renders, alphas, meta = rasterization(**one, blend_mode=mode, **{name: value})
        expected = rasterization(**{**one, **rows}, blend_mode=mode)
        # The rows that are left out take no part: what is added, and its order, are the same.
        assert torch.equal(renders, expected[0]) and torch.equal(alphas, expected[1])
        assert not meta["radii"][0, ~kept].any()
        assert torch.equal(meta["radii"][0, kept], expected[2]["radii"][0])


def test_eps2d_is_the_low_pass_filter(mode, cloud):
    cameras = make_cameras(mode, 3)
    renders = rasterization(**arguments_of(cloud, cameras), blend_mode=mode, eps2d=0.05)[0]
    expected = reference_renderings(cloud.inputs, [camera._replace(low_pass=0.05) for camera in cameras])
    assert_close(renders, channels_last([image.color for image in expected]), TOLERANCE, "renders")


@pytest.mark.parametrize("packed", [False, True])
def test_means2d_and_its_absgrad(mode, cloud, packed):
    """As gsplat's strategies read them: in pixels, for all Gaussians or for those that a camera sees."""
    cameras = make_cameras(mode, 3)
    arguments = arguments_of(cloud, cameras)
    arguments["means"].requires_grad_(True)
    meta = {}
    for name, asked in (("plain", {}), ("asked", {"packed": packed, "absgrad": True})):
        renders, _, meta[name] = rasterization(**arguments, blend_mode=mode, **asked)
        meta[name]["means2d"].retain_grad()
        (renders * random_normal(renders.shape, 46)).sum().backward()
    seen = meta["plain"]["radii"][..., 0] > 0
    rows = (lambda values: values[seen]) if packed else (lambda values: values)
    points, asked = meta["asked"]["means2d"], meta["asked"]
    assert torch.equal(points.detach(), rows(meta["plain"]["means2d"].detach()))
    assert torch.equal(asked["radii"], rows(meta["plain"]["radii"]))
    assert torch.equal(asked["depths"], rows(meta["plain"]["depths"]))
    # 1e-12: without absolute sums other code adds the same terms, in another order.
    assert_close(points.grad, rows(meta["plain"]["means2d"].grad), 1e-12, "means2d")
    for camera, settings in enumerate(cameras):
        leaf = torch.zeros(60, 2, dtype=torch.float64, requires_grad=True)
        rotations = torch.nn.functional.normalize(cloud.inputs["rotations"], dim=1)
        color = rasterize(settings=settings, means2D_abs=leaf, **{**cloud.inputs, "rotations": rotations}).color
        (color.permute(1, 2, 0) * random_normal((2, HEIGHT, WIDTH, 3), 46)[camera]).sum().backward()
        expected = leaf.grad * leaf.new_tensor([2 / WIDTH, 2 / HEIGHT])
        found = points.absgrad[asked["camera_ids"] == camera] if packed else points.absgrad[camera]
        assert expected.any()
        assert_close(found, expected[seen[camera]] if packed else expected, TOLERANCE, "absgrad")
    if packed:
        assert torch.equal(torch.stack([asked["camera_ids"], asked["gaussian_ids"]]), seen.nonzero().T)
        assert not asked["batch_ids"].any()


@pytest.mark.parametrize("copies", [1, 2, 7])
def test_relocated_gaussians_look_as_the_one_before(copies):
    """Together they have its opacity at the centre, and its integral along a line through it."""
    opacities = torch.tensor([0.3, 0.9], dtype=torch.float64)
    scales = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64).repeat(2, 1)
    ratios = torch.tensor([copies, 99])
    new, new_scales = compute_relocation(opacities, scales, ratios, torch.zeros(7, 7))
    assert ratios.tolist() == [copies, 7]
    assert 1 - (1 - new[0].item()) ** copies == pytest.approx(0.3, rel=1e-12)
    assert 1 - (1 - new[1].item()) ** 7 == pytest.approx(0.9, rel=1e-12)
    for old, opacity, scale, count in zip(opacities, new, new_scales[:, 0], ratios):
        x = torch.linspace(-30, 30, 60001).double()
        together = 1 - (1 - opacity * torch.exp(-0.5 * (x / scale) ** 2)) ** count
        alone = old * torch.exp(-0.5 * x ** 2)
        # The step, 1e-3, is small against the widths: the rule of trapezoids is exact to rounding for Gaussians.
        assert together.sum().item() == pytest.approx(alone.sum().item(), rel=1e-9)
    least, follows = compute_relocation(opacities, scales, ratios, torch.zeros(7, 7), min_opacity=0.5)
    assert (least >= 0.5).all() and (follows[0] <= new_scales[0]).all()


def test_covariances_and_their_inverses():
    quats, scales = random_normal((5, 4), 47), random_normal((5, 3), 48).abs() + 0.1
    covars, preci = quat_scale_to_covar_preci(quats, scales)
    # 1e-12: the inverse of a matrix whose condition number is below 1e4, in float64.
    assert_close(covars @ preci, torch.eye(3, dtype=torch.float64).expand(5, 3, 3), 1e-12, "their product")
    assert_close(torch.linalg.eigvalsh(covars), scales.square().sort(1)[0], 1e-12, "the squared lengths")
    x, y = torch.tensor([[1.0, 0.0, 0.0, 1.0]], dtype=torch.float64), torch.tensor([[1.0, 2.0, 3.0]]).double()
    turned, none = quat_scale_to_covar_preci(x, y, compute_preci=False, triu=True)  # a quarter turn about z
    assert none is None and turned.tolist() == [pytest.approx([4, 0, 0, 1, 0, 9], abs=1e-14)]


def test_colours_may_be_absent_where_none_are_rendered(small):
    expected = rasterization(**small, render_mode="ED")[0]
    assert torch.equal(rasterization(**{**small, "colors": None}, render_mode="ED")[0], expected)
    with pytest.raises(TypeError, match="colors"):
        rasterization(**{**small, "colors": None})


def test_arguments_that_nobody_knows_are_refused(small):
    with pytest.raises(TypeError, match="blend_moed"):
        rasterization(**small, blend_moed=None)


@pytest.mark.parametrize("name, value, error", [
    ("means", torch.zeros(12, 2), "means"), ("means", torch.zeros(1, 12, 3), "means"),
    ("quats", torch.zeros(12, 3), "quats"), ("scales", torch.zeros(12, 1), "scales"),
    ("opacities", torch.zeros(12, 1), "opacities"), ("colors", torch.zeros(11, 3), "colors"),
    ("viewmats", torch.eye(4), "viewmats"), ("viewmats", torch.zeros(0, 4, 4), "viewmats"),
    ("Ks", torch.zeros(1, 3, 3), "Ks"), ("backgrounds", torch.zeros(3), "backgrounds"),
    ("render_mode", "RGBD", "render_mode"), ("rasterize_mode", "smooth", "rasterize_mode"),
    ("covars", torch.zeros(12, 6), "covars"), ("blend_mode", "gamma", "blend_mode")])
def test_what_does_not_fit_is_named(small, name, value, error):
    with pytest.raises(ValueError, match=error):
        rasterization(**{**small, name: value})


@pytest.mark.parametrize("name", ["width", "height"])
@pytest.mark.parametrize("size", [0, -3, 4.5, "8", torch.tensor(0)], ids=str)
def test_a_size_that_no_image_has_is_named(small, name, size):
    with pytest.raises(ValueError, match=f"rasterization: {name} is .*; it must be a whole number of pixels"):
        rasterization(**{**small, name: size})


@pytest.mark.parametrize("name, value, error", [
    ("colors", "red", "colors is of type str"), ("means", torch.zeros(12, 3, dtype=torch.int64), "viewmats is"),
    ("far_plane", "far", "far_plane is of type str"), ("radius_clip", None, "radius_clip is of type NoneType")],
    ids=["colors", "means", "far_plane", "radius_clip"])
def test_another_type_is_named(small, name, value, error):
    with pytest.raises(TypeError, match=f"rasterization: {error}"):
        rasterization(**{**small, name: value})


def test_missing_tensors_are_named(small):
    with pytest.raises(TypeError, match="quats"):
        rasterization(**{**small, "quats": None})
