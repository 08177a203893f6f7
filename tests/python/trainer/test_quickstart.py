"""The comparison of both blends on a tiny scene: table, pictures, models and rows."""
from __future__ import annotations

import io
import json
import os
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from diff_smoe_rasterization.io import read_colmap, read_gaussians
from dsmoe import cli, quickstart
from dsmoe.options import quickstart_options, short_run
from dsmoe.options.presets import FAST
from dsmoe.options.quickstart_options import MADE_UP, check, given_options, output_and_subject, parse
from dsmoe.results.pictures import MARGIN, comparison, evenly_spaced, window_of_differences
from dsmoe.system import files

sys.path.insert(0, os.path.join(os.path.dirname(__file__), "..", "..", "..", "benchmarks"))
import compare_runs  # noqa: E402


@pytest.fixture(scope="module")
def output(tiny_scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("quickstart")
    status = quickstart.main([tiny_scene, "-o", str(folder), "--iterations", "30", "--seed", "4", "--quiet"])
    assert status == 0
    return folder


def test_both_modes_are_trained_with_the_same_settings(output):
    rows = json.loads((output / "results.json").read_text())
    assert [row["blend_mode"] for row in rows] == ["alpha", "smoe"]
    for row in rows:
        assert {"psnr", "ssim", "num_gaussians", "train_seconds", "fps"} <= set(row)
    learned = {"background_gate_learned": True, "background_gate_bound": 0.0, "background_gate_start": 0.1,
               "background_gate_lr": 0.03}
    assert rows[1]["protocol"] == {**rows[0]["protocol"], **learned}
    assert (rows[0]["protocol"]["iterations"], rows[0]["protocol"]["seed"]) == (30, 4)


def test_the_models_record_their_modes(output):
    for mode in ("alpha", "smoe"):
        model = read_gaussians(str(output / f"{mode}.ply"))
        assert model.blend_mode == mode
        # Learned from 0.1: 30 steps of Adam change its logarithm by at most 30 times the rate, 0.03.
        assert model.background_gate is None if mode == "alpha" else 0.04 < model.background_gate < 0.25


def test_pictures_show_truth_and_both_modes(output):
    pictures = sorted(path.name for path in output.glob("compare_*.png"))
    assert pictures == ["compare_view_000.png", "compare_view_008.png"]
    with Image.open(output / pictures[0]) as picture:
        assert picture.width > 3 * 400 and np.asarray(picture).std() > 10


def test_two_runs_are_shown_beside_the_photograph_of_a_view(output, tiny_scene, tmp_path, capsys):
    runs = [str(output / mode) for mode in ("alpha", "smoe")]
    compare_runs.main([*runs, "-o", str(tmp_path / "new" / "a.png"), "--view", "view_008.png", "--width", "300"])
    with Image.open(tmp_path / "new" / "a.png") as picture, Image.open(output / "compare_view_008.png") as expected:
        wanted = np.asarray(expected.resize(picture.size, Image.LANCZOS), np.float64)
        differs = np.abs(np.asarray(picture, np.float64) - wanted).mean(axis=(1, 2))
    assert picture.width == 300 and not differs[len(differs) // 10:].any(), "below the labels, which have other words"
    for given, told in (([*runs, "-o", "b.png", "--view", "view_001.png"],
                         "--view view_001.png: the test views are view_000.png, view_008.png"),
                        ([str(tmp_path / "nowhere"), runs[0], "-o", "b.png"], str(tmp_path / "nowhere")),
                        ([*runs, "-o", "p.xyz"], "-o p.xyz: no picture ends in .xyz; name a .png or .jpg"),
                        ([*runs, "-o", str(tmp_path / "new" / "a.png" / "b.png")], "a.png is no folder"),
                        ([*runs, "-o", "b.png", "--width", "0"], "--width is 0; it must be at least 1")):
        assert compare_runs.main(given) == 1
        text = capsys.readouterr().err
        assert told in text and text.count("\n") == 1


def test_an_earlier_comparison_stays_unless_it_may_be_replaced(tiny_scene, output, capsys):
    before = {path: path.stat().st_mtime_ns for path in output.rglob("*") if path.is_file()}
    assert {"results.json", "alpha.ply", "smoe.ply"} < {path.name for path in before}
    for run in (quickstart.main, check):  # the latter before anything is installed
        assert run([tiny_scene, "-o", str(output), "--iterations", "20"]) == 1
        text = capsys.readouterr().err
        assert f"{output} holds an earlier comparison (results.json, alpha.ply" in text and "--overwrite" in text
    assert before == {path: path.stat().st_mtime_ns for path in output.rglob("*") if path.is_file()}


def test_the_table_and_a_second_run(tiny_scene, output, capsys):
    assert quickstart.main([tiny_scene, "-o", str(output), "--iterations", "20", "--quiet", "--overwrite"]) == 0
    text = capsys.readouterr().out
    for word in ("PSNR", "SSIM", "#Gaussians", "train [s]", "FPS", "\nalpha ", "\nsmoe (gate 0.",
                 "compare_view_000.png", "note: the smoe .ply holds gates; viewers"):
        assert word in text


def test_the_last_line_is_a_command(output, tiny_scene, tmp_path, capsys):
    assert quickstart.main([tiny_scene, "-o", str(output), "--iterations", "10", "--quiet", "--overwrite"]) == 0
    said = capsys.readouterr().out.splitlines()[-1].partition("browser: ")[2]
    page = tmp_path / "model.html"
    subprocess.run([*shlex.split(said)[:-1], str(page)], check=True, stdout=subprocess.DEVNULL)
    assert page.stat().st_size > 10_000


def test_a_folder_of_runs_is_no_run_and_names_them(output, capsys):
    assert cli.main(["export", str(output)]) == 1
    assert capsys.readouterr().err.endswith(f"; such are {output / 'alpha'}, {output / 'smoe'}\n")


def test_what_it_chose_is_said_before_it_trains(tiny_scene, monkeypatch):
    """A pipe's writer keeps what is printed until it is told."""
    pipe = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(pipe))
    quickstart.choose_options(tiny_scene, {})
    assert pipe.getvalue().startswith(b"chosen for a run of some minutes: --iterations 3000 ")


def test_another_scene_is_refused_and_no_picture_is_stale(tiny_scene, output, tmp_path, capsys):
    other = shutil.copytree(tiny_scene, str(tmp_path / "other"))
    before = {path.name: path.stat().st_mtime_ns for path in output.iterdir()}
    for scene in ([other], []):
        assert quickstart.main([*scene, "-o", str(output), "--quiet"]) == 1
        text = capsys.readouterr().err
        assert tiny_scene in text and "-o" in text and text.count("\n") == 1
    assert quickstart.main([tiny_scene, "-o", other, "--quiet"]) == 1
    assert "is not empty (images)" in capsys.readouterr().err
    assert before == {path.name: path.stat().st_mtime_ns for path in output.iterdir()}
    files.write_json_atomically(str(output / ".dsmoe.json"), {"command": "quickstart", "of": tiny_scene, "files": [
        "alpha.ply", "smoe.ply", "results.json", "compare_view_000.png", "compare_view_008.png", "compare_old.png"]})
    (output / "compare_old.png").write_bytes(b"stale")
    (output / "mine.png").write_bytes(b"mine")
    assert quickstart.main([tiny_scene, "-o", str(output), "--iterations", "10", "--quiet", "--overwrite"]) == 0
    assert sorted(path.name for path in output.glob("*.png")) == ["compare_view_000.png", "compare_view_008.png",
                                                                  "mine.png"]


@pytest.mark.parametrize("name", ["alpha", "scene"])
def test_nothing_is_written_where_a_link_in_the_folder_leads(tiny_scene, tmp_path, capsys, name):
    output, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    output.mkdir()
    elsewhere.mkdir()
    (output / name).symlink_to(elsewhere)
    files.write_json_atomically(str(output / ".dsmoe.json"), {"command": "quickstart", "of": tiny_scene, "files": []})
    assert quickstart.main([tiny_scene, "-o", str(output), "--iterations", "10", "--quiet"]) == 1
    assert f"{output / name} leads to {elsewhere} by a link" in capsys.readouterr().err
    assert not list(elsewhere.iterdir())


def test_given_options_win_over_chosen_ones(tiny_scene):
    chosen = quickstart.choose_options(tiny_scene, {})
    assert (chosen.iterations, chosen.densify_until_iter, chosen.strategy) == (3000, 1050, "importance")
    # About 144 points: behind 50, at 100 to 500, each densification doubles them; the least would be 10,000.
    assert chosen.budget == 2**5 * len(read_colmap(tiny_scene).points.positions)
    assert chosen.resolution == -1, "images this small are not reduced"
    given = quickstart.choose_options(tiny_scene, {"iterations": 600, "densify_until_iter": 100, "strategy": "3dgs"})
    assert (given.iterations, given.densify_until_iter, given.opacity_reset_interval) == (600, 100, 60)
    assert given.strategy == "3dgs"


def test_a_budget_of_none_is_chosen(tiny_scene):
    assert given_options(parse([tiny_scene, "--budget", "0", "--seed", "4"])) == {"seed": 4}
    assert check([tiny_scene, "--budget", "0"]) == 0


@pytest.mark.parametrize("asks", [["--device", "cuda"], []])
def test_that_no_gpu_is_there_is_told_without_torch(tiny_scene, tmp_path, monkeypatch, capsys, asks):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("DSMOE_DEVICE", "cpu" if asks else "cuda")
    monkeypatch.setattr(quickstart_options, "GPU_FILES", (str(tmp_path / "nvidia*"),))
    assert check([tiny_scene, *asks]) == 1
    source = asks[0] if asks else "DSMOE_DEVICE"
    assert f"error: {source} is cuda, and this machine has no NVIDIA GPU" in capsys.readouterr().err
    (tmp_path / "nvidia0").touch()
    assert check([tiny_scene, *asks]) == 0


def test_large_scenes_are_reduced_and_told(monkeypatch, tiny_scene, capsys):
    monkeypatch.setattr(short_run, "MAX_PIXELS", 200)  # of 32x24: width 16.3
    assert quickstart.choose_options(tiny_scene, {}).resolution == 16
    assert "--resolution 16" in capsys.readouterr().out
    assert quickstart.choose_options(tiny_scene, {"resolution": 1}).resolution == 1


def test_a_gpu_trains_at_full_size(monkeypatch, tiny_scene, capsys):
    monkeypatch.setattr(short_run, "MAX_PIXELS", 200)
    config = quickstart.choose_options(tiny_scene, {"device": "cuda"})
    assert (config.resolution, config.init_points, config.device) == (-1, 0, "cuda")
    assert config.iterations == FAST["cuda"].iterations and config.strategy == "importance"
    assert "about a minute: --iterations" in capsys.readouterr().out


def test_each_scene_has_a_folder_of_its_name(tiny_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scenes = [shutil.copytree(tiny_scene, str(tmp_path / parent / "garden")) for parent in ("one", "two")]
    output = tmp_path / "quickstart_output"
    for scene in [*scenes, scenes[0]]:
        assert quickstart.main([scene, "--iterations", "10", "--quiet"]) == 0
        assert capsys.readouterr().out.startswith("device: cpu (")
    names = sorted(os.listdir("quickstart_output"))
    subjects = [json.loads((output / name / ".dsmoe.json").read_text())["of"] for name in names]
    assert dict(zip(names, subjects)) == {"garden": scenes[0], "garden_2": scenes[1], "garden_3": scenes[0]}
    assert output_and_subject(parse([])) == ("quickstart_output/room", MADE_UP)
    for options, name in (([], "garden_4"), (["--overwrite"], "garden_2")):
        assert output_and_subject(parse([scenes[1], *options]))[0] == f"quickstart_output/{name}"
    for name in json.loads((output / "garden" / ".dsmoe.json").read_text())["files"]:
        (output / "garden" / name).unlink()  # as if it was interrupted while the first model was measured
    shutil.rmtree(output / "garden" / "smoe")
    assert output_and_subject(parse([scenes[0]]))[0] == "quickstart_output/garden_4"
    assert check([scenes[0], "-o", str(output / "garden")]) == 1
    assert "earlier comparison (alpha/point_cloud)" in capsys.readouterr().err
    shutil.rmtree(output / "garden" / "alpha" / "point_cloud")  # before the first model
    assert output_and_subject(parse([scenes[0]]))[0] == "quickstart_output/garden"
    assert quickstart.main([scenes[0], "--iterations", "10", "--quiet"]) == 0
    assert (output / "garden" / "results.json").is_file()


def test_errors_are_one_line(tmp_path, capsys):
    assert quickstart.main([str(tmp_path / "nowhere"), "-o", str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err == f"quickstart: error: scene {tmp_path / 'nowhere'}: no such folder\n"


def test_an_output_that_is_a_file_is_one_line(tiny_scene, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert quickstart.main([tiny_scene, "-o", str(tmp_path / "file"), "--quiet"]) == 1
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and str(tmp_path / "file") in text


def test_without_a_scene_one_is_made(tmp_path, monkeypatch, capsys):
    make = quickstart.write_synthetic_scene
    monkeypatch.setattr(quickstart, "write_synthetic_scene",
                        lambda folder, progress: make(folder, views=9, width=32, height=24, points=150,
                                                       supersampling=1))
    assert quickstart.main(["-o", str(tmp_path), "--iterations", "12", "--quiet"]) == 0
    assert "making a scene" in capsys.readouterr().out
    assert (tmp_path / "scene" / "images" / "view_003.png").is_file() and (tmp_path / "smoe.ply").is_file()


def test_comparison_magnifies_under_whole_pictures_where_the_renderings_differ():
    """Not where the ground truth has its edges."""
    truth = np.random.RandomState(0).randint(0, 255, (40, 80, 3)).astype(np.uint8)
    other = truth.copy()
    other[22:30, 50:66] //= 2
    left, top, right, bottom = window_of_differences(*map(Image.fromarray, (truth, other)))
    assert (right - left, bottom - top) == (20, 10)
    assert left <= 50 and right >= 66 and top <= 22 and bottom >= 30
    sheet = np.asarray(comparison(Image.fromarray(truth), [("alpha", Image.fromarray(truth)),
                                                           ("smoe", Image.fromarray(other))]))
    factor = 4 * 400 // 80  # a quarter is magnified to the size of the whole, whose width becomes 400
    window = sheet[-200 - MARGIN:-MARGIN:factor, -400 - MARGIN:-MARGIN:factor]
    np.testing.assert_array_equal(window, other[top:bottom, left:right])


@pytest.mark.parametrize("count, wanted, expected", [(0, 3, []), (1, 3, [0]), (2, 3, [0, 1]), (6, 3, [0, 2, 5]),
                                                     (37, 3, [0, 18, 36])])
def test_evenly_spaced(count, wanted, expected):
    assert evenly_spaced(count, wanted) == expected
