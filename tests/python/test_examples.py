"""The programs of examples/ run as they stand, and do what they say."""
from __future__ import annotations

import ast
import base64
import contextlib
import dataclasses
import io as io_of_text
import json
import os
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny_scene import one_thread  # noqa: F401

from diff_smoe_rasterization import io

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run(name, *arguments, folder):
    """Runs a program in a folder, in this process: another would load torch again; returns what it prints."""
    before, output = (os.getcwd(), sys.argv, list(sys.path)), io_of_text.StringIO()
    os.chdir(str(folder))
    sys.argv, sys.path[:0] = [name, *map(str, arguments)], [str(EXAMPLES)]
    try:
        with contextlib.redirect_stdout(output):
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    finally:
        os.chdir(before[0])
        sys.argv, sys.path[:] = before[1], before[2]
    return output.getvalue()


def is_a_picture(path):
    return np.asarray(Image.open(path)).std() > 20


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A model that train.py has made, and what it printed."""
    folder = tmp_path_factory.mktemp("examples")
    text = run("train.py", "--iterations", "120", "-o", "model.ply", folder=folder)
    return folder / "model.ply", text


def test_training_lowers_the_loss_and_records_the_blend(model):
    path, text = model
    losses = [float(value) for value in re.findall(r"loss ([\d.]+)", text)]
    assert losses[-1] < 0.8 * losses[0]
    stored = io.read_gaussians(path)
    assert (stored.blend_mode, stored.background_gate, stored.sh_degree) == ("smoe", 0.0, 0)


def test_a_ply_is_rendered(model, tmp_path):
    run("render_ply.py", model[0], folder=tmp_path)
    assert is_a_picture(tmp_path / "image.png")


def test_further_images_are_written(model, tmp_path):
    text = run("further_images.py", model[0], folder=tmp_path)
    for name in ("color", "depth", "inverse_depth"):
        assert is_a_picture(tmp_path / "images" / f"{name}.png"), name
    assert (tmp_path / "images" / "alpha.png").is_file()
    nearest, farthest = map(float, re.findall(r"from ([\d.]+) to ([\d.]+)", text)[0])
    assert 0.2 < nearest < farthest < 12, "within the room, which is 8 units wide"


@pytest.mark.parametrize("name", ["render_ply.py", "further_images.py"])
def test_a_camera_that_sees_nothing_is_told(model, tmp_path, name):
    with pytest.raises(SystemExit, match="no Gaussian is seen from there; --eye X Y Z and --target"):
        run(name, model[0], "--eye", 0, 50, 0, "--target", 1, 90, 0, folder=tmp_path)


def test_a_model_of_the_paper_is_rendered_by_its_rule(model, tmp_path):
    load = runpy.run_path(str(EXAMPLES / "render_ply.py"))["load"]
    path = tmp_path / "paper.ply"
    io.write_gaussians(path, dataclasses.replace(io.read_gaussians(model[0]), comments=("faint_below 2",)))
    assert load(path)[1]["faint_below"] == 2.0 and "faint_below" not in load(model[0])[1]


def test_two_apis_render_the_same_image(tmp_path):
    text = run("other_apis.py", folder=tmp_path)
    seen, difference = re.fullmatch(r"(\d+) of 500 Gaussians are seen; the two images differ by (\S+) on average\n",
                                    text).groups()
    # float32 sums of some hundred terms, some of whose pairs lie at a cut-off.
    assert int(seen) > 400 and float(difference) < 1e-4


def test_scores_tell_which_gaussians_matter(model, tmp_path):
    text = run("scores.py", model[0], folder=tmp_path)
    best, any_ = map(float, re.findall(r"([\d.]+) dB", text))
    assert best > any_ + 2
    assert len(io.read_gaussians(tmp_path / "smaller.ply").means3D) == len(io.read_gaussians(model[0]).means3D) // 2


def test_an_own_blend_learns_a_sharper_edge(tmp_path):
    text = run("own_blend.py", "--steps", "25", folder=tmp_path)
    quality, power = zip(*((float(db), float(p)) for db, p in re.findall(r"([\d.]+) dB with the power ([\d.]+)", text)))
    assert quality[-1] > quality[0] + 5 and power[-1] > 2 and is_a_picture(tmp_path / "edge.png")


def test_smoe_fits_an_edge_with_fewer_gaussians(tmp_path):
    text = run("edge.py", "--steps", "120", folder=tmp_path)
    alpha2, smoe2, alpha4, smoe4 = map(float, re.findall(r"([\d.]+) dB", text))
    assert smoe2 > alpha2 + 4 and smoe4 > alpha4 + 4 and smoe2 > alpha4, "two by smoe are better than four by alpha"
    assert is_a_picture(tmp_path / "edge.png")


def test_the_notebook_shows_what_a_run_from_top_to_bottom_gives():
    notebook = json.loads((EXAMPLES / "blends.ipynb").read_text(encoding="utf-8"))
    variables, shown = {}, 0
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        value = run_cell("".join(cell["source"]), variables)
        stored = [output["data"] for output in cell["outputs"]]
        assert bool(stored) == (value is not None), "run `jupyter execute --inplace examples/blends.ipynb`"
        if isinstance(value, Image.Image):
            before = Image.open(io_of_text.BytesIO(base64.b64decode("".join(stored[0]["image/png"]))))
            difference = np.abs(np.asarray(value, int) - np.asarray(before.convert("RGB"), int))
            assert difference.max() <= 2, "another SIMD level adds in another order; a blend that has changed shows"
            shown += 1
    assert shown == 3 and "lambda is 0.0" in "".join(stored[0]["text/plain"]), "the last cell"
    assert variables["learned"] == pytest.approx(0.03, rel=0.1)
    alpha, smoe = variables["alpha"].color, variables["smoe"].color
    # Half a standard deviation right of the middle, alpha still mixes the background in.
    assert (smoe - alpha)[:, 40, 66].abs().max() > 0.1


def run_cell(source, variables):
    """Runs a cell as a notebook does; returns the value of its last line, if that is an expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), variables)
    return None if last is None else eval(compile(ast.Expression(last.value), "cell", "eval"), variables)


def test_one_place_through_five_lenses(model, tmp_path):
    """All look at one point, which lies in the middle of each panel."""
    run("lenses.py", model[0], "-o", "lenses.png", folder=tmp_path)
    sheet = np.asarray(Image.open(tmp_path / "lenses.png")).astype(float)
    assert sheet.shape == (499, 796, 3)
    panels = [sheet[22:217, left:left + 260] for left in (0, 268, 536)] + [sheet[239:499, :260], sheet[239:499, 268:]]
    middles = [panel[len(panel) // 2 - 1:, panel.shape[1] // 2 - 1:][:3, :3].mean((0, 1)) for panel in panels]
    assert np.abs(middles - middles[0]).max() < 30, "levels of 255"
    assert all(np.abs(panel - panels[0]).mean() > 5 for panel in panels[1:3]) and panels[4].std() > 10
