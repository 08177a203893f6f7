"""Cameras against a pinhole projection written here, and against where the rasterizer really puts a Gaussian."""
from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diff_smoe_rasterization import rasterize, settings_from_camera
from dsmoe.scenes.cameras import Camera, quaternion_to_rotation, rotation_to_quaternion, scene_extent
from dsmoe.scenes.orbit import look_at


@pytest.fixture
def camera():
    """A phone camera whose principal point is 7 pixels off the centre (as in the fox capture) and fx is not fy."""
    rotation = Rotation.from_euler("xyz", [0.3, -0.7, 0.2]).as_matrix()
    return Camera("a.jpg", rotation, np.array([0.2, -0.1, 1.5]), 688.4, 680.9, 274.2, 476.6, 534, 948)


def colmap_pixels(camera, points):
    """COLMAP's PINHOLE model: pixel coordinates with the first pixel's centre at 0.5."""
    view = points @ camera.rotation.T + camera.translation
    return view[:, :2] / view[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def world_points(camera, random, count=50):
    """Points that the camera sees in front of it."""
    view = random.uniform([-0.3, -0.5, 1.0], [0.3, 0.5, 4.0], (count, 3))
    return (view - camera.translation) @ camera.rotation


def test_projmatrix_puts_points_where_the_pinhole_model_does(camera):
    points = world_points(camera, np.random.RandomState(0))
    settings = camera.settings(torch.zeros(3, dtype=torch.float64), 0, "alpha")
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    clip = homogeneous @ settings.projmatrix.numpy()
    ndc = clip[:, :2] / clip[:, 3:]
    # The rasterizer's pixel index of an NDC coordinate; an index is half a pixel below COLMAP's coordinate.
    size = np.array([camera.width, camera.height])
    index = ((ndc + 1) * size - 1) / 2
    # Doubles throughout: rounding of coordinates of a thousand pixels.
    np.testing.assert_allclose(index, colmap_pixels(camera, points) - 0.5, rtol=0, atol=1e-9)


def test_viewmatrix_and_campos(camera):
    settings = camera.settings(torch.zeros(3, dtype=torch.float64), 0, "alpha")
    center = torch.cat([settings.campos, torch.ones(1, dtype=torch.float64)])
    # The camera's own centre is the origin of view space.
    np.testing.assert_allclose((center @ settings.viewmatrix).numpy(), [0, 0, 0, 1], rtol=0, atol=1e-12)
    ahead = torch.tensor(camera.center + 2 * camera.rotation[2])
    depth = torch.cat([ahead, torch.ones(1, dtype=torch.float64)]) @ settings.viewmatrix
    np.testing.assert_allclose(depth[:3].numpy(), [0, 0, 2], rtol=0, atol=1e-12)


def test_settings_of_tensors_have_gradients_and_bad_ones_are_named(camera):
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    leaves = [torch.tensor(value, requires_grad=True) for value in (K, camera.rotation, camera.translation)]
    settings = settings_from_camera(*leaves, camera.width, camera.height, blend_mode="smoe")
    same = camera.settings(torch.zeros(3), 3, "smoe")
    for name, value in settings._asdict().items():
        assert torch.equal(value, getattr(same, name)) if torch.is_tensor(value) else value == getattr(same, name), name
    (settings.projmatrix.sum() + settings.campos.sum()).backward()
    assert all(float(leaf.grad.abs().sum()) > 0 for leaf in leaves)
    R, t = camera.rotation, camera.translation
    for words, arguments in {"K is": (K + [[0, 1, 0]] * 3, R, t), "R is": (K, -R, t),
                             r"t has shape \[3, 1\]": (K, R, t[:, None])}.items():
        with pytest.raises(ValueError, match=words):
            settings_from_camera(*arguments, 534, 948)


def test_an_unknown_blend_mode_is_refused_where_it_is_given(camera):
    with pytest.raises(ValueError, match="blend_mode is 'smo'; it must be one of alpha, smoe, smoe_eq7, smoe_tn,"):
        settings_from_camera([[1, 0, 2], [0, 1, 2], [0, 0, 1]], torch.eye(3), torch.zeros(3), 4, 4, blend_mode="smo")


def test_tangents_give_back_the_focal_lengths(camera):
    settings = camera.settings(torch.zeros(3), 0, "alpha")
    assert settings.image_width / (2 * settings.tanfovx) == pytest.approx(camera.fx, rel=1e-12)
    assert settings.image_height / (2 * settings.tanfovy) == pytest.approx(camera.fy, rel=1e-12)


@pytest.mark.parametrize("centred", [False, True])
def test_a_rendered_gaussian_lies_at_its_projection(camera, centred):
    """The centre of mass of one small splat; with a principal point ignored it would be 7 pixels off."""
    camera = camera.resized(267, 474)
    camera = camera.centred() if centred else camera
    point = world_points(camera, np.random.RandomState(3), 1)
    settings = camera.settings(torch.zeros(3), 0, "alpha")
    image = rasterize(
        torch.tensor(point, dtype=torch.float32), torch.full((1, 1), 0.9), settings,
        colors_precomp=torch.ones(1, 3), scales=torch.full((1, 3), 0.01), rotations=torch.tensor([[1.0, 0, 0, 0]]),
    ).color[0].double().numpy()
    rows, columns = np.mgrid[:camera.height, :camera.width]
    center = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
    # The 1/255 cut-off and the pixel grid move the centre of mass by some hundredths of a pixel.
    np.testing.assert_allclose(center, colmap_pixels(camera, point)[0] - 0.5, rtol=0, atol=0.05)


def test_resizing_scales_pixel_coordinates(camera):
    points = world_points(camera, np.random.RandomState(1))
    smaller = camera.resized(267, 237)
    expected = colmap_pixels(camera, points) * [267 / 534, 237 / 948]
    np.testing.assert_allclose(colmap_pixels(smaller, points), expected, rtol=0, atol=1e-9)


def test_look_at_puts_the_target_into_the_centre_upright():
    eye = np.array([2.0, 1.0, -3.0])
    rotation = look_at(eye, np.array([0.1, 0.4, 0.2]), np.array([0.0, 1.0, 0.0]))
    camera = Camera("a.png", rotation, -rotation @ eye, 50.0, 50.0, 32.0, 24.0, 64, 48)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), rtol=0, atol=1e-12)
    assert np.linalg.det(camera.rotation) == pytest.approx(1.0)
    pixels = colmap_pixels(camera, np.array([[0.1, 0.4, 0.2], [0.1, 0.5, 0.2]]))
    np.testing.assert_allclose(pixels[0], [32, 24], rtol=0, atol=1e-9)
    assert pixels[1, 1] < 24, "what is higher in the world is higher in the image"


def test_scene_extent_is_by_hand():
    corners = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]) + [5, 6, 7]
    assert scene_extent(corners) == pytest.approx(1.1 * 2**0.5)
    assert scene_extent(corners[:1]) == 1.0
    assert scene_extent(corners[0] + 1e-16 * np.arange(9).reshape(3, 3)) == 1.0
    assert scene_extent(np.array([[0.1, 0, 0], [0.1 + 1e-15, 0, 0], [0.1, 1e-15, 0]])) == 1.0
    assert scene_extent(0.001 * corners) == pytest.approx(0.0011 * 2**0.5), "a small scene keeps its size"


def test_quaternions_are_the_rotations_that_scipy_makes_of_them():
    """Also there and back, whichever component is the largest, and half turns."""
    random = np.random.RandomState(0)
    drawn = random.normal(size=(200, 4)) * 10 ** random.uniform(-3, 3, (200, 1))
    for quaternion in [*drawn, *np.eye(4), [0, -3, 0, 3]]:
        w, x, y, z = quaternion
        expected = Rotation.from_quat([x, y, z, w])
        rotation = quaternion_to_rotation(quaternion)
        # Ten products of numbers up to 1, rounded to doubles.
        np.testing.assert_allclose(rotation, expected.as_matrix(), rtol=0, atol=1e-15)
        unit = quaternion / np.linalg.norm(quaternion)
        back = rotation_to_quaternion(rotation)
        np.testing.assert_allclose(back * np.sign(back @ unit), unit, rtol=0, atol=2e-15)
    with pytest.raises(ValueError, match="the quaternion is 0"):
        quaternion_to_rotation([0, 0, 0, 0])
