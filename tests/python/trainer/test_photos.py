"""Photographs to a scene by COLMAP: real ones find their known places, and what goes wrong is said."""
from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from real_data import folder
from scipy.spatial.transform import Rotation

from diff_smoe_rasterization import io
from dsmoe import photos
from dsmoe.cli import main
from dsmoe.errors import SceneError
from dsmoe.options.config import TrainConfig
from dsmoe.scenes.scene import load_scene
from dsmoe.system.output_folder import Record, write_record


def fails(capsys, *words):
    """Runs `dsmoe scene`, which must fail with one line on stderr; returns that."""
    assert main(["scene", *map(str, words), "--quiet"]) == 1
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text


def poses_of(scene):
    """{name: (rotation, centre)} of a COLMAP scene."""
    poses = {}
    for image in io.read_colmap(scene).images:
        w, x, y, z = image.qvec
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        poses[image.name] = rotation, -rotation.T @ image.tvec
    return poses


@pytest.mark.slow
def test_photographs_of_bonsai_find_their_places(tmp_path, capsys):
    """Against the poses of the data set, which COLMAP found with all 292 photographs, up to a similarity."""
    pytest.importorskip("pycolmap", reason="pip install pycolmap")
    bonsai, pictures, scene = folder("bonsai"), tmp_path / "photos", tmp_path / "scene"
    os.makedirs(pictures / "walk")
    names = sorted(os.listdir(os.path.join(bonsai, "images")))[:10]
    for name in names:
        shutil.copy(os.path.join(bonsai, "images", name), pictures / "walk" / name)
    (pictures / "notes.txt").write_text("not a photograph")
    assert main(["scene", str(pictures), "-o", str(scene), "--quiet"]) == 0
    text = capsys.readouterr().out
    assert "10 photographs of one camera" in text and "comparing all 45 pairs" in text
    assert "\n10 of 10 photographs are placed; " in text and "mean reprojection error 0." in text
    assert text.splitlines()[-1].endswith(f"train {scene} -o MODEL --fast --resolution 2")
    given, found = poses_of(bonsai), {name[len("walk/"):]: pose for name, pose in poses_of(str(scene)).items()}
    assert sorted(found) == names
    theirs, ours = (np.stack([poses[name][1] for name in names]) for poses in (given, found))
    (rotation, scale), middle = similarity(ours, theirs), theirs.mean(axis=0)
    moved = scale * (ours - ours.mean(axis=0)) @ rotation.T + middle
    spread = np.linalg.norm(theirs - middle, axis=1).max()
    # 12 of these photographs gave 0.4 % and 0.6 degrees, with another focal length by 1 %. A wrong axis would be 100 %.
    assert np.linalg.norm(moved - theirs, axis=1).max() < 0.02 * spread
    turns = [Rotation.from_matrix(given[name][0] @ rotation @ found[name][0].T).magnitude() for name in names]
    assert np.degrees(max(turns)) < 1.5
    loaded = load_scene(TrainConfig(scene=str(scene)), progress=False)
    assert (len(loaded.train), len(loaded.test), loaded.note) == (8, 2, "") and len(loaded.points.positions) > 500
    database = scene / "colmap" / "database.db"
    assert photos._count_rows(str(database), "descriptors") == 10, "what the progress bar shows"
    before = database.stat().st_size
    assert main(["scene", str(pictures), "-o", str(scene), "--quiet"]) == 0  # with the features that are there
    assert database.stat().st_size == before and sorted(poses_of(str(scene))) == [f"walk/{name}" for name in names]
    other = shutil.copytree(pictures, tmp_path / "other")
    assert f"holds the scene of other photographs, {pictures}" in fails(capsys, other, "-o", scene)


def similarity(ours, theirs):
    """The rotation and the scale that take points [N, 3] to others best, about their means (Umeyama)."""
    ours, theirs = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    u, s, v = np.linalg.svd(theirs.T @ ours)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ v))])
    return u @ np.diag(signs) @ v, float((s * signs).sum() / (ours**2).sum())


def test_photographs_that_do_not_connect(tmp_path, capsys):
    pytest.importorskip("pycolmap", reason="pip install pycolmap")
    random = np.random.RandomState(0)
    for index in range(4):
        Image.fromarray(random.randint(0, 255, (60, 80, 3), np.uint8)).save(tmp_path / f"{index}.png")
    text = fails(capsys, tmp_path, "-o", tmp_path / "scene", "--matching", "sequential")
    assert "only 0 of 4 photographs connect" in text
    assert "try --matching exhaustive" in text and "walk around" in text and "the same command again" in text
    assert not (tmp_path / "scene" / "sparse").exists()


def test_features_are_found_anew_where_photographs_have_changed(tmp_path):
    """A photograph that has changed under its name, that has gone, or another camera model; one more is welcome."""
    pytest.importorskip("pycolmap", reason="pip install pycolmap")
    random, pictures, said = np.random.RandomState(0), tmp_path / "photos", []
    pictures.mkdir()

    def picture(name, size=(80, 60)):
        Image.fromarray(random.randint(0, 255, (*size[::-1], 3), np.uint8)).save(pictures / name)

    def features(camera_model="OPENCV"):
        """The descriptors that COLMAP has by name, and whether it found all of them anew."""
        said.clear()
        with pytest.raises(SceneError, match="connect"):
            photos.make_scene(str(pictures), str(tmp_path / "scene"), camera_model=camera_model, progress=False,
                              say=said.append)
        with contextlib.closing(sqlite3.connect(tmp_path / "scene" / "colmap" / photos.DATABASE)) as database:
            found = dict(database.execute("SELECT name, data FROM images JOIN descriptors USING (image_id)"))
        return found, said[0].startswith("photographs or camera model have changed")

    for index in range(4):
        picture(f"{index}.png")
    first, anew = features()
    assert len(first) == 4 and not anew
    assert features() == (first, False)
    picture("0b.png")
    more, anew = features()
    assert {*more} - {*first} == {"0b.png"} and not anew
    before = os.stat(pictures / "2.png")
    picture("2.png")
    os.utime(pictures / "2.png", ns=(before.st_atime_ns, before.st_mtime_ns))
    changed, anew = features()
    assert more["2.png"] != changed["2.png"] and anew  # COLMAP 4.2 may differ in those of equal pictures too
    (pictures / "3.png").unlink()
    fewer, anew = features()
    assert {*more} - {*fewer} == {"3.png"} and anew
    assert features("PINHOLE")[1] and not features("PINHOLE")[1]
    (tmp_path / "scene" / "colmap" / photos.FEATURES).write_text("damaged")
    assert features("PINHOLE")[1]


def test_an_interrupted_command_says_that_it_continues(tmp_path, capsys, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(photos, "make_scene", interrupted)
    assert main(["scene", str(tmp_path), "-o", str(tmp_path / "scene")]) == 130
    assert capsys.readouterr().err.endswith("interrupted; the same command continues\n")


def test_what_is_no_folder_of_photographs(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)  # it is asked for later
    assert "nowhere: no such folder of photographs" in fails(capsys, tmp_path / "nowhere", "-o", tmp_path / "scene")
    (tmp_path / "walk.mp4").write_text("")
    assert "ffmpeg -i VIDEO" in fails(capsys, tmp_path / "walk.mp4", "-o", tmp_path / "scene")
    (tmp_path / "1.jpg").write_text("")
    text = fails(capsys, tmp_path / "1.jpg", "-o", tmp_path / "scene")
    assert f"1.jpg is a file; name the folder of the photographs, such as {tmp_path}\n" in text
    (tmp_path / "1.jpg").unlink()
    (tmp_path / "link").symlink_to(tmp_path)
    for scene in (tmp_path, tmp_path / "link", tmp_path.parent, tmp_path / "."):
        assert "lies in" in fails(capsys, tmp_path, "-o", scene)
    (tmp_path / "link").unlink()
    (tmp_path / "IMG_1.HEIC").write_text("")
    text = fails(capsys, tmp_path, "-o", tmp_path / "scene")
    assert "0 photographs" in text and "at least 3" in text and "IMG_1.HEIC is of a kind that COLMAP does not" in text
    monkeypatch.setitem(sys.modules, "pycolmap", sys)
    for index in range(3):
        Image.new("RGB", (8, 8)).save(tmp_path / f"{index}.JPG")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("")
    assert "mine is not empty (letter.txt)" in fails(capsys, tmp_path, "-o", tmp_path / "mine")
    (tmp_path / "own" / "colmap").mkdir(parents=True)
    (tmp_path / "own" / "colmap" / "models").symlink_to(tmp_path / "mine")  # whose content a second run removes
    write_record(str(tmp_path / "own"), photos.SCENE, Record(str(tmp_path), []), [])
    assert f"models leads to {tmp_path / 'mine'} by a link" in fails(capsys, tmp_path, "-o", tmp_path / "own")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert "pip install pycolmap" in fails(capsys, tmp_path, "-o", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_what_reading_would_wait_for_is_refused(tmp_path, capsys, monkeypatch):
    """A pipe, and links to a device and to nothing, each with the name of a photograph."""
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for index in range(3):
        Image.new("RGB", (8, 8)).save(tmp_path / f"{index}.png")
    strange = tmp_path / "a.png"
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero"), lambda path: path.symlink_to("nothing")):
        make(strange)
        assert f"{strange}: cannot be read as a file (a pipe, " in fails(capsys, tmp_path, "-o", tmp_path / "scene")
        strange.unlink()
    (tmp_path / "b.png").symlink_to("0.png")
    assert "pip install pycolmap" in fails(capsys, tmp_path, "-o", tmp_path / "scene")


@pytest.mark.parametrize("where", ["photograph", "folder", "output"])
def test_a_name_that_is_no_utf_8_is_refused_in_a_line(where, tmp_path, capsys, monkeypatch):
    """COLMAP's files hold names as UTF-8."""
    monkeypatch.setitem(sys.modules, "pycolmap", sys)
    odd = os.fsdecode(b"a\xff")
    photographs, output = (os.path.join(tmp_path, odd if where == name else name) for name in ("folder", "output"))
    os.mkdir(photographs)
    for name in ("0", "1", odd if where == "photograph" else "2"):
        Image.new("RGB", (8, 8)).save(os.path.join(photographs, f"{name}.png"))
    assert "a\\udcff" in (text := fails(capsys, photographs, "-o", output)) and "only names that are UTF-8" in text


def test_a_video_among_photographs_gets_the_line_of_ffmpeg(tmp_path):
    said = []
    for name in ("walk.MOV", "0.jpg", "1.jpg"):
        (tmp_path / name).write_text("")
    with pytest.raises(SceneError, match="2 photographs .* are needed; walk.MOV is a video; of a video .* ffmpeg -i"):
        photos.photo_names(str(tmp_path), str(tmp_path / "scene"), said.append)
    (tmp_path / "2.jpg").write_text("")
    assert len(photos.photo_names(str(tmp_path), str(tmp_path / "scene"), said.append)) == 3
    assert len(said) == 1 and said[0].startswith("note: walk.MOV is a video; ") and said[0].endswith("it is left out")


def test_hidden_files_and_the_scene_itself_are_no_photographs(tmp_path):
    for name in ("a.jpg", "walk/b.PNG", "walk/._b.jpg", ".thumbnails.jpg", "scene/images/a.jpg", "scenery/c.jpg"):
        os.makedirs((tmp_path / name).parent, exist_ok=True)
        (tmp_path / name).write_text("")
    assert photos.photo_names(str(tmp_path), str(tmp_path / "scene")) == ["a.jpg", "scenery/c.jpg", "walk/b.PNG"]


def save_photograph(path, size, focal=None):
    """focal: millimetres, which alone tell COLMAP nothing."""
    exif = Image.Exif()
    if focal:
        exif.get_ifd(photos.EXIF)[photos.FOCAL_LENGTH] = focal
    Image.new("RGB", size).save(path, exif=exif)


def test_photographs_are_of_one_camera_if_size_and_focal_length_say_so(tmp_path):
    for name, size, focal in (("a.jpg", (8, 6), 24.0), ("b.jpg", (8, 6), 24.0), ("c.jpg", (8, 6), 50.0),
                              ("d.jpg", (6, 8), 24.0), ("e.jpg", (6, 8), None)):
        save_photograph(tmp_path / name, size, focal)
    names = ["a.jpg", "c.jpg", "d.jpg", "b.jpg", "e.jpg"]
    said = []
    assert photos._by_camera(str(tmp_path), ["a.jpg", "d.jpg"], 90.0, said.append) == [["a.jpg"], ["d.jpg"]]
    four = [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"], ["e.jpg"]]
    assert photos._by_camera(str(tmp_path), names, None, said.append) == four and not said
    assert photos._by_camera(str(tmp_path), names, 90.0, said.append) == four
    note, = said
    assert "several focal lengths (24 mm, 50 mm, none), and each camera starts from --fov 90; without" in note


class FakeModel:
    """What `make_scene` asks of COLMAP's model, whose files are those of a folder."""

    def __init__(self, names):
        self.images = {index: SimpleNamespace(name=name) for index, name in enumerate(names)}

    def reg_image_ids(self):
        return [*self.images]

    def num_points3D(self):
        return 4

    def compute_mean_reprojection_error(self):
        return 0.5


def scene_of_fake(monkeypatch, tmp_path, k1, *words):
    """Runs `dsmoe scene` where COLMAP's part found a lens of this k1 in two of three photographs; returns the scene."""
    pictures, scene = tmp_path / "photos", tmp_path / "scene"
    os.makedirs(pictures / "walk", exist_ok=True)
    for index in range(3):
        Image.new("RGB", (80, 60), (9 * index, 9, 9)).save(pictures / "walk" / f"{index}.png")
    names = ["walk/0.png", "walk/2.png"]

    def placed(pycolmap, photographs, found, work, *rest):
        cameras = {1: io.ColmapCamera(1, "OPENCV", 80, 60, np.array([60.0, 60, 40, 30, k1, 0, 0, 0]))}
        images = [io.ColmapImage(index + 1, name, 1, np.array([1.0, 0, 0, 0]), np.zeros(3))
                  for index, name in enumerate(names)]
        shutil.rmtree(os.path.join(work, "best"), ignore_errors=True)
        io.write_colmap(os.path.join(work, "best"), io.ColmapModel(
            cameras, images, io.Points(np.random.RandomState(0).normal(0, 1, (4, 3)), np.zeros((4, 3), np.uint8))))
        return FakeModel(names)

    def undistort_images(made, found, photographs, cancellation_token):
        shutil.copytree(found, os.path.join(made, "sparse"))
        os.makedirs(os.path.join(made, "images", "walk"))
        for name in names:
            Image.new("RGB", (78, 58)).save(os.path.join(made, "images", name))

    monkeypatch.setattr(photos, "_placed", placed)
    monkeypatch.setitem(sys.modules, "pycolmap", SimpleNamespace(
        logging=SimpleNamespace(minloglevel=0, ERROR=SimpleNamespace(value=2)), undistort_images=undistort_images,
        CancellationToken=SimpleNamespace))
    assert main(["scene", str(pictures), "-o", str(scene), "--quiet", *words]) == 0
    return pictures, scene


@pytest.mark.parametrize("k1, words, kept, options", [
    (-0.3, [], True, ""), (-0.02, [], False, ""), (-0.02, ["--lenses", "native"], True, " --lenses native"),
    (0.3, ["--lenses", "native"], True, " --lenses native"), (-0.3, ["--lenses", "undistort"], False, "")])
def test_a_strong_lens_is_kept(tmp_path, monkeypatch, capsys, k1, words, kept, options):
    """The photographs as they are and the lens that was found, which `dsmoe train` then keeps by the line printed."""
    pictures, scene = scene_of_fake(monkeypatch, tmp_path, k1, *words)
    text = capsys.readouterr().out
    assert ("keeping the lens; without it " in text) == kept and ("undistorting" in text) != kept
    assert text.splitlines()[-1].endswith(options) and text.count("--lenses") == bool(options)
    assert "2 of 3 photographs are placed (left out: walk/1.png)" in text
    for name in ("walk/0.png", "walk/2.png"):
        same = (scene / "images" / name).read_bytes() == (pictures / name).read_bytes()
        assert same == kept
    assert not (scene / "images" / "walk" / "1.png").exists()
    if kept:
        config = TrainConfig(scene=str(scene), lenses="native" if options else "auto", test_every=0)
        camera = load_scene(config, progress=False).train[0].camera
        assert camera.lens.camera_model == "opencv" and camera.lens.coefficients[0] == k1
        scene_of_fake(monkeypatch, tmp_path, k1, "--lenses", "undistort")
        assert (scene / "images" / "walk" / "0.png").read_bytes() != (pictures / "walk" / "0.png").read_bytes()


def test_a_photograph_that_training_cannot_read_is_named(tmp_path, monkeypatch, capsys):
    os.makedirs(tmp_path / "photos" / "walk")
    Image.fromarray(np.zeros((60, 80), np.uint16)).save(tmp_path / "photos" / "walk" / "3.png")
    with monkeypatch.context() as patch:
        scene_of_fake(patch, tmp_path, -0.3)
    with pytest.raises(SceneError, match="walk/3.png: cannot be kept as it is .* 8 bits.*; or take --lenses undistort"):
        photos._keep(str(tmp_path / "photos"), ["walk/3.png"], str(tmp_path / "scene" / "colmap" / "best"),
                     str(tmp_path / "made"))


def test_what_colmap_starts_from(tmp_path):
    """Of 80 pixels across: 40 are half of 150 degrees of a fisheye, and half of 90 of any other camera."""
    def guess(camera_model, fov=None, name="a.jpg", prior=False):
        colmap = SimpleNamespace(ImageReaderOptions=SimpleNamespace, CancellationToken=SimpleNamespace,
                                 infer_camera_from_image=lambda *_: SimpleNamespace(has_prior_focal_length=prior))
        return photos._camera_guess(colmap, str(tmp_path / name), camera_model, fov)

    save_photograph(tmp_path / "a.jpg", (80, 60))
    save_photograph(tmp_path / "b.jpg", (60, 80), focal=24.0)
    assert guess("OPENCV") == guess("EQUIRECTANGULAR") == guess("FOV") == guess("OPENCV_FISHEYE", prior=True) == ""
    for name, center in (("a.jpg", [40, 30]), ("b.jpg", [30, 40])):
        fisheye = [float(number) for number in guess("OPENCV_FISHEYE", name=name).split(",")]
        assert fisheye == pytest.approx([40 / np.radians(75)] * 2 + [*center, 0, 0, 0, 0], rel=1e-5)
    assert guess("OPENCV", 90.0) == "40,40,40,30,0,0,0,0" and guess("SIMPLE_RADIAL", 90.0, "b.jpg") == "40,30,40,0"
    for camera_model, fov, words in (("OPENCV", 175.0, "must be between 1 and 170 degrees"),
                                     ("OPENCV_FISHEYE", 350.0, "between 1 and 340"), ("OPENCV", np.nan, "nan; for"),
                                     ("EQUIRECTANGULAR", 90.0, "must be left out: it is 360 degrees")):
        with pytest.raises(SceneError, match=f"--fov is .*{words}"):
            guess(camera_model, fov)
    with pytest.raises(SceneError, match=r"camera model is FOV, of which .* one of SIMPLE_.*, or without .* \(fov\)$"):
        guess("FOV", 90.0)
    with pytest.raises(SceneError, match="is RAD_TAN_THIN_PRISM_FISHEYE, of which .* EQUIRECTANGULAR$"):
        guess("RAD_TAN_THIN_PRISM_FISHEYE")


def test_each_size_of_fisheye_photographs_has_its_guess(tmp_path):
    """One portrait among others: COLMAP has a camera for each size, of the same focal length."""
    pytest.importorskip("pycolmap", reason="pip install pycolmap")
    (tmp_path / "photos").mkdir()
    for name, size in (("a.jpg", (80, 60)), ("b.jpg", (60, 80)), ("c.jpg", (80, 60))):
        save_photograph(tmp_path / "photos" / name, size, focal=3.0)
    with pytest.raises(SceneError, match="only 0 of 3 photographs connect"):
        photos.make_scene(str(tmp_path / "photos"), str(tmp_path / "scene"), camera_model="OPENCV_FISHEYE",
                          progress=False)
    with contextlib.closing(sqlite3.connect(tmp_path / "scene" / "colmap" / photos.DATABASE)) as database:
        found = {(width, height): list(np.frombuffer(numbers)) for width, height, numbers in database.execute(
            "SELECT width, height, params FROM cameras")}
        assert database.execute("SELECT COUNT(*) FROM cameras").fetchone() == (2,)
    for size in ((80, 60), (60, 80)):
        assert found[size] == pytest.approx([40 / np.radians(75)] * 2 + [size[0] / 2, size[1] / 2, 0, 0, 0, 0],
                                            rel=1e-5), "of 6 digits"
