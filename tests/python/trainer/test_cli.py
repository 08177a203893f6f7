"""The `dsmoe` command from end to end, on a tiny ray-traced scene."""
from __future__ import annotations

import argparse
import dataclasses
import errno
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from io import BytesIO, TextIOWrapper

import numpy as np
import pytest
import torch
import unprivileged
from PIL import Image

import diff_smoe_rasterization
import dsmoe.__main__
from diff_smoe_rasterization import io
from dsmoe import cli, inspection
from dsmoe.cli import main
from dsmoe.options.config import TrainConfig
from dsmoe.options.config_arguments import GROUPS
from dsmoe.results.modelfile import load_model
from dsmoe.results.rows import viewer_warning
from dsmoe.scenes.scene import load_scene
from dsmoe.training import forecast
from dsmoe.training.checkpoint import load_checkpoint, save_checkpoint
from dsmoe.training.trainer import Trainer

SHORT = ["--iterations", "12", "--strategy", "3dgs", "--densify-from-iter", "2", "--densify-until-iter", "10",
         "--densification-interval", "4", "--quiet"]
GATE = 0.25
SMOE = ["--blend-mode", "smoe_eq7", "--background-gate", str(GATE), *SHORT]  # how `trained` was


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return tiny_scene


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A finished smoe run."""
    output = str(tmp_path_factory.mktemp("run"))
    assert main(["train", scene, "-o", output, *SMOE]) == 0
    return output


def ply_of(output, iterations=12):
    return os.path.join(output, "point_cloud", f"iteration_{iterations}", "point_cloud.ply")


def results_of(output):
    with open(os.path.join(output, "results.json"), encoding="utf-8") as file:
        return json.load(file)


def fails(capsys, *arguments):
    """Runs a command that must fail with one line on stderr, which is returned."""
    capsys.readouterr()
    assert main(list(arguments)) == 1
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and "Traceback" not in text
    return text


def test_training_leaves_results_config_and_model(trained):
    row, = results_of(trained)
    assert {"blend_mode", "psnr", "ssim", "num_gaussians", "train_seconds", "fps", "protocol"} <= set(row)
    assert row["background_gate"] == GATE
    assert not {"background_gate_learned", "random_background", "masks"} & set(row["protocol"])
    assert row["blend_mode"] == "smoe_eq7" and 3 < row["psnr"] < 60 and 0 < row["ssim"] < 1
    assert row["train_seconds"] > 0 and row["fps"] > 0
    protocol = row["protocol"]
    assert (protocol["train_views"], protocol["test_views"], protocol["image_size"]) == (7, 2, [32, 24])
    for name in ("split", "resolution", "downscaler", "background", "principal_point", "strategy",
                 "densify_grad_threshold", "iterations", "seed", "machine", "versions"):
        assert name in protocol
    with open(ply_of(trained), "rb") as file:
        header = file.read(2000).split(b"end_header")[0].decode()
    assert "comment blend_mode smoe_eq7" in header
    assert int(re.search(r"element vertex (\d+)", header).group(1)) == row["num_gaussians"]


def test_paper_is_the_program_of_the_authors(scene, tmp_path, capsys):
    """smoe, gate 0, all pairs; the model's file and the row say so, and it is measured as it was trained."""
    output, other = str(tmp_path / "paper"), str(tmp_path / "usual")
    assert main(["train", scene, "-o", output, "--paper", *SHORT]) == 0
    assert "blend mode smoe (gate 0, all pairs), strategy 3dgs" in capsys.readouterr().out
    row, = results_of(output)
    assert (row["blend_mode"], row["background_gate"], row["protocol"]["faint_below"]) == ("smoe", 0, 2)
    assert load_model(ply_of(output), "cpu")[1] == ("smoe", 0, 2)
    assert main(["eval", output]) == 0 and results_of(output)[0]["psnr_float"] == row["psnr_float"]
    assert main(["train", scene, "-o", other, "--blend-mode", "smoe", "--background-gate", "0", *SHORT]) == 0
    usual, = results_of(other)
    assert usual["psnr_float"] != row["psnr_float"] and "faint_below" not in usual["protocol"]
    assert "--blend-mode is 'alpha'; with --paper it is 'smoe', or left out" in fails(
        capsys, "train", scene, "-o", other, "--paper", "--blend-mode", "alpha")


def test_training_says_what_it_loaded_and_what_comes_next(scene, tmp_path, capsys):
    output = str(tmp_path / "out put")
    assert main(["train", scene, "-o", output, "--resolution", "2", "--init-points", "50", *SHORT]) == 0
    lines = capsys.readouterr().out.splitlines()
    count = len(io.read_colmap(scene).points.positions)
    assert lines[0].startswith("device: cpu (") and lines[1].startswith(scene)
    assert lines[2] == ("7 training and 2 test images (sorted by name, every 8th is a test image), 16x12 (scaled from "
                        f"32x24 by --resolution 2) pixels, 50 of {count} points to start from")
    assert re.fullmatch(r"at this speed the other 1 iterations take about \d+ s, longer as .*", lines[3])
    assert lines[-2] == f"model: {ply_of(output)}"
    assert lines[-1].endswith(f"export '{output}' -o model.html")
    assert main(["train", scene, "-o", output, "--test-every", "0", "--overwrite", *SHORT]) == 0
    text = capsys.readouterr().out
    assert "9 training and 0 test images (no image is kept for testing), 32x24 pixels" in text
    assert "nothing was measured" in text
    for command in (["eval", output], ["render", output, "--split", "test", "-o", output + "_images"]):
        assert "has no test views; --split names others" in fails(capsys, *command)
    assert "--test-every is 1; it must be 0 or at least 2" in fails(capsys, "train", scene, "-o", output,
                                                                    "--test-every", "1")


def test_a_long_training_on_a_processor_is_told_with_a_shorter_one(scene, monkeypatch):
    config = TrainConfig(scene=scene, iterations=30_000)
    loaded = load_scene(config, progress=False)
    clock = iter([0.0, 5.0, 12.0, 25.0])
    monkeypatch.setattr(forecast.time, "monotonic", lambda: next(clock))
    told = forecast.Forecast(config, loaded)
    assert [told(iteration) for iteration in (1, 2, 3)] == [None] * 3
    line = told(4)  # three steps in 25 seconds: 29,996 take 69.4 hours
    assert line.startswith("at this speed the other 29,996 iterations take about 2.9 days, longer as ")
    assert line.endswith(" For a result in minutes on this CPU add: --overwrite --fast")
    assert told(5) is None, "it is said once"
    assert [forecast.duration(seconds) for seconds in (20, 600, 7200)] == ["20 s", "10 min", "2.0 h"]


def test_help_has_groups_and_a_wrong_mode_is_named_where_it_is_given(scene, capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = capsys.readouterr().out
    parts = re.split(r"\n(?=[a-z][a-zA-Z, ]*:\n)", text)
    assert [part.partition(":")[0] for part in parts[1:]] == ["positional arguments", "options", *GROUPS, "examples"]
    assert "--blend-mode" in parts[4] and "--feature-lr" in parts[7] and "dsmoe train garden -o" in parts[8]
    with pytest.raises(SystemExit):
        main(["train", scene, "-o", "out", "--blend-mode", "smo"])
    usage, error = capsys.readouterr().err.rsplit("\n", 2)[:2]
    assert usage.count("\n") <= 1, "the error is not behind a page of options"
    assert "argument --blend-mode: invalid choice: 'smo' (choose from" in error and "smoe_tn" in error
    with pytest.raises(SystemExit):
        main(["train", scene, "-o", "out", "--itertions", "5"])
    assert "unrecognized arguments: --itertions 5 (is --iterations meant?)" in capsys.readouterr().err


def test_the_whole_command_continues_a_training_of_several_processes(tiny_config, monkeypatch):
    end = f"train --resume -o {tiny_config.output}"
    by_torchrun = f"{end} (by torchrun, as before)"
    for processes, here, device, said in (("1", "1", "cpu", end), ("4", "4", "cuda", f"{end} --gpus 4"),
                                          ("8", "4", "cuda", by_torchrun), ("2", "2", "cpu", by_torchrun)):
        tiny_config.changed(device=device).save(tiny_config.output)
        monkeypatch.setenv("WORLD_SIZE", processes)
        monkeypatch.setenv("LOCAL_WORLD_SIZE", here)
        assert cli._resume_command(argparse.Namespace(command="train", output=tiny_config.output)).endswith(said)
    words = ["simplify", "a b", "-o", "o", "--overwrite"]
    simplify = argparse.Namespace(command="simplify", output="o", command_words=words)
    assert cli._resume_command(simplify).endswith(" simplify 'a b' -o o --resume")


@pytest.mark.parametrize("words, said", [
    ("train s -o o --steps 5", "--iterations"), ("train s -o o --max_steps=5", "--iterations"),
    ("train --source_path s --model_path o", "SCENE, --output"), ("train -s s -m o", "SCENE, --output"),
    ("train s -o o --cap_max 5", "--budget"), ("train s -o o --blend_mode smoe", "--blend-mode"),
    ("render o -o i --steps 5", ""), ("train s -o o --zzz", "")])
def test_an_option_of_other_trainers_is_told_by_its_name_here(words, said, capsys):
    with pytest.raises(SystemExit):
        main(words.split())
    assert capsys.readouterr().err.rstrip().endswith(f"(is {said} meant?)") if said else "meant" not in (
        capsys.readouterr().err)


WITHOUT_TORCH = """
import sys
from dsmoe.cli import main
for words in sys.argv[1:]:
    print(main(words.split("|") if words else []), "torch" in sys.modules, file=sys.stderr)
"""


def test_what_is_wrong_with_paths_and_options_is_said_before_torch_is_loaded(scene, tmp_path):
    """Which takes seconds. A command without an action lists what there is."""
    ply = tmp_path / "a.ply"
    ply.write_text("")
    (tmp_path / "my model" / "point_cloud").mkdir(parents=True)
    said = {  # what is typed, and what is said of it
        "train|nowhere|-o|o": "scene nowhere: no such folder", f"train|{ply}|-o|o": "is a file; a scene is a folder",
        f"train|{scene}|-o|o|--iterations|0": "--iterations is 0; it must be at least 1",
        f"train|{scene}|-o|o|--paper|--background-gate|1": "with --paper it is 0.0, or left out",
        f"train|{scene}|-o|o|--init|nowhere": "nowhere: no such file or folder; name a .ply, .splat",
        "simplify|nowhere|-o|o|--budget|9": "nowhere: no such file or folder; name a .ply, .splat",
        "scene|nowhere|-o|o": "no such folder of photographs", "eval|nowhere": "nowhere: no such folder",
        f"eval|{tmp_path}": "holds no config.json", "render|nowhere|-o|o": "no such file or folder",
        f"eval|{ply}": f"`dsmoe render {ply} --scene SCENE -o IMAGES` renders",
        "eval|my model": "`dsmoe render 'my model' --scene", f"render|{ply}|-o|o.gif|--orbit|--fps|0": "--fps is 0",
        f"render|{ply}|-o|o|--scene|nowhere": "scene nowhere: no such folder", "view|nowhere": "no such file or folder",
        "export|nowhere": "no such file or folder", f"export|{ply}|-o|{ply}": "--overwrite replaces it",
        f"render|{ply}|-o|o|--frames|3": "--frames means something with --orbit alone",
        f"render|{ply}|-o|o|--fps|3": "--fps means something with --orbit alone",
        f"render|{ply}|-o|o|--orbit|--fps|3": "--fps means something with a video alone; end -o in .mp4, .gif or .webp",
        f"render|{ply}|-o|o|--orbit|--split|test": "leave out one of the two",
        f"export|{ply}|--bake-iterations|3": "--bake-iterations means something with --bake alpha alone",
        f"export|{ply}|--device|cuda": "--device means something with --bake alpha alone",
        **{f"{words}|a\x1b[31m": r"a\x1b[31m: " for words in ("eval", "patch|check")}}
    listed = {"": "measure a trained run again", "patch": "take the patch out of every file",
              "bench": "run what is not done yet of a suite"}
    package = os.path.dirname(os.path.dirname(os.path.abspath(diff_smoe_rasterization.__file__)))
    run = subprocess.run([sys.executable, "-c", WITHOUT_TORCH, *said, *listed], stdout=subprocess.PIPE, cwd=tmp_path,
                         stderr=subprocess.PIPE, universal_newlines=True, env={**os.environ, "PYTHONPATH": package})
    parts = re.split(r"(?m)^(\d) (\w+)$\n", run.stderr)
    texts, statuses, loaded = parts[:-1:3], parts[1::3], parts[2::3]
    for words, text, expected in zip([*said, *listed], texts, [*said.values(), *listed.values()]):
        assert expected in text, (words, text)
    assert statuses == ["1"] * len(said) + ["2"] * len(listed) and set(loaded) == {"False"}, run.stderr


@pytest.mark.parametrize("words, error", [
    ("train s -o o --iterations 1e4", "argument --iterations: is '1e4'; it must be a whole number\n"),
    ("train s -o o --opacity-lr 0,1", "argument --opacity-lr: is '0,1'; it must be a number\n"),
    ("view o --port 80x", "argument --port: is '80x'; it must be a whole number\n"),
    *((words, f"argument {name}: is empty; name a file or folder\n") for words, name in (
        ("export m.ply -o ''", "-o/--output"), ("render m.ply -o ''", "-o/--output"), ("view ''", "MODEL"),
        ("simplify m.ply --budget 9 -o ''", "-o/--output"), ("train '' -o o", "SCENE"), ("eval ''", "OUT"),
        ("train s -o ''", "-o/--output"), ("scene p -o ''", "-o/--output"), ("scene '' -o o", "PHOTOS"),
        ("bench run smoke -o ''", "-o/--output"), ("bench report r -o ''", "-o/--output"),
        ("bench run ''", "SUITE"), ("bench report ''", "RESULTS"), ("patch check ''", "PATH"),
        ("eval o --scene ''", "--scene"), ("render m.ply -o o --scene ''", "--scene"),
        ("train s -o o --init ''", "--init")))])
def test_what_is_no_number_or_no_name_is_told(words, error, capsys):
    with pytest.raises(SystemExit):
        main(shlex.split(words))
    assert capsys.readouterr().err.endswith(error)


def test_eval_measures_the_same_again(trained, capsys):
    before, = results_of(trained)
    assert main(["eval", trained]) == 0
    after, = results_of(trained)
    assert f"{before['psnr']:.2f}" in capsys.readouterr().out
    # The model makes a trip through a .ply of the same float32 values.
    for name in ("psnr", "ssim", "num_gaussians", "train_seconds", "blend_mode"):
        assert after[name] == before[name], name


def test_eval_of_a_run_that_cannot_be_written_to_prints_its_figures(trained, capsys, monkeypatch):
    before, = results_of(trained)

    def refuses(*_):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(inspection, "write_results", refuses)
    assert main(["eval", trained]) == 0
    text = capsys.readouterr().out
    assert f"{before['psnr']:.2f}" in text and "could not be written anew (Read-only file system)" in text


def test_a_run_knows_its_scene_from_any_folder(trained, scene, tmp_path, capsys, monkeypatch):
    run = str(tmp_path / "run")
    shutil.copytree(trained, run)
    monkeypatch.chdir(os.path.dirname(scene))
    for record in (os.path.basename(scene), "nowhere"):  # of an earlier version, which wrote the path as typed
        edit_config(run, scene=record)
        status = main(["eval", run])
        assert status == (0 if record != "nowhere" else 1)
    assert "--scene" in capsys.readouterr().err
    relative = str(tmp_path / "relative")
    assert main(["train", os.path.basename(scene), "-o", relative, *SHORT]) == 0
    monkeypatch.chdir(tmp_path)
    assert main(["eval", relative]) == 0 and main(["render", relative, "-o", "images"]) == 0
    row, = results_of(relative)
    assert row["scene"] == os.path.basename(scene)
    edit_config(run, scene=os.path.basename(scene))
    for command in (["eval", run], ["render", run, "-o", "no"]):
        assert "relative to where it was trained; name with --scene" in fails(capsys, *command)
    assert "name with SCENE" in fails(capsys, "train", "--resume", "-o", run)


def edit_config(run, **options):
    path = os.path.join(run, "config.json")
    with open(path, encoding="utf-8") as file:
        config = {**json.load(file), **options}
    with open(path, "w", encoding="utf-8") as file:
        json.dump(config, file)


def test_what_cannot_be_read_is_not_called_missing(trained, scene, tmp_path, capsys):
    """A link to itself stands for a folder that must not be read, which the superuser may read."""
    loop = str(tmp_path / "loop")
    os.symlink(loop, loop)
    run = str(tmp_path / "run")
    shutil.copytree(trained, run)
    for name in ("results.json", "config.json"):
        os.remove(os.path.join(run, name))
        os.symlink(loop, os.path.join(run, name))
        assert f"{name}: cannot be read (Too many levels" in fails(capsys, "eval", run)
    assert "loop: cannot be read" in fails(capsys, "train", loop, "-o", str(tmp_path / "out"))
    assert "loop: cannot be read" in fails(capsys, "render", loop, "-o", str(tmp_path / "out"))
    resumed = str(tmp_path / "resumed")
    shutil.copytree(trained, resumed)
    os.remove(os.path.join(resumed, "checkpoint.pt"))
    os.symlink(loop, os.path.join(resumed, "checkpoint.pt"))
    assert "checkpoint.pt: cannot be read" in fails(capsys, "train", "--resume", "-o", resumed)


def test_train_writes_into_no_folder_of_others(scene, tmp_path, capsys):
    photographs = tmp_path / "photos"
    shutil.copytree(os.path.join(scene, "images"), str(photographs))
    before = {path.name: path.read_bytes() for path in photographs.iterdir()}
    words = ["train", scene, "-o", str(photographs), *SHORT]
    text = fails(capsys, *words)
    assert f"{photographs} is not empty (view_000.png), and nothing says that dsmoe train wrote it" in text
    assert "choose a new or empty folder with -o; --overwrite trains beside what is there" in text
    assert "is not empty (view_000.png)" in fails(capsys, *words, "--resume")
    assert before == {path.name: path.read_bytes() for path in photographs.iterdir()}
    assert main([*words, "--overwrite"]) == 0
    assert main([*words, "--overwrite"]) == 0 and main([*words, "--resume"]) == 0
    assert before == {name: (photographs / name).read_bytes() for name in before}
    with subprocess.Popen(["true"]) as ended:
        pass
    killed = tmp_path / "killed"
    killed.mkdir()
    for name in (".dsmoe.lock", f".dsmoe_part-{ended.pid}-.dsmoe.json"):
        (killed / name).write_text("")
    for command in (["train", scene, *SHORT], ["render", str(photographs)]):
        folder = shutil.copytree(killed, tmp_path / command[0])
        assert main([*command, "-o", str(folder)]) == 0, "what a run leaves that is killed at once is in nobody's way"


def test_render_writes_into_its_own_folder_alone(trained, scene, tmp_path, capsys):
    photographs = tmp_path / "scene" / "images"
    shutil.copytree(os.path.join(scene, "images"), str(photographs))
    before = {path.name: path.read_bytes() for path in photographs.iterdir()}
    text = fails(capsys, "render", trained, "-o", str(photographs))
    assert f"{photographs} is not empty (view_000.png)" in text and "-o" in text
    assert before == {path.name: path.read_bytes() for path in photographs.iterdir()}
    assert "dsmoe train wrote" in fails(capsys, "render", trained, "-o", trained)
    assert "none: no such file or folder" in fails(capsys, "render", str(tmp_path / "none"), "-o", trained)

    own = tmp_path / "own"
    own.mkdir()
    assert main(["render", trained, "-o", str(own)]) == 0
    (own / "view_003.png").write_bytes(b"mine")
    assert "view_003.png is there" in fails(capsys, "render", trained, "-o", str(own), "--split", "all")
    assert (own / "view_003.png").read_bytes() == b"mine"
    (own / "view_003.png").unlink()
    assert main(["render", trained, "-o", str(own), "--split", "train"]) == 0
    assert len(list(own.glob("*.png"))) == 9, "the other split's images stay"
    other = shutil.copy(ply_of(trained), str(tmp_path / "other.ply"))
    assert main(["render", other, "--scene", scene, "-o", str(own)]) == 0
    assert [path.name for path in sorted(own.glob("*.png"))] == ["view_000.png", "view_008.png"], "no other model's"


@pytest.mark.parametrize("content, words", [
    *((json.dumps({"command": "dsmoe render", "of": "a scene", "files": [name]}), "names files elsewhere")
      for name in ("../mine", "/mine", "a\0b")),
    (json.dumps({"command": "dsmoe render", "of": "a scene", "files": ["link/thesis.pdf"]}), "by a link"),
    ('{"command": "dsmoe render", "of": 1, "files": []}', "not a record"), ("[]", "not a record"),
    ('{"command": "dsmoe render", "of": "", "files": [1]}', "not a record"), ("[" * 100_000, "not a record"),
    ('{"command": ["dsmoe render"], "of": "", "files": "a"}', "not a record"), ("\udcff", "not a record")])
def test_records_of_strangers_remove_nothing(trained, tmp_path, capsys, content, words):
    own, elsewhere = tmp_path / "own", tmp_path / "elsewhere"
    own.mkdir()
    elsewhere.mkdir()
    (elsewhere / "thesis.pdf").write_text("mine")
    (own / "link").symlink_to(elsewhere)
    (own / ".dsmoe.json").write_bytes(content.encode(errors="surrogateescape"))
    for options in ([], ["--overwrite"], ["--orbit", "--frames", "1"]):
        assert words in fails(capsys, "render", trained, "-o", str(own), *options)
    assert (elsewhere / "thesis.pdf").read_text() == "mine"


def test_eval_of_a_moved_run_and_a_moved_scene(trained, scene, tmp_path, capsys):
    run, moved = str(tmp_path / "run"), str(tmp_path / "scene")
    shutil.copytree(trained, run)
    shutil.copytree(scene, moved)
    assert main(["eval", run, "--scene", moved, "--split", "train"]) == 0
    said = capsys.readouterr().out
    assert "train views" in said and "note" not in said
    assert results_of(run) == results_of(trained), "only the test views' figures are results"
    assert "nowhere" in fails(capsys, "eval", run, "--scene", str(tmp_path / "nowhere"))


def darken(folder):
    image = os.path.join(folder, "images", "view_003.png")
    Image.open(image).point(lambda value: value // 2).save(image)


def double_the_focal_length(folder):
    model = io.read_colmap(folder)
    model.cameras[1].params[:2] *= 2
    io.write_colmap(model.folder, model, text=True)


def remove_an_image(folder):
    os.remove(os.path.join(folder, "images", "view_000.png"))


@pytest.mark.parametrize("in_place", [True, False])
@pytest.mark.parametrize("edit, words", [
    (darken, "checksum of the training images"), (double_the_focal_length, "checksum of the intrinsics"),
    (remove_an_image, "number of test views 2 there and 1 here")])
def test_eval_says_where_it_measures_another_scene(trained, scene, tmp_path, capsys, edit, words, in_place):
    run, other = str(tmp_path / "run"), str(tmp_path / "scene")
    shutil.copytree(trained, run)
    shutil.copytree(scene, other)
    if in_place:
        edit_config(run, scene=other)
        assert main(["eval", run]) == 0
        assert "note" not in capsys.readouterr().out
    before = results_of(run)
    edit(other)
    assert main(["eval", run] + ([] if in_place else ["--scene", other])) == 0
    said = capsys.readouterr().out
    assert f"note: {other} is not the scene that {run} was trained on: {words}" in said
    assert "test views" in said and results_of(run) == before, "figures, which are not the run's"
    assert ("warning: 1 of 9 images are missing" in said) == (edit is remove_an_image)


def test_eval_says_where_the_scene_of_a_run_is_not_known(trained, scene, tmp_path, capsys):
    run = str(tmp_path / "run")
    shutil.copytree(trained, run)
    os.remove(os.path.join(run, "checkpoint.pt"))
    assert main(["eval", run]) == 0
    assert f"note: whether {scene} is the scene that the run was trained on is not known" in capsys.readouterr().out


def test_render_writes_what_eval_measures(trained, scene, tmp_path):
    folder = tmp_path / "images"
    assert main(["render", trained, "-o", str(folder)]) == 0
    assert sorted(os.listdir(folder)) == [".dsmoe.json", ".dsmoe.lock", "view_000.png", "view_008.png"]
    main(["eval", trained])
    with open(os.path.join(trained, "per_view.json"), encoding="utf-8") as file:
        per_view = {row["name"]: row["psnr"] for row in json.load(file)}
    for name, psnr in per_view.items():
        rendered = np.asarray(Image.open(folder / name), float)
        truth = np.asarray(Image.open(os.path.join(scene, "images", name)), float)
        # Both are 8-bit images; the metric runs in float32.
        assert 10 * np.log10(255**2 / ((rendered - truth) ** 2).mean()) == pytest.approx(psnr, abs=1e-4)


def test_eval_measures_lpips_where_asked(trained, tmp_path, capsys, monkeypatch):
    run = str(tmp_path / "run")
    shutil.copytree(trained, run)
    monkeypatch.setenv("DSMOE_LPIPS_VGG", str(tmp_path / "nowhere.npz"))
    assert "nowhere.npz: no such file" in fails(capsys, "eval", run, "--lpips", "vgg")
    monkeypatch.delenv("DSMOE_LPIPS_VGG")
    asked = []
    monkeypatch.setattr("dsmoe.bench.lpips.lpips_network",
                        lambda kind, device: asked.append((kind, device)) or (lambda image, target: 0.25))
    assert main(["eval", run, "--lpips", "vgg"]) == 0
    assert "LPIPS (vgg, v0.1, 8-bit images in [-1, 1]): 0.2500\n" in capsys.readouterr().out
    assert asked == [("lpips_vgg_std", "cpu")] and results_of(run)[0]["lpips_vgg"] == 0.25


def test_render_follows_no_link_and_keeps_no_image_of_another_size(trained, tmp_path, capsys):
    images, photo = tmp_path / "images", tmp_path / "photo.png"
    assert main(["render", trained, "-o", str(images), "--depth"]) == 0
    os.replace(images / "view_000.png", photo)
    os.symlink(photo, images / "view_000.png")
    before = photo.read_bytes()
    for option in ([], ["--overwrite"]):
        assert "view_000.png is a link" in fails(capsys, "render", trained, "-o", str(images), "--resolution", "2",
                                                 *option)
    assert photo.read_bytes() == before and (images / "view_000.png").is_symlink()
    (images / "view_000.png").unlink()
    assert main(["render", trained, "-o", str(images), "--resolution", "2"]) == 0
    assert not (images / "view_000.depth.npy").exists(), "of another size"


def test_overwrite_removes_products_alone_whatever_a_record_names(scene, tmp_path):
    output = tmp_path / "out"
    assert main(["train", scene, "-o", str(output), *SMOE]) == 0
    (output / "point_cloud" / "key").write_text("mine")
    record = json.loads((output / ".dsmoe.json").read_text())
    record["files"].append("point_cloud/key")
    (output / ".dsmoe.json").write_text(json.dumps(record))
    assert main(["train", scene, "-o", str(output), *SMOE, "--overwrite"]) == 0
    assert (output / "point_cloud" / "key").read_text() == "mine"


def test_render_replaces_files_that_it_has_not_written_where_asked(trained, tmp_path):
    (tmp_path / "view_000.png").write_text("mine")
    (tmp_path / "notes").write_text("mine")
    assert main(["render", trained, "-o", str(tmp_path), "--overwrite"]) == 0
    assert Image.open(tmp_path / "view_000.png").size == (32, 24) and (tmp_path / "notes").read_text() == "mine"


def test_eval_measures_the_pixels_that_training_did(trained, scene, tmp_path, capsys):
    masked = str(tmp_path / "scene")
    shutil.copytree(scene, masked)
    os.mkdir(os.path.join(masked, "masks"))
    for name in os.listdir(os.path.join(masked, "images")):
        Image.new("L", (32, 24), 255).save(os.path.join(masked, "masks", name + ".png"))
    assert "has masks, but the run was measured without them" in fails(capsys, "eval", trained, "--scene", masked)


def test_render_writes_depth_and_alpha_where_asked(trained, tmp_path):
    assert main(["render", trained, "-o", str(tmp_path), "--depth", "--alpha"]) == 0
    ends = ("alpha.png", "depth.npy", "png")
    assert sorted(os.listdir(tmp_path))[2:] == [f"view_00{view}.{end}" for view in "08" for end in ends]
    depth, alpha = np.load(tmp_path / "view_000.depth.npy"), np.asarray(Image.open(tmp_path / "view_000.alpha.png"))
    assert depth.shape == alpha.shape == (24, 32) and (depth.dtype, alpha.dtype) == (np.float32, np.uint8)
    assert np.all((depth > 0.2) | (depth == 0)) and alpha.max() > 200
    assert np.all(depth[alpha > 0] > 0), "what covers a pixel has a depth"


def test_render_a_ply_with_the_mode_that_it_records(trained, scene, tmp_path):
    assert main(["render", trained, "-o", str(tmp_path / "run"), "--split", "all"]) == 0
    assert main(["render", ply_of(trained), "-o", str(tmp_path / "ply"), "--scene", scene, "--split", "all"]) == 0
    names = sorted(os.listdir(tmp_path / "run"))
    assert len(names) == 11 and names == sorted(os.listdir(tmp_path / "ply"))
    for name in names[2:]:  # behind the record of what was written and the lock
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "ply" / name).read_bytes()


def test_render_never_changes_the_mode_and_says_where_it_is_not_known(trained, scene, tmp_path, capsys):
    output = str(tmp_path / "images")
    with open(ply_of(trained), "rb") as file:
        content = file.read()
    bare = tmp_path / "bare.ply"
    gate = f"comment background_gate {GATE}\n".encode()
    assert gate in content
    bare.write_bytes(content.replace(b"comment blend_mode smoe_eq7\n", b"").replace(gate, b""))
    text = fails(capsys, "render", ply_of(trained), "-o", output, "--scene", scene, "--blend-mode", "alpha")
    assert "smoe_eq7, not alpha" in text
    text = fails(capsys, "render", trained, "-o", output, "--blend-mode", "alpha")
    assert "smoe_eq7, not alpha" in text
    assert not os.path.exists(output)
    assert main(["render", str(bare), "-o", output, "--scene", scene, "--blend-mode", "alpha"]) == 0
    assert "records no blend mode" not in capsys.readouterr().err
    for command in (["render", str(bare), "-o", output + "3", "--scene", scene],
                    ["export", str(bare), "-o", output + ".html"]):
        assert main(command) == 0
        assert f"note: {bare} records no blend mode, so it is alpha" in capsys.readouterr().err
    assert main(["render", trained, "-o", output + "2", "--blend-mode", "smoe_eq7"]) == 0
    one, other, third = (open(os.path.join(output + end, "view_000.png"), "rb").read() for end in ("", "2", "3"))
    assert one == third != other, "the two modes show different images"


def test_render_never_guesses_or_changes_the_background_gate(trained, scene, tmp_path, capsys):
    with open(ply_of(trained), "rb") as file:
        content = file.read()
    gate = f"comment background_gate {GATE}\n".encode()
    older, bare = tmp_path / "older.ply", tmp_path / "bare.ply"
    older.write_bytes(content.replace(gate, b""))
    bare.write_bytes(content.replace(gate, b"").replace(b"comment blend_mode smoe_eq7\n", b""))

    def render(source, name, *options):
        arguments = ["render", str(source), "-o", str(tmp_path / name), *options]
        assert main(arguments if source == trained else [*arguments, "--scene", scene]) == 0
        return (tmp_path / name / "view_000.png").read_bytes()

    for source in (trained, ply_of(trained)):
        place = [] if source == trained else ["--scene", scene]
        text = fails(capsys, "render", source, "-o", str(tmp_path / "no"), *place, "--background-gate", "0.5")
        assert f"gate {GATE}, not 0.5" in text
        text = fails(capsys, "render", source, "-o", str(tmp_path / "no"), *place, "--faint-below", "0.5")
        assert "in the blend mode smoe_eq7 its faint_below is 2.0, not 0.5" in text
    text = fails(capsys, "render", str(bare), "-o", str(tmp_path / "no"), "--scene", scene, "--blend-mode", "smoe_eq7")
    assert "bare.ply" in text and "--background-gate" in text
    assert "gate 0.0, not 0.5" in fails(capsys, "render", str(older), "-o", str(tmp_path / "no"), "--scene", scene,
                                      "--background-gate", "0.5")
    assert not (tmp_path / "no").exists()
    as_trained = render(trained, "run", "--background-gate", str(GATE))
    assert render(bare, "bare", "--blend-mode", "smoe_eq7", "--background-gate",
                  str(GATE)) == as_trained
    of_the_paper = render(older, "older")
    assert of_the_paper == render(bare, "bare_0", "--blend-mode", "smoe_eq7", "--background-gate", "0") != as_trained


def test_a_model_of_the_papers_authors_is_rendered_by_smoe_with_the_gate_0(trained, scene, tmp_path, capsys):
    """A .ply of Inria's properties without a comment, beside a cfg_args that knows no mode."""
    ply = tmp_path / "out-temp" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    ply.parent.mkdir(parents=True)
    (tmp_path / "out-temp" / "cfg_args").write_text("Namespace(eval=True, init_path='default', model_path='out-temp')")
    with open(ply_of(trained), "rb") as file:
        header, values = file.read().split(b"end_header\n", 1)
    properties = [line for line in header.splitlines(keepends=True) if not line.startswith(b"comment")]
    names = [line.split()[-1].decode() for line in properties if line.startswith(b"property float")]
    numbered = {"f_dc": 3, "f_rest": 45, "opacity": 0, "scale": 3, "rot": 4}
    assert names == ["x", "y", "z", "nx", "ny", "nz", *(
        f"{name}_{i}" if count else name for name, count in numbered.items() for i in range(count or 1))]
    ply.write_bytes(b"".join([*properties, b"end_header\n", values]))

    def rendered(mode):
        folder = str(tmp_path / mode)
        assert main(["render", str(ply), "--scene", scene, "--blend-mode", mode, "--background-gate", "0", "-o", folder]
                    ) == 0
        return np.asarray(Image.open(os.path.join(folder, "view_000.png")))

    assert not np.array_equal(rendered("smoe"), rendered("smoe_eq7")), "the two rules show different images"
    paper = ["render", str(ply), "--scene", scene, "--paper", "-o"]
    assert main([*paper, str(tmp_path / "program")]) == 0
    program = np.asarray(Image.open(tmp_path / "program" / "view_000.png"))
    assert not np.array_equal(program, rendered("smoe")), "all pairs count in it"
    assert main([*paper, str(tmp_path / "smoe"), "--split", "train"]) == 0
    assert not (tmp_path / "smoe" / "view_000.png").exists(), "of another faint_below"
    nowhere = ["-o", str(tmp_path / "no")]
    assert "authors' program" in fails(capsys, "render", str(ply), "--scene", scene, "--blend-mode", "smoe", *nowhere)
    assert "out-temp holds no cameras; name" in fails(capsys, "render", str(tmp_path / "out-temp"), *nowhere)


@pytest.mark.parametrize("mode, gate, warns", [
    ("alpha", 1, False), ("smoe_eq7", 1, False), ("smoe", 1, True), ("smoe", 0.03, True), ("smoe_std", 0, True)])
def test_a_model_that_viewers_would_show_wrongly_is_named(mode, gate, warns):
    assert bool(viewer_warning({"blend_mode": mode, "background_gate": gate})) == warns


def test_a_learned_background_gate_is_recorded_and_rendered_with(scene, tmp_path, capsys):
    output = str(tmp_path / "out")
    assert main(["train", scene, "-o", output, "--blend-mode", "smoe", "--background-gate", "learned", *SHORT]) == 0
    row, = results_of(output)
    protocol = row["protocol"]
    assert protocol["background_gate_learned"] is True and protocol["background_gate_bound"] == 0
    assert protocol["background_gate_start"] == 0.1 and protocol["background_gate_lr"] == 0.03
    gate = row["background_gate"]
    assert 0.05 < gate < 0.2 and gate != 0.1
    text = capsys.readouterr().out
    assert "viewers of 3DGS blend them by alpha" in text
    assert "smoe (gate learned)" in text and f"\nsmoe (gate {gate:.2g}) " in text
    assert io.read_gaussians(ply_of(output)).background_gate == gate
    assert main(["eval", output]) == 0
    after, = results_of(output)
    assert (after["psnr"], after["background_gate"]) == (row["psnr"], gate)
    assert main(["render", output, "-o", str(tmp_path / "images")]) == 0
    assert "not 0.5" in fails(capsys, "render", output, "-o", str(tmp_path / "no"), "--background-gate", "0.5")


def test_a_ply_and_a_config_that_disagree_are_refused(trained, tmp_path, capsys):
    run = str(tmp_path / "run")
    shutil.copytree(trained, run)
    with open(ply_of(run), "r+b") as file:
        content = file.read().replace(b"comment blend_mode smoe_eq7\n", b"comment blend_mode alpha\n")
        file.seek(0)
        file.write(content)
    assert "alpha, not smoe_eq7" in fails(capsys, "eval", run)
    assert "alpha, not smoe_eq7" in fails(capsys, "render", run, "-o", str(tmp_path / "images"))


def test_resume_on_the_command_line(scene, tmp_path, capsys):
    output = str(tmp_path / "out")
    arguments = ["train", scene, "-o", output, *SHORT]
    assert main(arguments) == 0
    assert "--resume" in fails(capsys, *arguments)
    assert main([*arguments, "--resume"]) == 0
    assert "resumed at iteration 12" in capsys.readouterr().out
    assert "--seed" in fails(capsys, *arguments, "--resume", "--seed", "7")
    assert main([*arguments, "--overwrite", "--seed", "7"]) == 0


@pytest.mark.parametrize("words", [["--resume", "-o"], ["--resume"]])
def test_resume_of_a_folder_alone_has_the_options_of_the_run(trained, tmp_path, capsys, monkeypatch, words):
    output = str(tmp_path / "out")
    shutil.copytree(trained, output)
    os.remove(os.path.join(output, "checkpoint.pt"))  # so that it trains
    monkeypatch.setenv("DSMOE_BLEND_MODE", "alpha")
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--quiet", *words, output]) == 0
    with open(ply_of(output), "rb") as mine, open(ply_of(trained), "rb") as theirs:
        assert mine.read() == theirs.read()
    assert "--seed is 0, not 7" in fails(capsys, "train", *words, output, "--seed", "7")
    assert "no such folder" in fails(capsys, "train", *words, str(tmp_path / "none"))
    with pytest.raises(SystemExit):
        main(["train", "-o", output])
    assert "SCENE and -o OUT are needed" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["train", "--resume", output, "--scale-recipe"])
    assert "--scale-recipe needs SCENE" in capsys.readouterr().err


def test_more_iterations_extend_a_run(trained, scene, tmp_path, capsys, monkeypatch, ctrl_c_works):
    straight, stopped, ended = (str(tmp_path / name) for name in ("straight", "stopped", "ended"))
    more = ["--iterations", "20"]
    with monkeypatch.context() as patch:
        interrupt_at(patch, 7, signal.SIGINT)
        assert main(["train", scene, "-o", stopped, *SMOE]) == 130
    shutil.copytree(trained, ended)
    assert main(["train", scene, "-o", straight, *SMOE, *more]) == 0
    for output in (stopped, ended):
        capsys.readouterr()
        assert main(["train", "--resume", "-o", output, "--quiet", *more]) == 0
        assert "extended from 12 to 20 iterations; milestones stay: densification until 10" in capsys.readouterr().out
        row, = results_of(output)
        assert row["protocol"]["iterations"] == 20
    models = [open(ply_of(output, 20), "rb").read() for output in (straight, stopped, ended)]
    assert models[0] == models[1] != models[2], "what had ended had left out its last step"
    assert os.path.isfile(ply_of(ended))
    text = fails(capsys, "train", "--resume", "-o", ended, "--iterations", "12")
    assert "--iterations is 20, not 12" in text
    assert main(["train", scene, "-o", ended, *SMOE, "--overwrite"]) == 0
    assert os.listdir(os.path.join(ended, "point_cloud")) == ["iteration_12"], "nothing of the old run outlives it"


def test_errors_come_before_anything_is_written(scene, tmp_path, capsys):
    output = str(tmp_path / "out")
    assert "no such folder" in fails(capsys, "train", str(tmp_path / "nowhere"), "-o", output)
    assert "--iterations is 0" in fails(capsys, "train", scene, "-o", output, "--iterations", "0")
    if not torch.cuda.is_available():
        assert main(["train", scene, "-o", output, "--device", "cuda"]) == 1
        said = capsys.readouterr()
        assert "no CUDA device" in said.err and not said.out, "the error alone"
    assert not os.path.exists(output)
    assert "config.json" in fails(capsys, "eval", str(tmp_path))
    cloud = str(tmp_path / "points.ply")
    io.write_points(cloud, io.Points(np.zeros((3, 3))))
    assert "a video is written with --orbit" in fails(capsys, "render", cloud, "-o", output + ".mp4", "--scene", scene)
    assert re.search(r"points\.ply.*not a model of Gaussians", fails(capsys, "export", cloud))
    for words in (["view", "model.ply"], ["export", "model.ply"], ["render", "model.ply", "-o", output, "--orbit"]):
        said = fails(capsys, *words)
        assert "model.ply: no such file or folder; name a .ply, .splat, .spz or .glb, an output folder of" in said
    assert "model.ply" in fails(capsys, "render", "model.ply", "-o", output, "--scene", scene)


def test_an_output_that_cannot_be_written_is_one_line(trained, scene, tmp_path, capsys):
    path = str(tmp_path / "file")
    with open(path, "w", encoding="utf-8") as file:
        file.write("no folder")
    for arguments in (["train", scene, "-o", path], ["train", scene, "-o", os.path.join(path, "below")],
                      ["render", trained, "-o", path], ["simplify", trained, "--budget", "9", "-o", path],
                      ["scene", os.path.join(scene, "images"), "-o", path],
                      ["export", trained, "-o", os.path.join(path, "a.ply")],
                      ["render", trained, "--orbit", "-o", os.path.join(path, "a.gif")]):
        assert f"{path} is no folder; choose another name with -o" in fails(capsys, *arguments)


@pytest.mark.parametrize("words", [["info"], ["render", "o", "-o", "i"], ["bench", "run", "smoke"],
                                   ["patch", "check", "p"]])
def test_a_current_folder_that_is_gone_is_told(words, tmp_path, capsys, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert "the current folder has been removed; go to another one" in fails(capsys, *words)


def test_a_folder_that_may_not_be_written_or_read_is_told_before_anything_is_made(trained, scene, tmp_path):
    locked, photos = tmp_path / "locked", tmp_path / "photos"
    shutil.copytree(os.path.join(scene, "images"), str(photos))
    (photos / "more").mkdir(mode=0)
    locked.mkdir(mode=0o500)
    for words in (["train", scene, "-o", locked / "new"], ["render", trained, "-o", locked],
                  ["render", trained, "--orbit", "-o", locked / "a.gif"], ["export", trained, "-o", locked / "a.ply"],
                  ["simplify", trained, "--budget", "9", "-o", locked / "a" / "b"]):
        done = unprivileged.dsmoe(*words)
        assert (done.returncode, done.stdout) == (1, "") and done.stderr.endswith(
            f"{words[-1]}: nothing can be written there: you may not write in {locked}; choose another name with -o\n")
    done = unprivileged.dsmoe("scene", photos, "-o", tmp_path / "made")
    assert done.returncode == 1 and f"{photos / 'more'}: photographs there cannot be read" in done.stderr
    assert sorted(os.listdir(tmp_path)) == ["locked", "photos"] and not os.listdir(locked)


def test_too_little_memory_is_one_line(scene, tmp_path, monkeypatch, capsys):
    def cuda(*arguments):
        raise RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total capacity of 8 GiB\n...")

    def cpu(*arguments):
        torch.empty(2**50, dtype=torch.uint8)

    def array(*arguments):
        np.empty(2**50, np.uint8)

    def defect(*arguments):
        raise RuntimeError("another one")

    arguments = ["train", scene, "-o", str(tmp_path / "out"), *SHORT]
    for function, words in ((cuda, "the GPU is out of memory, 20.00 GiB"), (array, "out of memory, 1.00 PiB"),
                            (cpu, f"the machine is out of memory, {2**50} bytes more were asked for")):
        monkeypatch.setattr("dsmoe.train.load_scene", function)
        assert words in fails(capsys, *arguments)
    monkeypatch.setattr("dsmoe.train.load_scene", defect)
    with pytest.raises(RuntimeError, match="another one"):
        main(arguments)


def test_damaged_results_are_named(trained, tmp_path, capsys):
    run = str(tmp_path / "run")
    shutil.copytree(trained, run)
    row = '[{"blend_mode": "smoe", "%s": %s}]'
    for content, words in (("[{", "not valid json"), ("[1]", "list of rows"), ("[" * 100_000, "not valid json"),
                           (row % ("protocol", 1), "`protocol` is 1"), (row % ("protocol", "[]"), "`protocol` is []"),
                           (row % ("train_seconds", '"1"'), "`train_seconds` is '1'")):
        with open(os.path.join(run, "results.json"), "w", encoding="utf-8") as file:
            file.write(content)
        text = fails(capsys, "eval", run)
        assert os.path.join(run, "results.json") in text and words in text


def test_resume_and_overwrite_exclude_each_other(scene, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["train", scene, "-o", str(tmp_path / "out"), "--resume", "--overwrite"])
    assert "not allowed with" in capsys.readouterr().err


def interrupt_at(monkeypatch, iteration, number):
    """Sends this process a signal in the middle of that iteration's step."""
    step = Trainer.step

    def interrupted_step(self, *arguments):
        if self.iteration + 1 == iteration:
            os.kill(os.getpid(), number)
        return step(self, *arguments)

    monkeypatch.setattr(Trainer, "step", interrupted_step)


@pytest.fixture
def ctrl_c_works():
    """Programs that a shell starts in the background inherit that Ctrl-C is ignored, under nohup SIGHUP."""
    before = [signal.signal(signal.SIGINT, signal.default_int_handler), signal.signal(signal.SIGHUP, signal.SIG_DFL)]
    yield
    for number, handler in zip((signal.SIGINT, signal.SIGHUP), before):
        signal.signal(number, handler)


@pytest.mark.parametrize("number, status", [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_an_interrupted_run_continues_where_it_was(trained, scene, tmp_path, monkeypatch, capsys, ctrl_c_works, number,
                                                   status):
    output = str(tmp_path / "an out")
    arguments = ["train", scene, "-o", output, *SMOE]
    with monkeypatch.context() as patch:
        interrupt_at(patch, 7, number)
        assert main(arguments) == status
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    typed = capsys.readouterr().err.rpartition("interrupted; continue it with: ")[2]
    words = shlex.split(typed)
    assert main(words[words.index("train"):]) == 0
    assert "resumed at iteration 7" in capsys.readouterr().out
    for path in (ply_of, lambda run: os.path.join(run, "loss.png")):
        with open(path(output), "rb") as mine, open(path(trained), "rb") as theirs:
            assert mine.read() == theirs.read()


@pytest.mark.parametrize("number, status", [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_an_interrupted_rendering_leaves_whole_images(trained, tmp_path, monkeypatch, ctrl_c_works, number, status):
    words, save = ["render", trained, "-o", str(tmp_path)], Image.Image.save

    def interrupted_save(self, file, **options):
        save(self, file, **options)
        if (tmp_path / "view_000.png").exists():  # the second one is not whole yet
            assert signal.getsignal(number) != signal.SIG_DFL, "it would end the tests"
            os.kill(os.getpid(), number)

    with monkeypatch.context() as patch:
        patch.setattr(Image.Image, "save", interrupted_save)
        assert main(words) == status
    assert sorted(os.listdir(tmp_path)) == [".dsmoe.json", ".dsmoe.lock", "view_000.png"]
    assert main(words) == 0 and "view_008.png" in os.listdir(tmp_path)


def test_an_interrupted_rendering_leaves_no_half_of_a_depth_map(trained, tmp_path, monkeypatch):
    save = np.save

    def interrupted_save(file, arr):
        save(file, arr)
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "save", interrupted_save)
    assert main(["render", trained, "--depth", "-o", str(tmp_path)]) == 130
    assert sorted(os.listdir(tmp_path)) == [".dsmoe.json", ".dsmoe.lock", "view_000.png"]


def test_names_of_images_need_not_be_utf_8(scene, tmp_path, capsys):
    """One of the training and one of the test, as an old camera's disk has them: each command takes them."""
    folder, output = str(tmp_path / "scene"), str(tmp_path / "out")
    shutil.copytree(scene, folder)
    model, names = io.read_colmap(folder), {"view_000.png": os.fsdecode(b"view_000\xe9.png"),
                                            "view_001.png": os.fsdecode(b"view_001\xff.png")}
    images = [dataclasses.replace(image, name=names.get(image.name, image.name)) for image in model.images]
    io.write_colmap(model.folder, dataclasses.replace(model, images=images))
    for before, name in names.items():
        os.rename(os.path.join(folder, "images", before), os.path.join(folder, "images", name))
    assert main(["train", folder, "-o", output, *SMOE]) == 0
    assert main(["train", "--resume", "-o", output, "--iterations", "13", "--quiet"]) == 0
    assert "extended" in capsys.readouterr().out
    assert main(["eval", output]) == 0 and main(["render", output, "-o", str(tmp_path / "images")]) == 0
    assert "view_000\\udce9.png" in os.listdir(tmp_path / "images"), "in letters that every system has"
    assert main(["export", output, "-o", str(tmp_path / "a.html")]) == 0


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_names_that_a_terminal_cannot_print_end_no_command(scene, tmp_path, monkeypatch, encoding):
    """Folders and files of any bytes, on a stream that takes none of them."""
    monkeypatch.chdir(tmp_path)
    folder, run, name = (os.fsdecode(text) for text in (b"scene\xff", b"run\xff", b"a\xff"))
    shutil.copytree(scene, folder)
    streams = [TextIOWrapper(BytesIO(), encoding, errors="strict") for _ in range(2)]
    monkeypatch.setattr(sys, "stdout", streams[0])
    monkeypatch.setattr(sys, "stderr", streams[1])
    for words in (["train", folder, "-o", run, *SHORT], ["eval", run], ["render", run, "-o", name],
                  ["render", run, "--orbit", "--frames", "1", "-o", name + ".gif"],
                  *(["export", run, "-o", f"{name}.{form}"] for form in ("html", "ply", "splat", "glb")),
                  ["train", "--resume", run]):
        assert main(words) == 0, words
    assert main(["eval", name]) == 1 and main(["export", name + ".ply", "-o", name + ".ply"]) == 1
    for stream in streams:
        stream.seek(0)
    out, errors = (stream.buffer.read() for stream in streams)
    assert (b"export 'run\xff' -o" if encoding == "utf-8" else b"export 'run\\udcff' -o") in out
    assert errors.count(b"\n") == 2 and b"a\\udcff holds no config.json" in errors


def test_an_interruption_while_the_command_is_loaded_shows_no_traceback(monkeypatch, capsys):
    class Interrupted:
        def __getattr__(self, name):
            raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "dsmoe.cli", Interrupted())
    assert dsmoe.__main__.main() == 130 and capsys.readouterr().err == "\ndsmoe: interrupted\n"


def test_an_interruption_before_training_promises_nothing(scene, tmp_path, monkeypatch, capsys):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("dsmoe.train.load_scene", interrupted)
    assert main(["train", scene, "-o", str(tmp_path / "out"), *SHORT]) == 130
    assert capsys.readouterr().err.endswith("interrupted\n")


@pytest.mark.parametrize("mode", ["smoe", "alpha"])
def test_an_interrupted_training_is_looked_at_by_its_checkpoint(scene, tmp_path, monkeypatch, capsys, ctrl_c_works,
                                                                mode):
    run = str(tmp_path / "run")
    with monkeypatch.context() as patch:
        interrupt_at(patch, 7, signal.SIGINT)
        assert main(["train", scene, "-o", run, *SHORT, "--blend-mode", mode]) == 130
    before = {path for path, _, _ in os.walk(run)}, sorted(os.listdir(run))
    state = load_checkpoint(os.path.join(run, "checkpoint.pt"), "cpu")
    note = f"note: the training in {run} has not ended; this is its checkpoint, at iteration 7 of 12\n"
    commands = {"eval": [run], "render": [run, "-o", str(tmp_path / "images")],
                "export": [run, "-o", str(tmp_path / "model.ply")]}
    for command, words in commands.items():
        capsys.readouterr()
        assert main([command, *words]) == 0
        said = capsys.readouterr()
        assert said.err == note, command
        if command == "eval":
            psnr = float(re.search(r"\n\w+(?: \(gate [\d.]+\))? +([\d.]+) ", said.out.split("---")[-1]).group(1))
    assert before == ({path for path, _, _ in os.walk(run)}, sorted(os.listdir(run))), "no results of half a training"
    model, recorded = load_model(str(tmp_path / "model.ply"), "cpu")
    assert recorded.blend_mode == mode and torch.equal(model.raw["means3D"], state["raw"]["means3D"])
    if state["gate"]:
        assert recorded.background_gate == pytest.approx(float(state["gate"]["logarithm"].exp()), rel=1e-6)
    errors = [np.asarray(Image.open(tmp_path / "images" / name), float)
              - np.asarray(Image.open(os.path.join(scene, "images", name)), float)
              for name in ("view_000.png", "view_008.png")]
    assert np.mean([10 * np.log10(255**2 / (error**2).mean()) for error in errors]) == pytest.approx(psnr, abs=0.006)
    assert main(["render", run, "--orbit", "--frames", "1", "-o", str(tmp_path / "orbit")]) == 0
    assert main(["export", run, "-o", str(tmp_path / "model.html")]) == 0
    words = {"smoe": "was trained with the background gate", "alpha": "in the blend mode alpha it is 1"}[mode]
    assert words in fails(capsys, "export", run, "-o", str(tmp_path / "a.html"), "--background-gate", "0.7")
    assert main(["train", "--resume", run, "--quiet"]) == 0
    capsys.readouterr()
    assert main(["eval", run]) == 0 and capsys.readouterr().err == ""


def test_what_of_an_unfinished_run_cannot_be_looked_at_is_named(trained, tmp_path, capsys):
    run = str(tmp_path / "run")
    shutil.copytree(trained, run)
    os.remove(ply_of(run))
    path = os.path.join(run, "checkpoint.pt")
    state = load_checkpoint(path, "cpu")
    state["raw"]["means3D"][3, 1] = float("nan")
    commands = (["eval", run], ["render", run, "-o", str(tmp_path / "images")],
                ["export", run, "-o", str(tmp_path / "model.html")])
    for edit, words in ((lambda: save_checkpoint(path, state), "`raw/means3D` is NaN"),
                        (lambda: save_checkpoint(path, {**state, "raw": {}}), "its `raw` is []"),
                        (lambda: edit_config(run, sh_degree=2), "its `sh_degree` is 3; it must be 2"),
                        (lambda: os.truncate(path, 1000), "not a readable checkpoint"),
                        (lambda: os.remove(path), "has not ended, and has no checkpoint yet")):
        edit()
        for command in commands:
            assert words in fails(capsys, *command)
    assert sorted(os.listdir(tmp_path)) == ["run"]


def test_scale_recipe(scene, tmp_path):
    output = str(tmp_path / "out")
    assert main(["train", scene, "-o", output, "--iterations", "30", "--strategy", "3dgs", "--scale-recipe",
                 "--densify-from-iter", "3", "--sh-degree-interval", "1000", "--quiet"]) == 0
    with open(os.path.join(output, "config.json"), encoding="utf-8") as file:
        config = json.load(file)
    assert (config["densify_until_iter"], config["opacity_reset_interval"], config["densify_from_iter"]) == (15, 3, 3)
    assert config["sh_degree_interval"] == 1000, "a value that is given wins, though it equals the default"
    row, = results_of(output)
    recipe = row["protocol"]["recipe"]
    assert recipe == {"densify_from_iter": 3, "densify_until_iter": 15, "densification_interval": 1,
                      "opacity_reset_interval": 3, "position_lr_max_steps": 30}, "what differs from the defaults"


@pytest.mark.parametrize("with_scene", [False, True])
def test_a_changed_milestone_is_told_before_what_is_wrong_with_it(scene, tmp_path, capsys, with_scene):
    """15,000 is above the iterations, which `importance` refuses; the run that is there has 15."""
    output, options = str(tmp_path / "out"), ["--iterations", "30", "--scale-recipe", "--budget", "40"]
    assert main(["train", scene, "-o", output, *options, "--quiet"]) == 0
    words = [scene, *options] if with_scene else []
    text = fails(capsys, "train", "--resume", "-o", output, *words, "--densify-until-iter", "15000")
    assert "--densify-until-iter is 15, not 15000" in text and f"`dsmoe train --resume -o {output}` keeps" in text
    assert main(["train", "--resume", "-o", output, *words, "--quiet"]) == 0


@pytest.mark.parametrize("until, has_time", [(22, True), (23, False)])
def test_a_budget_without_time_to_settle_is_told(scene, tmp_path, capsys, until, has_time):
    """Moves end at 4/3 of --densify-until-iter: at 29.3 and 30.7 of the 30 iterations."""
    assert main(["train", scene, "-o", str(tmp_path / "out"), "--iterations", "30", "--scale-recipe", "--budget", "40",
                 "--densify-until-iter", str(until), "--quiet"]) == 0
    assert ("no iterations to settle" in capsys.readouterr().out) is not has_time


def test_the_psnr_of_training_views_is_that_of_their_images(scene, trained, tmp_path):
    output, images = str(tmp_path / "out"), tmp_path / "images"
    shutil.copytree(trained, output)
    assert main(["render", output, "-o", str(images), "--split", "train"]) == 0
    values = []
    for path in sorted(images.glob("*.png")):
        shown, photo = (np.asarray(Image.open(file).convert("RGB"), np.float64) / 255
                        for file in (path, os.path.join(scene, "images", path.name)))
        values.append(-10 * np.log10(np.square(shown - photo).mean()))
    assert len(values) == 7
    row, = results_of(output)
    assert row["psnr_train"] == pytest.approx(np.mean(values), abs=1e-4)  # of float32 images, which are the same bytes
    os.remove(os.path.join(output, "results.json"))
    assert main(["eval", output]) == 0 and results_of(output)[0]["psnr_train"] == row["psnr_train"]


def test_info(capsys):
    assert main(["info"]) == 0
    text = capsys.readouterr().out
    assert diff_smoe_rasterization.build_info()["version"] in text and torch.__version__ in text
    for word in ("cuda", "SIMD level", "threads", "GPU"):
        assert word in text


def test_the_module_is_the_command(tmp_path):
    """In a process of its own, with the package that is tested."""
    package = os.path.dirname(os.path.dirname(diff_smoe_rasterization.__file__))
    done = subprocess.run([sys.executable, "-m", "dsmoe", "train", "/nowhere", "-o", "x"],
                          capture_output=True, text=True, check=False, cwd=tmp_path,
                          env={**os.environ, "PYTHONPATH": package})
    assert (done.returncode, done.stderr) == (1, "dsmoe train: error: scene /nowhere: no such folder\n")
