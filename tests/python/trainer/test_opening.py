"""What `dsmoe render`, `export` and `view` open: files of four formats, and model folders of 3DGS."""
from __future__ import annotations

import dataclasses
import os
import shutil

import numpy as np
import pytest
from PIL import Image

from diff_smoe_rasterization import io
from dsmoe.cli import main
from dsmoe.inspection import open_trained, to_image
from dsmoe.options.config import TrainConfig
from dsmoe.results.glb import glb_bytes
from dsmoe.results.modelfile import load_model
from dsmoe.scenes.scene import load_scene
from dsmoe.starting import find_model, read_start
from dsmoe.view.following import Followed

ENDINGS = ("ply", "splat", "spz", "glb")
COLOUR = 0.28209479177387814  # of degree 0: 1 / (2 sqrt(pi))


@pytest.fixture
def model():
    """A cloud whose numbers a .splat and, but for colours, an .spz hold exactly: n/255, n/16, and no rotation."""
    random, count = np.random.RandomState(0), 60
    opacities = random.randint(30, 220, (count, 1)) / 255
    arrays = {"means3D": random.randint(-64, 65, (count, 3)) / 64, "shs": np.zeros((count, 0, 3)),
              "dc": (random.randint(0, 256, (count, 1, 3)) / 255 - 0.5) / COLOUR,
              "opacity_logits": np.log(opacities / (1 - opacities)), "rotations": np.tile([1.0, 0, 0, 0], (count, 1)),
              "log_scales": random.randint(-40, -24, (count, 3)) / 16}
    return io.Gaussians(**{name: np.asarray(array, np.float32) for name, array in arrays.items()}, blend_mode="alpha")


def exported(model, folder, ending):
    """The model as a file of this kind. The .ply is written without a record."""
    if ending == "spz":
        pytest.importorskip("gsply", reason="pip install gsply")
    ply, path = str(folder / "model.ply"), str(folder / f"model.{ending}")
    io.write_gaussians(ply, dataclasses.replace(model, blend_mode=None))
    assert ending == "ply" or main(["export", ply, "-o", path]) == 0
    return path


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_format_is_rendered_exported_and_viewed(model, tiny_scene, tmp_path, ending):
    """As the model. A colour has 1.9 of 255 levels between two of .spz, and an image is rounded: 2 levels."""
    path, folder, copy = exported(model, tmp_path, ending), str(tmp_path / "images"), str(tmp_path / "copy.ply")
    camera = load_scene(TrainConfig(scene=tiny_scene), progress=False).test[0].camera
    expected = np.asarray(to_image(open_trained(exported(model, tmp_path, "ply")).renderer(camera).color), int)
    assert expected.std() > 20
    assert main(["render", path, "--scene", tiny_scene, "-o", folder]) == 0
    assert main(["export", path, "-o", copy]) == 0
    images = [np.asarray(Image.open(os.path.join(folder, camera.name)), int),
              np.asarray(to_image(open_trained(copy).renderer(camera).color), int),
              np.asarray(to_image(Followed(path).renderer(camera).color), int)]
    for image in images:
        assert np.abs(image - expected).max() <= 2
    assert io.read_gaussians(copy).blend_mode == ("alpha" if ending == "glb" else None), "what nobody said stays open"
    assert ending == "glb" or main(["render", copy, "--scene", tiny_scene, "--paper", "-o", folder + "_paper"]) == 0


@pytest.mark.parametrize("ending", ENDINGS[:3])
@pytest.mark.parametrize("words, blend", [
    (["--blend-mode", "smoe", "--background-gate", "0.25"], ("smoe", 0.25, None)), (["--paper"], ("smoe", 0, 2)),
    (["--blend-mode", "smoe", "--background-gate", "0", "--faint-below", "0.123456789"], ("smoe", 0, 0.123456789))])
def test_a_file_without_a_record_is_declared_by_the_options(model, tiny_scene, tmp_path, capsys, ending, words, blend):
    """A .glb always says how it is blended. None: as usual."""
    path, declared = exported(model, tmp_path, ending), str(tmp_path / "declared.ply")
    assert main(["export", path, "-o", declared, *words]) == 0
    assert load_model(declared, "cpu")[1] == blend
    for name, source in (("images", [path, *words]), ("same", [declared])):
        assert main(["render", *source, "--scene", tiny_scene, "-o", str(tmp_path / name)]) == 0
    one, same = ((tmp_path / name / "view_000.png").read_bytes() for name in ("images", "same"))
    assert one == same
    viewed = Followed(path, blend[0], blend[1], faint_below=blend[2]).renderer
    assert (viewed.blend_mode, viewed.background_gate, viewed.faint_below) == blend
    for source, wrong, said in (
            (path, ["--blend-mode", "smoe"], f"{path} does not say which background gate it was trained with; pass"),
            (declared, ["--faint-below", "0.5"], f"its faint_below is {float(blend[2] or 0.25)}, not 0.5"),
            (declared, ["--faint-below", "0.1234567"], f"is {float(blend[2] or 0.25)}, not 0.1234567\n"),
            (path, ["--faint-below", "0.5"], "in the blend mode alpha its faint_below is 2.0, not 0.5"),
            (path, ["--paper", "--faint-below", "0.5"], "--faint-below is 0.5; with --paper it is 2"),
            (path, ["--blend-mode", "smoe", "--background-gate", "0", "--faint-below", "-1"], "faint_below is -1")):
        capsys.readouterr()
        assert main(["render", source, "--scene", tiny_scene, "-o", str(tmp_path / "no"), *wrong]) == 1
        assert said in capsys.readouterr().err and not (tmp_path / "no").exists()


def test_a_glb_is_of_alpha_unless_it_says_otherwise(model, tmp_path, capsys):
    path = tmp_path / "other.glb"
    path.write_bytes(glb_bytes(model, None))
    assert main(["export", str(path), "-o", str(tmp_path / "no.ply"), "--blend-mode", "smoe"]) == 1
    assert "was trained with the blend mode alpha, not smoe" in capsys.readouterr().err
    assert not (tmp_path / "no.ply").exists()


def test_a_model_folder_of_3dgs_says_where_its_scene_is(model, tiny_scene, tmp_path, capsys, monkeypatch):
    ply, folder = exported(model, tmp_path, "ply"), tmp_path / "model"
    for iteration in (7000, 30000):
        place = folder / "point_cloud" / f"iteration_{iteration}"
        place.mkdir(parents=True)
        shutil.copyfile(ply, place / "point_cloud.ply")
    said = "Namespace(white_background=True, resolution=30, source_path=%r)"
    (folder / "cfg_args").write_text(said % str(tiny_scene))
    assert main(["render", str(folder), "-o", str(tmp_path / "a")]) == 0
    assert main(["render", ply, "--scene", tiny_scene, "--resolution", "30", "--white-background", "-o",
                 str(tmp_path / "b")]) == 0
    images = [name for name in os.listdir(tmp_path / "a") if name.endswith(".png")]
    assert images and all((tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
                          for name in images)
    assert Followed(str(folder)).renderer.background.tolist() == [1, 1, 1]
    assert main(["export", str(folder), "-o", str(tmp_path / "page.html")]) == 0
    (folder / "cfg_args").write_text(said % "nowhere")
    nowhere = f"{os.path.abspath('nowhere')} or {folder / 'nowhere'}"
    capsys.readouterr()
    assert main(["render", str(folder), "-o", str(tmp_path / "no")]) == 1
    assert capsys.readouterr().err.endswith(
        f"{folder} holds no cameras, and the scene that it names, {nowhere}, is not there; name the folder that "
        "has them with --scene\n")
    assert main(["simplify", str(folder), "--keep", "0.5", "-o", str(tmp_path / "no")]) == 1
    assert f"the scene that its folder names, {nowhere}, is not there, and the folder has no cameras.json; name its " \
           "scene with --scene" in capsys.readouterr().err
    assert main(["export", str(folder), "-o", str(tmp_path / "gone.html")]) == 0
    assert f"note: the scene that {folder} names, {nowhere}, is not there" in capsys.readouterr().err
    (folder / "cfg_args").write_text(said % "there")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for place in (folder / "there", tmp_path / "here" / "there"):  # the second counts more
        shutil.copytree(tiny_scene, place)
        assert find_model(str(folder)).options["scene"] == str(place)
    shutil.rmtree(folder / "point_cloud")
    for command in (["render"], ["view"], ["export"]):
        assert main([*command, str(folder), *["-o", str(tmp_path / "no.html")][:2 * (command != ["view"])]]) == 1
        assert "no model is in it: neither config.json of `dsmoe train` nor" in capsys.readouterr().err


def in_model_folder(model, tmp_path, cfg_args):
    """The path of the model, which records no blend, in a model folder of 3DGS whose trainer was given these."""
    place = tmp_path / "model" / "point_cloud" / "iteration_7"
    place.mkdir(parents=True)
    (tmp_path / "model" / "cfg_args").write_text(f"Namespace({cfg_args})")
    return shutil.copyfile(exported(model, tmp_path, "ply"), place / "point_cloud.ply")


def test_a_model_folder_trained_on_all_images_shows_its_training_views(model, tiny_scene, tmp_path, capsys):
    in_model_folder(model, tmp_path, f"eval=False, source_path={str(tiny_scene)!r}")
    words = ["render", str(tmp_path / "model"), "-o", str(tmp_path / "images")]
    assert main([*words, "--split", "test"]) == 1 and "has no test views" in capsys.readouterr().err
    assert main(words) == 0
    assert "eval=False in cfg_args); these are its training views" in capsys.readouterr().err
    every = load_scene(TrainConfig(scene=tiny_scene, test_every=0), progress=False).train
    assert {view.camera.name for view in every} <= {*os.listdir(tmp_path / "images")}


@pytest.mark.parametrize("said, blend", [
    ("blend_mode='paper', background_gate=''", ("smoe", 0, 2)),
    ("blend_mode='smoe', background_gate=0.25, faint_below=None", ("smoe", 0.25, None)),
    ("blend_mode='smoe_eq7', background_gate=''", ("smoe_eq7", 0, None)), ("blend_mode='other'", ("alpha", 1, None))])
def test_cfg_args_says_how_a_file_without_a_record_is_blended(model, tiny_scene, tmp_path, said, blend):
    """None: as usual. What the file itself records counts more."""
    copy, ply = str(tmp_path / "copy.ply"), in_model_folder(model, tmp_path, f"{said}, source_path={str(tiny_scene)!r}")
    opened = open_trained(str(tmp_path / "model")).renderer
    assert (opened.blend_mode, opened.background_gate, opened.faint_below) == blend
    start = read_start(str(ply))
    assert (start.blend_mode, start.background_gate, start.faint_below) == blend
    assert main(["export", str(tmp_path / "model"), "-o", copy]) == 0
    assert io.read_gaussians(copy).blend_mode == (None if "other" in said else blend[0])
    io.write_gaussians(str(ply), dataclasses.replace(model, blend_mode="smoe_std"))
    assert open_trained(str(tmp_path / "model")).renderer.blend_mode == "smoe_std"


def test_a_learned_gate_that_no_file_records_is_asked_for(model, tiny_scene, tmp_path, capsys):
    declared, cfg_args = str(tmp_path / "declared.ply"), tmp_path / "model" / "cfg_args"
    said = f"blend_mode='smoe', background_gate='learned', source_path={str(tiny_scene)!r}"
    ply, text = in_model_folder(model, tmp_path, said), cfg_args.read_text()
    for words in (["render", "-o", str(tmp_path / "no")], ["simplify", "--keep", "1", "-o", str(tmp_path / "no")]):
        assert main([words[0], str(tmp_path / "model"), *words[1:]]) == 1
        assert "with a learned background gate, but not its value; declare it" in capsys.readouterr().err
    assert main(["export", str(ply), "-o", declared, "--blend-mode", "smoe", "--background-gate", "0.125"]) == 0
    assert load_model(declared, "cpu")[1] == ("smoe", 0.125, None)
    cfg_args.write_text(text.replace("source", "faint_below=1.5, source"))
    for words, wrong in ((["--blend-mode", "alpha"], "was trained with the blend mode smoe, not alpha"),
                         (["--background-gate", "0.125", "--faint-below", "3"], "its faint_below is 1.5, not 3.0")):
        assert main(["export", str(tmp_path / "model"), "-o", str(tmp_path / "no.html"), *words]) == 1
        assert wrong in capsys.readouterr().err
    assert main(["export", str(ply), "-o", declared, "--background-gate", "0.5", "--overwrite"]) == 0
    assert load_model(declared, "cpu")[1] == ("smoe", 0.5, 1.5), "the folder says the rest"
    cfg_args.write_text(text.replace("'learned'", "'much'"))
    assert main(["render", str(tmp_path / "model"), "-o", str(tmp_path / "no")]) == 1
    assert "cfg_args: of the blend smoe it records the background gate 'much'" in capsys.readouterr().err


@pytest.mark.parametrize("ending, content, words", [
    ("splat", bytes(33), "33 bytes; a .splat has 32 for each Gaussian"), ("glb", b"glTF", "not a .glb of Gaussians"),
    ("ksplat", bytes(64), "it is none of .ply, .splat, .spz and .glb"), ("ply", bytes(64), "this is no PLY file"),
    ("ply", b"", 'it has 0 bytes, so this is no PLY file, whose first line is "ply"'),
    ("ply", b"ply\nformat ascii 1.0\nend_header\n", 'no element "vertex"; it is not a model of Gaussians')])
def test_what_is_no_model_is_named_by_every_command(tiny_scene, tmp_path, capsys, ending, content, words):
    path = tmp_path / f"model.{ending}"
    path.write_bytes(content)
    for command in (["render", "-o", str(tmp_path / "no"), "--scene", tiny_scene], ["view"],
                    ["export", "-o", str(tmp_path / "no.html")]):
        assert main([command[0], str(path), *command[1:]]) == 1
        said = capsys.readouterr().err
        assert str(path) in said and words in said and said.count("\n") == 1
