"""Scene folders, good and damaged: what is loaded, and which error names which file."""
from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import pathlib
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from diff_smoe_rasterization import io
from dsmoe.errors import SceneError
from dsmoe.options.config import TrainConfig
from dsmoe.results.evaluation import Evaluation
from dsmoe.results.pictures import file_names
from dsmoe.results.rows import result_row
from dsmoe.scenes import undistortion
from dsmoe.scenes.cameras import Camera
from dsmoe.scenes.images import target_size
from dsmoe.scenes.layout import PosedImage, hold_out
from dsmoe.scenes.pointcloud import PointCloud
from dsmoe.scenes.scene import describe_scene, load_cameras, load_scene, read_layout
from dsmoe.training.trainer import Trainer


def load(folder, **options):
    return load_scene(TrainConfig(scene=str(folder), **options), progress=False)


@pytest.fixture
def colmap_folder(tiny_scene, tmp_path):
    """A copy of the tiny scene that a test may damage."""
    return shutil.copytree(tiny_scene, str(tmp_path / "scene"))


@pytest.fixture
def nerf_folder(tmp_path):
    """Two 20x10 RGBA images: half transparent red with opaque green on the right."""
    pixels = np.zeros((10, 20, 4), np.uint8)
    pixels[:, :10] = [255, 0, 0, 51]
    pixels[:, 10:] = [0, 255, 0, 255]
    for split in ("train", "test"):
        os.makedirs(tmp_path / split)
        Image.fromarray(pixels).save(tmp_path / split / "r_0.png")
        frames = [{"file_path": f"./{split}/r_0", "transform_matrix": np.eye(4).tolist()}]
        (tmp_path / f"transforms_{split}.json").write_text(
            json.dumps({"camera_angle_x": 2 * math.atan(0.5), "frames": frames}))
    return tmp_path


def edit_json(path, edit):
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


# What is loaded.

def test_every_eighth_image_by_sorted_name_is_a_test_image():
    names = [f"{number:02d}.png" for number in range(20)]
    shuffled = [names[(7 * index) % 20] for index in range(20)]
    camera = Camera("", np.eye(3), np.zeros(3), 1, 1, 1, 1, 2, 2)
    images = [PosedImage(Camera(**{**camera.__dict__, "name": name}), name) for name in shuffled]
    train, test, _ = hold_out(images)
    assert [image.camera.name for image in test] == ["00.png", "08.png", "16.png"]
    assert [image.camera.name for image in train] == [name for name in names if name not in
                                                      ("00.png", "08.png", "16.png")]


@pytest.mark.parametrize("every, tests, words", [(3, [0, 3, 6], "every 3rd"), (0, [], "no image"), (8, [0, 8], "8th")])
def test_how_many_images_are_kept_for_testing(tiny_scene, every, tests, words):
    scene = load(tiny_scene, test_every=every)
    assert [view.camera.name for view in scene.test] == [f"view_{index:03d}.png" for index in tests]
    assert len(scene.train) == 9 - len(tests) and words in scene.split


@pytest.mark.parametrize("size, resolution, expected", [
    ((4946, 3286), -1, (1600, 1063)),  # 3286 / 3.09125 = 1063.002
    ((1600, 1000), -1, (1600, 1000)),
    ((800, 533), -1, (800, 533)),
    ((800, 533), 1, (800, 533)),
    ((800, 533), 2, (400, 266)),  # 266.5 rounds to even
    ((534, 946), 4, (134, 236)),  # 133.5 and 236.5 round to even
    ((800, 533), 8, (100, 67)),  # 66.6 rounds up
    ((800, 533), 400, (400, 266)),  # 266.5 truncates
    ((800, 535), 300, (300, 200)),  # 200.6 truncates
    ((800, 533), 1600, (1600, 1066)),  # a width may also enlarge
    ((3, 3), 8, (1, 1)),
])
def test_resolution_rule_of_3dgs(size, resolution, expected):
    assert target_size(*size, resolution) == expected


def test_a_colmap_folder(tiny_scene):
    scene = load(tiny_scene)
    assert (scene.kind, len(scene.train), len(scene.test)) == ("colmap", 7, 2)
    assert [view.camera.name for view in scene.test] == ["view_000.png", "view_008.png"]
    view = scene.train[2]
    expected = np.asarray(Image.open(os.path.join(tiny_scene, "images", view.camera.name)))
    np.testing.assert_array_equal(view.image.permute(1, 2, 0).numpy(), expected)
    model = io.read_colmap(tiny_scene)
    image = [image for image in model.images if image.name == view.camera.name][0]
    w, x, y, z = image.qvec
    # The rotation of a unit quaternion, its first column written out.
    np.testing.assert_allclose(view.camera.rotation[:, 0],
                               [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(view.camera.translation, image.tvec)
    np.testing.assert_array_equal(scene.points.positions, model.points.positions)
    np.testing.assert_allclose(scene.points.colors * 255, model.points.colors, rtol=0, atol=1e-9)


def test_binary_and_text_models_load_alike(colmap_folder):
    text = load(colmap_folder)
    sparse = os.path.join(colmap_folder, "sparse", "0")
    model = io.read_colmap(colmap_folder)
    shutil.rmtree(sparse)
    io.write_colmap(sparse, model)
    assert sorted(os.listdir(sparse)) == ["cameras.bin", "images.bin", "points3D.bin"]
    binary = load(colmap_folder)
    for mine, theirs in zip(text.train, binary.train):
        np.testing.assert_allclose(mine.camera.rotation, theirs.camera.rotation, rtol=0, atol=1e-12)
        assert mine.camera.fx == theirs.camera.fx and mine.camera.name == theirs.camera.name
    np.testing.assert_array_equal(text.points.positions, binary.points.positions)


def test_intrinsics_follow_the_resolution_and_the_principal_point(colmap_folder):
    model = io.read_colmap(colmap_folder)
    model.cameras[1].params[:] = [30.0, 31.0, 17.5, 9.0]
    io.write_colmap(model.folder, model, text=True)
    camera = load(colmap_folder, resolution=2).train[0].camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (16, 12, 15.0, 15.5)
    assert (camera.cx, camera.cy) == (8.75, 4.5)
    camera = load(colmap_folder, resolution=2, principal_point="centre").train[0].camera
    assert (camera.cx, camera.cy, camera.fx) == (8, 6, 15.0)


def test_simple_pinhole(colmap_folder):
    model = io.read_colmap(colmap_folder)
    model.cameras[1] = io.ColmapCamera(1, "SIMPLE_PINHOLE", 32, 24, np.array([30.0, 15.0, 11.0]))
    io.write_colmap(model.folder, model, text=True)
    camera = load(colmap_folder).train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 30, 15, 11)


def test_several_cameras_and_sizes(colmap_folder):
    """Every other view has a camera of its own: 48x30 pixels, another focal length."""
    model = io.read_colmap(colmap_folder)
    model.cameras[2] = io.ColmapCamera(2, "PINHOLE", 48, 30, np.array([50.0, 51.0, 24.0, 15.0]))
    images = [dataclasses.replace(image, camera_id=1 + index % 2) for index, image in enumerate(model.images)]
    io.write_colmap(model.folder, dataclasses.replace(model, images=images), text=True)
    for image in images[1::2]:
        path = os.path.join(colmap_folder, "images", image.name)
        Image.open(path).resize((48, 30)).save(path)
    config = TrainConfig(scene=colmap_folder, iterations=8)
    scene = load_scene(config, progress=False)
    assert {view.camera.name: (view.camera.width, view.camera.fx) for view in scene.train + scene.test} == {
        image.name: (48, 50.0) if image.camera_id == 2 else (32, 28.8) for image in images}
    assert "32x24 to 48x30 pixels" in describe_scene(scene, read_layout(config), config)
    count = len(scene.train)
    for batch, note in ((count, ""), (count + 1, f"\nnote: a step of --batch {count + 1} shows some of the {count} ")):
        said = describe_scene(scene, read_layout(config), dataclasses.replace(config, batch=batch))
        assert ("note: " in said) == bool(note) and note in said
    trainer = Trainer(config, scene)
    for _ in range(7):  # each view once
        trainer.step()
    assert math.isfinite(trainer.evaluate().metrics["psnr"])


def test_rigs_and_frames_of_colmap_4_change_nothing(colmap_folder):
    expected = load(colmap_folder)
    for name in ("rigs.bin", "frames.bin", "rigs.txt", "frames.txt"):
        with open(os.path.join(colmap_folder, "sparse", "0", name), "wb") as file:
            file.write(b"\x01" * 40)
    assert [view.camera.name for view in load(colmap_folder).train] == [view.camera.name for view in expected.train]


def test_images_smaller_than_their_camera(colmap_folder):
    """As images_4 beside a model of full-size images: intrinsics follow the file."""
    half = os.path.join(colmap_folder, "images_2")
    os.makedirs(half)
    for name in os.listdir(os.path.join(colmap_folder, "images")):
        Image.open(os.path.join(colmap_folder, "images", name)).resize((16, 12)).save(os.path.join(half, name))
    full, small = load(colmap_folder).train[0].camera, load(colmap_folder, images="images_2").train[0].camera
    assert (small.width, small.fx, small.cy) == (16, full.fx / 2, full.cy / 2)


def test_load_cameras_agrees_with_the_loaded_views(tiny_scene):
    config = TrainConfig(scene=tiny_scene, resolution=2)
    scene = load_scene(config, progress=False)
    for split, views in (("train", scene.train), ("test", scene.test), ("all", scene.train + scene.test)):
        assert [camera.name for camera in load_cameras(config, split)] == [view.camera.name for view in views]
        assert load_cameras(config, split)[0].fx == views[0].camera.fx


def test_init_points_are_a_reproducible_subset(tiny_scene):
    everything = load(tiny_scene).points.positions
    few, again, other = (load(tiny_scene, init_points=20, seed=seed).points.positions for seed in (1, 1, 2))
    assert len(few) == 20 and {tuple(row) for row in few} <= {tuple(row) for row in everything}
    np.testing.assert_array_equal(few, again)
    assert not np.array_equal(few, other)
    assert len(load(tiny_scene, init_points=10**6).points.positions) == len(everything)


def test_nerf_images_are_composited(nerf_folder):
    black = load(nerf_folder).train[0].image.numpy()
    white = load(nerf_folder, white_background=True).train[0].image.numpy()
    # Alpha 51 / 255 = 0.2 of red over black and over white.
    assert black[:, 0, 0].tolist() == [51, 0, 0] and white[:, 0, 0].tolist() == [255, 204, 204]
    assert black[:, 0, 19].tolist() == white[:, 0, 19].tolist() == [0, 255, 0]


def test_nerf_cameras_look_along_minus_z_with_y_up(nerf_folder):
    camera = load(nerf_folder).train[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (20, 10, 10, 5)
    # The field of view has tangent 0.5 at the half width.
    assert camera.fx == camera.fy == pytest.approx(20)
    view = camera.rotation @ [0.1, 0.2, -1.0] + camera.translation
    np.testing.assert_allclose(view, [0.1, -0.2, 1.0], rtol=0, atol=1e-12)


def test_nerf_names_are_paths(nerf_folder):
    scene = load(nerf_folder)
    assert (scene.train[0].camera.name, scene.test[0].camera.name) == ("train/r_0.png", "test/r_0.png")
    assert file_names(["cam1/0001.jpg", "cam2/0001.jpg", "cam1/0001.png", "cam1_0001_2.png", "\x1b.png"]) == [
        "cam1_0001", "cam2_0001", "cam1_0001_2", "cam1_0001_2_2", "\\x1b"]


def test_nerf_random_points(nerf_folder):
    points = load(nerf_folder).points
    assert points.positions.shape == (100_000, 3)
    assert np.abs(points.positions).max() <= 1.3
    # Uniform: each mean within five standard errors, 1.3 / sqrt(3) / sqrt(100,000), of 0.
    np.testing.assert_allclose(points.positions.mean(axis=0), 0, rtol=0, atol=5 * 1.3 / 3**0.5 / 100_000**0.5)
    assert len(load(nerf_folder, init_points=50).points.positions) == 50


def test_nerf_points_from_a_file(nerf_folder):
    positions = np.arange(15.0).reshape(5, 3)
    io.write_points(str(nerf_folder / "points3d.ply"), io.Points(positions, np.full((5, 3), 51, np.uint8)))
    points = load(nerf_folder).points
    np.testing.assert_array_equal(points.positions, positions)
    np.testing.assert_allclose(points.colors, 0.2, rtol=0, atol=1e-12)


def test_nerf_explicit_intrinsics(nerf_folder):
    def edit(content):
        del content["camera_angle_x"]
        content.update(fl_x=50.0, fl_y=51.0, cx=19.0, cy=11.0, w=40, h=20)

    edit_json(nerf_folder / "transforms_train.json", edit)
    camera = load(nerf_folder).train[0].camera  # the image is half as large as the json's size
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (25, 25.5, 9.5, 5.5)


def test_nerf_without_a_test_set(nerf_folder):
    (nerf_folder / "transforms_test.json").unlink()
    assert len(load(nerf_folder).test) == 0


@pytest.fixture
def transforms_folder(tmp_path):
    """transforms.json as nerfstudio writes it: 10 frames on a circle, 20x10 pixels, intrinsics of each frame."""
    os.makedirs(tmp_path / "images")
    frames = []
    for index in range(10):
        name = f"images/frame_{index:05d}.jpg"
        Image.new("RGB", (20, 10), (25 * index, 0, 0)).save(tmp_path / name, quality=100)
        turn = Rotation.from_euler("y", 36 * index, degrees=True).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn, turn @ [0, 0, 2]  # looks at the origin from a distance of 2
        frames.append({"file_path": name, "transform_matrix": matrix.tolist(), "fl_x": 20.0 + index,
                       "fl_y": 21.0 + index, "cx": 10.5, "cy": 5.0, "w": 20, "h": 10})
    (tmp_path / "transforms.json").write_text(json.dumps(
        {"camera_model": "OPENCV", "k1": 0.0, "k2": 0, "p1": 0, "p2": 0, "applied_transform": np.eye(4)[:3].tolist(),
         "frames": frames}))
    return tmp_path


def test_transforms_with_intrinsics_of_each_frame(transforms_folder):
    edit_json(transforms_folder / "transforms.json", lambda content: content["frames"][3].update(
        file_path="images/frame_00003"))  # the ending is found
    scene = load(transforms_folder)
    assert (scene.kind, len(scene.train), len(scene.test)) == ("transforms", 8, 2)
    assert scene.train[2].camera.name == "images/frame_00003.jpg"
    assert [view.camera.name for view in scene.test] == ["images/frame_00000.jpg", "images/frame_00008.jpg"]
    camera = scene.train[0].camera  # of frame 1
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (21, 22, 10.5, 5)
    np.testing.assert_allclose(camera.rotation @ [0, 0, 0] + camera.translation, [0, 0, 2], rtol=0, atol=1e-12)
    # Without a file of points they fill a cube about what the cameras look at, and reach behind it.
    assert scene.points.positions.shape == (100_000, 3)
    np.testing.assert_allclose(np.abs(scene.points.positions).max(axis=0), 3.0, rtol=0, atol=0.01)


def test_transforms_of_a_colmap_scene_are_that_scene(colmap_folder, tmp_path):
    """nerfstudio's conversion, written out: camera to world, with y up and z backward."""
    expected, model, frames = load(colmap_folder), io.read_colmap(colmap_folder), []
    shutil.copytree(os.path.join(colmap_folder, "images"), str(tmp_path / "json" / "images"))
    for image in model.images:
        w, x, y, z = image.qvec
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.T * [1, -1, -1]
        matrix[:3, 3] = -rotation.T @ image.tvec
        frames.append({"file_path": f"images/{image.name}", "transform_matrix": matrix.tolist()})
    fx, fy, cx, cy = model.cameras[1].params
    io.write_points(str(tmp_path / "json" / "points.ply"), model.points)
    (tmp_path / "json" / "transforms.json").write_text(json.dumps(
        {"camera_model": "PINHOLE", "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": 32, "h": 24,
         "ply_file_path": "points.ply", "frames": frames}))
    scene = load(tmp_path / "json")
    for views, theirs in ((scene.train, expected.train), (scene.test, expected.test)):
        assert [view.camera.name for view in views] == [f"images/{view.camera.name}" for view in theirs]
        for view, other in zip(views, theirs):
            np.testing.assert_allclose(view.camera.rotation, other.camera.rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(view.camera.translation, other.camera.translation, rtol=0, atol=1e-12)
            assert torch.equal(view.image, other.image) and view.camera.fx == other.camera.fx
    np.testing.assert_allclose(scene.points.positions, expected.points.positions, rtol=1e-6, atol=1e-6)  # float32
    assert scene.split == expected.split and scene.extent == pytest.approx(expected.extent)


def test_transforms_with_points_masks_and_listed_images(transforms_folder):
    positions = np.arange(15.0).reshape(5, 3)
    io.write_points(str(transforms_folder / "sparse_pc.ply"), io.Points(positions, np.full((5, 3), 51, np.uint8)))
    os.makedirs(transforms_folder / "masks")
    Image.new("L", (20, 10), 255).save(transforms_folder / "masks" / "one.png")

    def edit(content):
        names = [frame["file_path"] for frame in content["frames"]]
        content.update(ply_file_path="./sparse_pc.ply", train_filenames=["./" + name for name in names[:6]],
                       val_filenames=names[6:7], test_filenames=names[7:9])
        for frame in content["frames"]:
            frame["mask_path"] = "masks/one.png"

    edit_json(transforms_folder / "transforms.json", edit)
    scene = load(transforms_folder, test_every=2)
    np.testing.assert_array_equal(scene.points.positions, positions)
    assert [view.camera.name[-5] for view in scene.train] == list("012345")
    assert [view.camera.name[-5] for view in scene.test] == list("78")
    assert scene.split == "transforms.json lists the test images, 2 images are in neither list"
    assert scene.train[0].mask.shape == (1, 10, 20)
    for names, train, test in ((["train"], "012345", "6789"), (["test"], "0123456" + "9", "78"),
                               (["val"], "012345" + "789", "6")):
        left = json.loads((transforms_folder / "transforms.json").read_text())
        for kind in {"train", "test", "val"} - {*names}:
            left.pop(f"{kind}_filenames")
        other = transforms_folder / f"only_{names[0]}"
        other.mkdir()
        for name in ("images", "masks", "sparse_pc.ply"):
            os.symlink(transforms_folder / name, other / name)
        (other / "transforms.json").write_text(json.dumps(left))
        scene = load(other)
        assert ["".join(view.camera.name[-5] for view in views) for views in (scene.train, scene.test)] == [train, test]
    edit_json(transforms_folder / "transforms.json", lambda content: content.update(test_filenames=["images/no.jpg"]))
    refused(transforms_folder, "transforms.json", "`test_filenames` names images/no.jpg, which is not a frame")


@pytest.mark.parametrize("value", [-1, True, ["sparse_pc.ply"], float("nan"), {}])
def test_points_of_no_name_are_not_made_up(transforms_folder, value):
    edit_json(transforms_folder / "transforms.json", lambda content: content.update(ply_file_path=value))
    refused(transforms_folder, "`ply_file_path` is ", "must be the name of a file")


def write_masks(folder, size=(32, 24), name="{}.png", value=255):
    """masks/ of the tiny scene: the right half is kept."""
    os.makedirs(os.path.join(folder, "masks"))
    pixels = np.zeros(size[::-1], np.uint8)
    pixels[:, size[0] // 2:] = value
    for image in os.listdir(os.path.join(folder, "images")):
        Image.fromarray(pixels).save(os.path.join(folder, "masks", name.format(image)))


@pytest.mark.parametrize("behind", [True, False])
def test_masks_lie_beside_the_images(colmap_folder, behind):
    assert all(view.mask is None for view in load(colmap_folder).train)
    write_masks(colmap_folder)
    if not behind:  # in place of the image's extension
        for name in os.listdir(os.path.join(colmap_folder, "masks")):
            path = os.path.join(colmap_folder, "masks", name)
            os.rename(path, path[:-len(".png")])
    scene = load(colmap_folder)
    for view in [*scene.train, *scene.test]:
        assert view.mask.shape == (1, 24, 32) and view.mask.dtype == torch.uint8
        assert not view.mask[..., :16].any() and (view.mask[..., 16:] == 255).all()
        assert float(view.mask_float().mean()) == 0.5


def test_masks_follow_the_size_of_their_images(colmap_folder):
    write_masks(colmap_folder, size=(320, 240), value=128)
    mask = load(colmap_folder, resolution=2).train[0].mask
    assert mask.shape == (1, 12, 16) and not mask[..., :7].any() and (mask[..., 9:] == 128).all()


def test_masks_of_a_nerf_scene(nerf_folder):
    for split in ("train", "test"):
        os.makedirs(nerf_folder / "masks" / split)
        Image.new("RGB", (20, 10), (255, 255, 255)).save(nerf_folder / "masks" / split / "r_0.png")
    assert load(nerf_folder).train[0].mask.shape == (1, 10, 20) and (load(nerf_folder).test[0].mask == 255).all()


def test_transparency_is_kept_for_random_backgrounds_alone(nerf_folder, tiny_scene):
    assert load(nerf_folder).train[0].opacity is None
    assert load(tiny_scene, random_background=True).train[0].opacity is None, "no image of it has transparency"
    color = torch.tensor([0.25, 0.5, 1.0])
    for white in (False, True):
        view = load(nerf_folder, random_background=True, white_background=white).train[0]
        target = view.image_over(color, torch.full((3,), float(white)))
        # Alpha 0.2 of red over the colour; half a level of the composited bytes.
        np.testing.assert_allclose(target[:, 0, 0].tolist(), [0.2 + 0.8 * 0.25, 0.8 * 0.5, 0.8], rtol=0, atol=0.5 / 255)
        assert target[:, 0, 19].tolist() == [0, 1, 0]


# What is refused.

def refused(folder, *words, **options):
    """Loading raises a SceneError that has all these words."""
    with pytest.raises(SceneError) as error:
        load(folder, **options)
    assert str(error.value).isprintable()
    for word in words:
        assert word in str(error.value), str(error.value)


def test_no_folder_and_no_scene(tmp_path):
    refused(tmp_path / "nowhere", "nowhere", "no such folder")
    refused(tmp_path, str(tmp_path), "COLMAP", "transforms_train.json")
    (tmp_path / "model.ply").write_text("ply")
    refused(tmp_path / "model.ply", "model.ply: is a file; a scene is a folder")


@pytest.fixture(params=["colmap", "transforms", "nerf-synthetic"])
def any_scene(request, colmap_folder, tmp_path):
    """The tiny scene as one of the three kinds: its folder, and its images by name."""
    if request.param != "colmap":
        as_json(colmap_folder, request.param)
    images = os.path.join(colmap_folder, "images")
    return colmap_folder, {name: os.path.join(images, name) for name in sorted(os.listdir(images))}


def as_json(folder, kind):
    """Makes the tiny scene one of the kinds with json, of the same split."""
    layout = read_layout(TrainConfig(scene=folder))
    shutil.rmtree(os.path.join(folder, "sparse"))

    def content(images):
        frames = []
        for image in images:
            matrix = np.eye(4)
            matrix[:3, :3] = image.camera.rotation.T @ np.diag([1.0, -1, -1])
            matrix[:3, 3] = image.camera.center
            frames.append({"file_path": f"images/{image.camera.name}", "transform_matrix": matrix.tolist()})
        return {"fl_x": layout.train[0].camera.fx, "frames": frames}

    files = {"transforms": [*layout.train, *layout.test]} if kind == "transforms" else {
        "transforms_train": layout.train, "transforms_test": layout.test}
    for name, images in files.items():
        with open(os.path.join(folder, name + ".json"), "w", encoding="utf-8") as file:
            json.dump(content(images), file)


def test_a_missing_image_is_left_out_and_counted(any_scene, capsys):
    folder, images = any_scene
    before = load(folder)
    os.remove(images["view_003.png"])
    os.remove(images["view_008.png"])  # a test image
    config = TrainConfig(scene=folder)
    scene, layout = load(folder), read_layout(config)
    assert [os.path.basename(view.camera.name) for view in scene.train] == [
        f"view_{index:03d}.png" for index in (1, 2, 4, 5, 6, 7)], "no test image becomes a training image"
    assert [os.path.basename(view.camera.name) for view in scene.test] == ["view_000.png"]
    said = describe_scene(scene, layout, config).splitlines()[1]
    assert said.startswith("warning: 2 of 9 images are missing and left out: ") and "view_003.png" in said
    assert "view_008.png" in said and said.endswith("; --strict refuses such a scene")
    for view in scene.train:
        same, = (other for other in before.train if other.camera.name == view.camera.name)
        assert (same.camera.rotation == view.camera.rotation).all() and same.camera.fx == view.camera.fx
    assert len(load_cameras(config, "all")) == 7 and capsys.readouterr().err == said + "\n"
    assert result_row(config, scene, 1, 0.0, Evaluation({}, None, []))["protocol"]["images_left_out"] == 2
    refused(folder, "no such image", "2 of 9 images", "without --strict they are left out", strict=True)
    for name in range(1, 8):
        with contextlib.suppress(FileNotFoundError):
            os.remove(images[f"view_{name:03d}.png"])
    refused(folder, "no such image", "8 of 9 images")


def test_a_folder_of_images_is_only_a_colmap_scenes(any_scene):
    folder, _ = any_scene
    if os.path.isdir(os.path.join(folder, "sparse")):
        refused(folder, "images_4: no such folder", images="images_4")
    else:
        refused(folder, "--images is 'images_4', which is for a COLMAP scene", "json says", images="images_4")


def test_a_missing_mask(colmap_folder):
    write_masks(colmap_folder)
    os.remove(os.path.join(colmap_folder, "masks", "view_003.png.png"))
    refused(colmap_folder, "masks", "image view_003.png has no mask", "view_003.png.png")


def test_masks_that_do_not_fit(colmap_folder):
    write_masks(colmap_folder, value=0)
    refused(colmap_folder, ".png.png", "keeps no pixel of")
    for name in os.listdir(os.path.join(colmap_folder, "masks")):
        Image.new("L", (32, 24), 1).save(os.path.join(colmap_folder, "masks", name))
    refused(colmap_folder, ".png.png", "values 0 and 1", "255")
    for name in os.listdir(os.path.join(colmap_folder, "masks")):
        Image.new("L", (24, 32), 255).save(os.path.join(colmap_folder, "masks", name))
    refused(colmap_folder, ".png.png", "the mask is 24x32", "32x24", "another shape")
    for name in os.listdir(os.path.join(colmap_folder, "masks")):
        with open(os.path.join(colmap_folder, "masks", name), "wb") as file:
            file.write(b"no image")
    refused(colmap_folder, ".png.png", "not a readable image")
    shutil.rmtree(os.path.join(colmap_folder, "masks"))
    with open(os.path.join(colmap_folder, "masks"), "w", encoding="utf-8") as file:
        file.write("not a folder")
    refused(colmap_folder, "masks", "is not a folder")


def test_an_unreadable_image(colmap_folder):
    path = os.path.join(colmap_folder, "images", "view_004.png")
    with open(path, "r+b") as file:
        file.truncate(60)
    refused(colmap_folder, "view_004.png", "not a readable image")


def test_an_image_that_is_trained_on_is_read_once(colmap_folder, monkeypatch):
    names, usual = [], open
    monkeypatch.setattr("builtins.open", lambda path, *more, **options: names.append(path) or usual(
        path, *more, **options))
    scene = load(colmap_folder)
    names = [name for name in names if str(name).endswith(".png")]
    assert len(names) == len(set(names)) == len(scene.train) + len(scene.test)
    with open(names[0], "rb") as file:
        checksum = hashlib.sha256(file.read()).hexdigest()
    assert checksum in [view.checksum for view in [*scene.train, *scene.test]]
    measured = load_scene(TrainConfig(scene=str(colmap_folder)), progress=False, checksums=False)
    assert not any(view.checksum for view in [*measured.train, *measured.test])


def test_a_format_that_runs_another_program_is_refused(colmap_folder, monkeypatch):
    """EPS, on which Pillow runs Ghostscript, under the name of a PNG; JPEG under that name is read."""
    path, ran = os.path.join(colmap_folder, "images", "view_004.png"), []
    monkeypatch.setattr("PIL.EpsImagePlugin.Ghostscript", lambda *arguments, **more: ran.append(arguments))
    Image.new("RGB", (32, 24)).save(path, format="EPS")
    refused(colmap_folder, "view_004.png", "not a readable image")
    with pytest.raises(SceneError, match="view_004.png: not a readable image"):
        undistortion._plan(PosedImage(read_layout(TrainConfig(scene=colmap_folder)).train[0].camera, path), "")
    assert not ran
    Image.new("RGB", (32, 24)).save(path, format="JPEG")
    load(colmap_folder)


@pytest.mark.parametrize("dtype, kind", [(np.uint16, "PNG"), (np.int32, "TIFF"), (np.float32, "TIFF")])
def test_more_than_8_bits(colmap_folder, dtype, kind):
    path = os.path.join(colmap_folder, "images", "view_004.png")
    Image.fromarray(np.full((24, 32), 30_000, dtype)).save(path, format=kind)
    refused(colmap_folder, "view_004.png", "8 bits")


def test_a_resolution_beyond_memory(colmap_folder):
    refused(colmap_folder, "view_00", "--resolution 300000", "32x24", "300000x225000", resolution=300_000)


def test_an_image_of_another_shape(colmap_folder):
    Image.new("RGB", (24, 32)).save(os.path.join(colmap_folder, "images", "view_004.png"))
    refused(colmap_folder, "view_004.png", "24x32", "32x24")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_truncated_binary_file(colmap_folder, name):
    model = io.read_colmap(colmap_folder)
    shutil.rmtree(model.folder)
    io.write_colmap(model.folder, model)
    path = os.path.join(model.folder, name + ".bin")
    with open(path, "r+b") as file:
        file.truncate(os.path.getsize(path) - 5)
    refused(colmap_folder, name + ".bin")


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_missing_model_file(colmap_folder, name, text):
    model = io.read_colmap(colmap_folder)
    shutil.rmtree(model.folder)
    io.write_colmap(model.folder, model, text=text)
    path = os.path.join(model.folder, name + (".txt" if text else ".bin"))
    os.remove(path)
    with pytest.raises(SceneError) as error:
        load(colmap_folder)
    words = "no COLMAP model here: neither cameras.bin" if name == "cameras" else f"{path}: no such file"
    assert words in str(error.value) and "Errno" not in str(error.value)


def test_an_empty_model(colmap_folder):
    model = io.read_colmap(colmap_folder)
    open(os.path.join(model.folder, "points3D.txt"), "w").close()
    refused(colmap_folder, model.folder, "0 points", "at least 4")


def test_a_model_with_one_image(colmap_folder):
    model = io.read_colmap(colmap_folder)
    io.write_colmap(model.folder, io.ColmapModel(model.cameras, model.images[:1], model.points), text=True)
    refused(colmap_folder, "no training image is left")


def test_a_camera_model_that_opencv_does_not_have(colmap_folder):
    model = io.read_colmap(colmap_folder)
    model.cameras[1] = io.ColmapCamera(1, "FOV", 32, 24, np.array([30.0, 30, 16, 12, 0.1]))
    io.write_colmap(model.folder, model, text=True)
    refused(colmap_folder, "camera 1", "FOV", "PINHOLE", "OPENCV_FISHEYE", "colmap image_undistorter")


def test_a_focal_length_of_zero(colmap_folder):
    model = io.read_colmap(colmap_folder)
    model.cameras[1].params[1] = 0.0
    io.write_colmap(model.folder, model, text=True)
    refused(colmap_folder, "cameras.txt", "camera 1", "focal length")


@pytest.mark.parametrize("again", ["same", "./", "../", "link", "hard link", "absolute"])
def test_an_image_that_is_listed_twice(any_scene, again):
    """The second one, with a pose of its own, would be trained on too, or be a test image that was trained on."""
    folder, images = any_scene
    name, path = "view_003.png", images["view_003.png"]
    if "link" in again:
        (os.symlink if again == "link" else os.link)(path, os.path.join(folder, "images", "zzz.png"))
    double = {"same": name, "./": f"./{name}", "../": f"../images/{name}", "absolute": path}.get(again, "zzz.png")
    if os.path.isdir(os.path.join(folder, "sparse")):
        model = io.read_colmap(folder)
        pose = dataclasses.replace(model.images[5], id=99, name=double)
        for text in (True, False):
            io.write_colmap(model.folder, dataclasses.replace(model, images=[*model.images, pose]), text=text)
            refused(folder, "is listed twice", "to train on or to test")
        return
    double = path if again == "absolute" else f"images/{double}"
    for name in {*os.listdir(folder)} & {"transforms.json", "transforms_train.json"}:
        edit_json(pathlib.Path(folder, name), lambda content: content["frames"].append(
            {**content["frames"][5], "file_path": double}))
    refused(folder, "is listed twice", "to train on or to test")


def test_names_that_windows_wrote_are_found(transforms_folder):
    io.write_points(str(transforms_folder / "images" / "points.ply"), io.Points(np.eye(4)[:, :3]))
    Image.new("L", (20, 10), 255).save(transforms_folder / "images" / "mask of one.png")
    names = [frame["file_path"] for frame in json.loads((transforms_folder / "transforms.json").read_text())["frames"]]

    def edit(content):
        for frame, name in zip(content["frames"], names):
            frame["file_path"] = name.replace("/", "\\")
        content["frames"][1]["mask_path"] = "images\\mask of one.png"
        content.update(ply_file_path="images\\points.ply", test_filenames=[names[0].replace("/", "\\")])

    edit_json(transforms_folder / "transforms.json", edit)
    scene = load(transforms_folder)
    assert len(scene.points.positions) == 4 and [view.camera.name for view in scene.test] == names[:1]
    assert [view.camera.name for view in scene.train] == names[1:]
    assert [view.mask is not None for view in scene.train[:2]] == [True, False]


def test_an_image_in_both_lists_of_transforms(transforms_folder):
    names = [f"images/frame_{index:05d}.jpg" for index in range(10)]
    edit_json(transforms_folder / "transforms.json", lambda content: content.update(
        train_filenames=names[:8], test_filenames=["./" + name for name in names[7:]]))
    refused(transforms_folder, "is listed twice", "to train on or to test")


def test_both_files_of_a_nerf_scene_may_list_an_image_and_the_split_says_so(nerf_folder):
    assert load(nerf_folder).split == "transforms_test.json lists the test images"
    shutil.copy(nerf_folder / "transforms_train.json", nerf_folder / "transforms_test.json")
    scene = load(nerf_folder)
    assert scene.split == "transforms_test.json lists the test images, 1 of which are training images too"


@pytest.mark.parametrize("small", [1e-300, 5e-324, 1e-10, 0.0, -1.0])
def test_focal_lengths_that_show_nothing(any_scene, small):
    """What a COLMAP reader lets through too: below a billionth of a pixel."""
    folder, _ = any_scene
    if os.path.isdir(os.path.join(folder, "sparse")):
        model = io.read_colmap(folder)
        for text in (True, False):
            model.cameras[1].params[:2] = (small, 30) if text else (30, small)
            io.write_colmap(model.folder, model, text=text)
            refused(folder, "focal length")
        return
    for name in {*os.listdir(folder)} & {"transforms.json", "transforms_train.json"}:
        edit_json(pathlib.Path(folder, name), lambda content: content.update(fl_x=small))
    refused(folder, "`fl_x`", "must be positive, 1e-09 at least")


@pytest.mark.parametrize("large", [1e300, -2e9])
def test_cameras_that_float32_cannot_hold(colmap_folder, large):
    model = io.read_colmap(colmap_folder)
    model.images[3].tvec[1] = large
    io.write_colmap(model.folder, model, text=True)
    refused(colmap_folder, "camera of view_003.png", "above 1e+09")
    model.images[3].tvec[1], model.cameras[1].params[2] = 0.0, large
    io.write_colmap(model.folder, model, text=True)
    refused(colmap_folder, "cx", "above 1e+09")


def test_points_that_are_not_finite():
    positions = np.zeros((5, 3))
    positions[3, 1] = math.nan
    with pytest.raises(SceneError, match="cloud.ply: point 3 .*NaN"):
        PointCloud(positions, np.zeros((5, 3))).checked("cloud.ply")
    positions[3, 1] = -1e39
    with pytest.raises(SceneError, match="cloud.ply: point 3 .*float32 cannot hold"):
        PointCloud(positions, np.zeros((5, 3))).checked("cloud.ply")


def without(key):
    return lambda content: content.pop(key)


def frame(**values):
    return lambda content: content["frames"][0].update(values)


@pytest.mark.parametrize("edit, words", [
    (without("frames"), ["list `frames`"]),
    (lambda content: content["frames"].clear(), ["`frames` is empty"]),
    (without("camera_angle_x"), ["camera_angle_x", "None"]),
    (lambda content: content.update(camera_angle_x="wide"), ["camera_angle_x", "wide"]),
    (lambda content: content.update(camera_angle_x=4.0), ["camera_angle_x", "4.0"]),
    (lambda content: content.update(k4=0.1), ["`k4` is 0.1; a lens of `camera_model` OPENCV has k1 k2 p1 p2 k3"]),
    (lambda content: content.update(k1=0.1, camera_model="EQUIRECTANGULAR"), ["`k1` is 0.1", "EQUIRECTANGULAR has no"]),
    (lambda content: content.update(p1=0.1, is_fisheye=True), ["`p1` is 0.1", "OPENCV_FISHEYE has k1 k2 k3 k4"]),
    (frame(camera_model="ORTHOPHOTO"), ["frame 0", "EQUIRECTANGULAR", "OPENCV_FISHEYE"]),
    (frame(mask_path="masks/none.png"), ["frame 0", "`mask_path`", "no such file"]),
    (lambda content: content.update(cx="middle"), ["cx", "middle"]),
    (frame(file_path=None), ["frame 0", "file_path"]),
    (frame(file_path="./train/r_9"), ["r_9.png", "no such image"]),
    (frame(transform_matrix=[[1, 2], [3, 4]]), ["frame 0", "transform_matrix"]),
    (frame(transform_matrix=[[1, 0, 0, 0]] * 3 + [[0, 0, 0, "x"]]), ["frame 0", "transform_matrix"]),
    (frame(transform_matrix=np.eye(4)[[3, 0, 1, 2]].tolist()), ["frame 0", "last row", "must be 0, 0, 0, 1"]),
    (frame(camera_model=""), ["frame 0", "`camera_model` is ''", "OPENCV"]),
    (frame(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), ["frame 0", "rotation"]),
    (frame(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()), ["frame 0", "mirrors", "rotation"]),
    (frame(transform_matrix=[[10**400] * 4] * 4), ["frame 0", "transform_matrix"]),
    (lambda content: content.update(camera_angle_x=True), ["camera_angle_x", "True"]),
    (lambda content: content.update(w="32"), ["`w`", "'32'", "number"]),
    (lambda content: content.update(w=0), ["`w` is 0", "positive"]),
    (lambda content: content.update(h=-10), ["`h` is -10", "positive"]),
    (lambda content: content.update(w=20.5), ["`w` is 20.5", "whole"]),
    (frame(fl_x=0), ["frame 0", "`fl_x` is 0", "positive"]),
    (frame(fl_x=20, fl_y=-20), ["`fl_y` is -20", "positive"]),
    (frame(fl_x=True), ["`fl_x` is True", "number"]),
    (frame(fl_x=10**400), ["`fl_x`", "number of at most 1e+09"]),
    (frame(fl_x=None), ["`fl_x` is None", "number"]),
    (lambda content: content.update(camera_angle_x=5e-324), ["camera_angle_x", "5e-324"]),
    (lambda content: content.update(w=1, h=1e308), ["`h` is 1e+308", "at most 1e+09"]),
    (frame(transform_matrix=np.diag([1e200, 1e200, 1, 1]).tolist()), ["frame 0", "at most 1e+09"]),
    (frame(file_path="./train/\x1b[2J\n\u202e"), ["train/\\x1b[2J\\n\\u202e.png: no such image"]),
    (frame(transform_matrix="DEEP"), ["transforms_train.json: not valid json"]),
])
def test_a_wrong_json(nerf_folder, edit, words):
    path = nerf_folder / "transforms_train.json"
    edit_json(path, edit)
    path.write_text(path.read_text().replace('"DEEP"', "[" * 100_000 + "]" * 100_000))
    refused(nerf_folder, *words)


def test_what_is_no_json(nerf_folder):
    (nerf_folder / "transforms_test.json").write_text('{"frames": [')
    refused(nerf_folder, "transforms_test.json", "not valid json")
    (nerf_folder / "transforms_test.json").write_text("[1, 2]")
    refused(nerf_folder, "transforms_test.json", "frames")
