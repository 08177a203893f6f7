"""The ray-traced scene: the tracer against geometry by hand, and the folder that it writes."""
from __future__ import annotations

import os

import numpy as np

from dsmoe.options.config import TrainConfig
from dsmoe.scenes import synthetic
from dsmoe.scenes.scene import load_scene


def test_a_sphere_is_hit_where_it_is():
    ball = synthetic.Sphere(np.array([0.0, 0, 5]), 2.0, synthetic.plain((1, 0, 0)))
    origins = np.zeros((3, 3))
    directions = np.array([[0.0, 0, 1], [0, 1, 0], [0, 0, -1]])
    np.testing.assert_allclose(ball.hit(origins, directions), [3, synthetic.FAR, synthetic.FAR], rtol=1e-6)


def test_a_rectangle_ends_at_its_borders():
    x, y, _ = np.eye(3)
    sheet = synthetic.Rectangle(np.array([0.0, 0, 2]), x, y, 1.0, 0.5, synthetic.plain((1, 1, 1)))
    directions = np.array([[0.45, 0.2, 1], [0.55, 0.2, 1], [0.45, 0.3, 1], [0.45, 0.2, -1], [1, 0, 0]])
    distances = sheet.hit(np.zeros((5, 3)), directions)
    np.testing.assert_allclose(distances, [2] + [synthetic.FAR] * 4, rtol=1e-6)


def test_what_lies_in_shadow_gets_ambient_light_only():
    x, y, z = np.eye(3)
    floor = synthetic.Rectangle(0 * y, z, x, 9.0, 9.0, synthetic.plain((1, 1, 1)))
    ball = synthetic.Sphere(0.5 * synthetic.LIGHT, 0.3, synthetic.plain((0, 0, 0)))
    origins = np.array([[0.0, 0.4, 0], [-3.0, 0.4, 0]])
    down = np.array([[0.0, -1, 0]] * 2)
    _, shaded = synthetic.trace([floor, ball], origins, down)
    _, lit = synthetic.trace([floor], origins, down)
    # Half way to the light from the first point hangs the ball; the second point's ray to the light passes it.
    np.testing.assert_allclose(shaded[0], synthetic.AMBIENT, rtol=1e-6)
    to_light = synthetic.LIGHT.astype(float)
    lambert = to_light[1] / np.linalg.norm(to_light)
    np.testing.assert_allclose(lit[0], synthetic.AMBIENT + (1 - synthetic.AMBIENT) * lambert,
                               rtol=2e-4)  # the shadow ray starts SHADOW_GAP = 1e-3 above the floor, 4 below the light
    np.testing.assert_array_equal(shaded[1], lit[1])
    assert (lit > synthetic.AMBIENT).all()


def test_no_ray_leaves_the_room():
    camera = synthetic.view_cameras(48, 20, 15)[3]
    _, points, _ = synthetic.render_view(synthetic.room(), camera, 1)
    assert (np.abs(points[:, [0, 2]]) < synthetic.ROOM + 1e-3).all()
    assert (points[:, 1] > -1e-3).all() and (points[:, 1] < synthetic.HEIGHT + 1e-3).all()


def test_points_have_the_colour_of_the_pixel_that_saw_them(tiny_scene):
    """Joins tracer, cameras, file formats and loader: points projected into the images meet their own colours."""
    scene = load_scene(TrainConfig(scene=tiny_scene), progress=False)
    matches = visible = 0
    for view in list(scene.train) + list(scene.test):
        camera = view.camera
        local = scene.points.positions @ camera.rotation.T + camera.translation
        u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
        v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
        seen = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        pixels = view.image.numpy()[:, v[seen].astype(int), u[seen].astype(int)].T / 255
        matches += (np.abs(pixels - scene.points.colors[seen]).max(axis=1) < 0.02).sum()
        visible += seen.sum()
    # The rest is hidden behind something, or in a pixel with an edge. Chance matches are counted with wrong positions.
    assert visible > 300 and matches > 0.35 * visible, (matches, visible)


def test_the_scene_is_reproducible(tiny_scene, tmp_path):
    synthetic.write_synthetic_scene(str(tmp_path), views=9, width=32, height=24, points=150, supersampling=1)
    for name in ("images/view_005.png", "sparse/0/points3D.txt", "sparse/0/images.txt"):
        with open(os.path.join(tiny_scene, name), "rb") as one, open(tmp_path / name, "rb") as other:
            assert one.read() == other.read(), name


def test_supersampling_approaches_the_mean_colour_of_each_pixel():
    camera = synthetic.view_cameras(48, 40, 30)[5]
    images = {count: synthetic.render_view(synthetic.room(), camera, count)[0] for count in (1, 2, 8)}
    assert all(image.shape == (30, 40, 3) for image in images.values())
    errors = {count: np.abs(images[count] - images[8]).mean() for count in (1, 2)}
    assert 0 < errors[2] < 0.7 * errors[1], errors
