"""The orbit about what a scene's cameras look at."""
from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from dsmoe.errors import SceneError
from dsmoe.scenes.orbit import default_camera, look_at, orbit_of_cameras, orbit_of_points


def ring(target, up, count=7):
    """Cameras around a point that look at it."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    side = np.cross(up, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    cameras = []
    for angle in 2 * np.pi * np.arange(count) / count:
        eye = target + 3 * (np.cos(angle) * side + np.sin(angle) * np.cross(up, side)) + 1.5 * up
        rotation = look_at(eye, target, up)
        cameras.append(dataclasses.replace(default_camera(), rotation=rotation, translation=-rotation @ eye))
    return cameras


@pytest.mark.parametrize("up", [[0, 1, 0], [0, 0, -1], [1, 2, -1]])
def test_an_orbit_of_a_ring_is_that_ring(up):
    target = np.array([1.0, -2.0, 0.5])
    cameras = ring(target, up)
    orbit = orbit_of_cameras(cameras)
    assert np.allclose(orbit.target, target)
    assert np.allclose(orbit.up, np.asarray(up) / np.linalg.norm(up))
    for mine, theirs in zip(orbit.cameras(7, cameras[0]), cameras):
        assert np.allclose(mine.center, theirs.center) and np.allclose(mine.rotation, theirs.rotation)


def test_cameras_side_by_side_have_their_target_in_front():
    rotation = np.eye(3)
    cameras = [dataclasses.replace(default_camera(), translation=np.array([x, 0.0, 0.0])) for x in (-1.0, 0.0, 1.0)]
    orbit = orbit_of_cameras(cameras)
    assert np.allclose(orbit.target, [0, 0, 2]) and np.allclose(orbit.up, -rotation[1])


def test_one_camera_is_enough():
    camera = dataclasses.replace(default_camera(), translation=np.array([0.0, 0.0, 5.0]))
    orbit = orbit_of_cameras([camera])
    first, *_ = orbit.cameras(4, camera)
    assert np.isfinite(first.translation).all() and np.allclose(orbit.target, [0, 0, -3])


def test_points_are_seen_from_outside_upright():
    points = np.random.RandomState(0).normal(5, 1, (500, 3))
    lost = np.array([[math.nan, 0, 0], [0, math.inf, 0], [0, 0, -1e30]])
    for camera in orbit_of_points(np.concatenate([lost, points])).cameras(5, default_camera()):
        seen = points @ camera.rotation.T + camera.translation
        pixels = camera.fx * seen[:, :2] / seen[:, 2:] + [camera.cx, camera.cy]
        inside = (seen[:, 2] > 0.2) & (pixels > 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
        assert inside.mean() > 0.7
        assert camera.rotation[1] @ [0, -1, 0] < 0, "the image's y is down"
    with pytest.raises(SceneError, match="none of the 3 Gaussians lies within 1e[+]09 of the origin"):
        orbit_of_points(lost)
