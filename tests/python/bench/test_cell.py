"""A cell by itself: one process, one row whatever happens, a GPU of its own or shared."""
import json
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from bench_commands import python_that
from checkouts import environment

from diff_smoe_rasterization import io
from dsmoe.bench import cell as cells
from dsmoe.bench.expansion import expand
from dsmoe.bench.methods import native
from dsmoe.cli import main
from dsmoe.errors import TrainerError
from dsmoe.scenes.straight import EVERY


@pytest.fixture
def cell_file(content, tmp_path):
    path = tmp_path / "cell.json"
    path.write_text(json.dumps(expand(content, "").cells[0]))
    return path


def test_a_cell_whose_process_is_killed_is_a_row(cell_file, tmp_path, monkeypatch):
    """As the system does if memory is short."""
    says = "echo the last words\nprintf 'Training:  50%%|#### | 5/10 [00:01<00:01, 5.0it/s]'\nkill -9 $$\n"
    monkeypatch.setattr(cells.sys, "executable", python_that(says, tmp_path))
    row = cells.supervise(str(cell_file), str(tmp_path / "out"))
    assert not row["ok"] and row["cell"] == json.loads(cell_file.read_text())["id"]
    assert "signal 9" in row["reason"] and "memory" in row["reason"] and row["reason"].endswith(": the last words")


@pytest.mark.parametrize("gpus, told", [({}, "3"), ({"gpus": 2}, "3,5")])
def test_the_process_of_a_cell_is_told_its_gpus_and_how_many_have_them(gpus, told, cell_file, tmp_path, monkeypatch):
    monkeypatch.setattr(cells.sys, "executable", python_that("echo $CUDA_VISIBLE_DEVICES $*\n", tmp_path))
    cell = json.loads(cell_file.read_text())
    cell_file.write_text(json.dumps({**cell, "protocol": {**cell["protocol"], **gpus}}))
    assert cells.main([str(cell_file), str(tmp_path / "out"), "--gpus", "3,5,7", "--per-device", "2",
                       "--locks", str(tmp_path / "locks")]) == 0
    said = (tmp_path / "out" / "log.txt").read_text().split()
    assert said[0] == told and said[-3:] == ["--inside", "--per-device", "2"]


@pytest.mark.parametrize("module", ["cell", "engine", "report"])
def test_what_needs_no_torch_does_not_load_it(module):
    """It takes seconds, of each cell once more."""
    program = f"import sys, dsmoe.bench.{module}; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, env=environment())


def test_cells_that_share_gpus_are_spread_over_them_first(tmp_path, monkeypatch):
    def claim():
        return cells.claim_gpu(["3", "5"], str(tmp_path), per_gpu=2)

    monkeypatch.setattr(cells.time, "sleep", lambda seconds: 1 / 0)
    claims = [claim() for _ in range(4)]
    assert [gpu for gpu, _ in claims] == ["3", "5", "3", "5"]
    with pytest.raises(ZeroDivisionError):  # a fifth waits
        claim()
    claims.pop(1)[1].close()
    claims.append(claim())
    assert claims[-1][0] == "5"
    for _, lock in claims:
        lock.close()


def test_a_cell_of_two_gpus_is_trained_by_torchrun(content, tmp_path, monkeypatch):
    """Its processes are replaced by one on the CPU, which goes on with what it finds in the folder."""
    content["protocol"].update(batch=4)
    cell = {**expand(content, "").cells[0], "blend_mode": "alpha", "background_gate": 1.0}
    cell["protocol"] = {**cell["protocol"], "gpus": 2}
    launched = []
    monkeypatch.setattr(native.torchrun, "launch", lambda gpus, words: launched.append((gpus, words)) or main(words))
    (tmp_path / "cell").mkdir()
    outcome = native.run_native(cell, str(tmp_path / "cell"))
    folder = str(tmp_path / "cell" / "run")
    assert launched == [(2, ["train", "--resume", "-o", folder, "--quiet"])]
    assert outcome.notes["gpus"] == 2 and outcome.num_gaussians > 0 and outcome.evaluation.metrics["psnr"] > 5
    monkeypatch.setattr(native.torchrun, "launch", lambda gpus, words: 1)
    with pytest.raises(TrainerError, match="the training on 2 GPUs ended with status 1"):
        native.train_on(2, native.config_of(cell, folder))


def test_a_cell_says_that_some_views_were_shown_by_a_pinhole(content, tiny_scene, tmp_path):
    model = io.read_colmap(tiny_scene)
    for key, camera in model.cameras.items():
        model.cameras[key] = io.ColmapCamera(key, "OPENCV_FISHEYE", camera.width, camera.height,
                                             np.array([*camera.params, 0.02, 0, 0, 0]))
    shutil.copytree(tiny_scene, tmp_path / "bent")
    io.write_colmap(str(tmp_path / "bent" / "sparse" / "0"), model)
    cell = {**expand(content, "").cells[0], "blend_mode": "alpha", "background_gate": 1.0}
    cell["scene"] = {**cell["scene"], "path": str(tmp_path / "bent")}
    cell["protocol"] = {**cell["protocol"], "iterations": 2, "options": {"lenses": "native"}}
    (tmp_path / "cell").mkdir()
    assert native.run_native(cell, str(tmp_path / "cell")).notes["pinhole_every"] == EVERY


@pytest.fixture
def worked(content, tmp_path):
    """A function of an attempt's folder and its number of cells at once to its row."""
    def row(name, per_device=None, **changes):
        (tmp_path / name).mkdir(exist_ok=True)
        cells.work(expand({**content, **changes}, "").cells[0], str(tmp_path / name), time.time(), per_device)
        return json.loads((tmp_path / name / "row.json").read_text())

    return row


def test_a_row_says_that_its_cell_shared_its_processor(worked):
    """A training that goes on from one that shared it shared it too: its seconds hold those of that attempt."""
    alone, shared = worked("one", 1), worked("two", 3, keep_models=True)
    assert (alone["machine"].pop("cells_at_once"), shared["machine"].pop("cells_at_once")) == (1, 3)
    assert alone["machine"] == shared["machine"] and alone["protocol"] == shared["protocol"]
    again = worked("two", 1, keep_models=True)
    assert again["protocol"]["continued"] and again["machine"]["cells_at_once"] == 3


def test_a_cell_of_a_budget_ends_with_it(worked, content, tmp_path, monkeypatch):
    """By the strategy `importance`, whose options the recipe of the row has. The model goes when the row is there:
    whatever happens in between, nothing is trained again."""
    there = []
    monkeypatch.setattr(cells.shutil, "rmtree", lambda *_, **__: there.append((tmp_path / "out/row.json").exists()))
    options = {**content["protocol"]["options"], "strategy_options": "overshoot=2"}
    row = worked("out", strategies=["importance"], budgets=[40], protocol={**content["protocol"], "options": options})
    assert row["ok"], row["reason"]
    assert row["num_gaussians"] == row["budget"] == row["protocol"]["budget"] == 40
    assert row["protocol"]["recipe"]["strategy_options"] == "overshoot=2" and "_importance_0.005_n40_s0_" in row["cell"]
    assert there == [True]
