"""A cell by itself: one process, one row whatever happens, a GPU of its own or shared."""
from __future__ import annotations

import json
import math
import time

import pytest

from diff_smoe_rasterization.benchmarks.suite import cell as cells
from diff_smoe_rasterization.benchmarks.suite.expansion import expand
from diff_smoe_rasterization.trainer.results.rendering import Renderer


@pytest.fixture
def cell_file(content, tmp_path):
    cell = expand(content, "").cells[0]
    path = tmp_path / "cell.json"
    path.write_text(json.dumps(cell))
    return cell, path


def test_a_cell_whose_process_is_killed_is_a_row(cell_file, tmp_path, monkeypatch):
    """As the system does where memory is short."""
    cell, path = cell_file
    killer = tmp_path / "python"
    killer.write_text("#!/bin/sh\necho the last words\n"
                      "printf 'Training:  50%%|#### | 5/10 [00:01<00:01, 5.0it/s]'\nkill -9 $$\n")
    killer.chmod(0o755)
    monkeypatch.setattr(cells.sys, "executable", str(killer))
    row = cells.supervise(str(path), str(tmp_path / "out"))
    assert not row["ok"] and row["cell"] == cell["id"]
    assert "signal 9" in row["reason"] and "memory" in row["reason"] and row["reason"].endswith(": the last words")


def test_two_cells_never_have_one_gpu(tmp_path):
    one, first = cells.claim_gpu(["3", "5"], str(tmp_path))
    other, second = cells.claim_gpu(["3", "5"], str(tmp_path))
    assert (one, other) == ("3", "5")
    first.close()
    again, third = cells.claim_gpu(["3", "5"], str(tmp_path))
    assert again == "3"
    second.close(), third.close()


def test_cells_that_share_gpus_are_spread_over_them_first(tmp_path):
    claims = [cells.claim_gpu(["3", "5"], str(tmp_path), per_gpu=2) for _ in range(4)]
    assert [gpu for gpu, _ in claims] == ["3", "5", "3", "5"]
    with pytest.raises(TimeoutError):  # a fifth waits
        cells.claim_gpu(["3", "5"], str(tmp_path), per_gpu=2, poll_seconds=Raises())
    claims.pop(1)[1].close()
    again, lock = cells.claim_gpu(["3", "5"], str(tmp_path), per_gpu=2)
    assert again == "5"
    lock.close()
    for _, lock in claims:
        lock.close()


class Raises:
    """A number of seconds that is never waited."""

    def __index__(self):
        raise TimeoutError


@pytest.fixture
def worked(content, tmp_path):
    """A function of an attempt's folder and its number of cells at once to its row."""
    cell = expand({**content, "keep_models": True}, "").cells[0]

    def row(name, per_device=None):
        (tmp_path / name).mkdir(exist_ok=True)
        cells.work(cell, str(tmp_path / name), time.time(), per_device)
        return json.loads((tmp_path / name / "row.json").read_text())

    return row


def test_pixels_that_are_no_numbers_are_a_rows_reason(worked, monkeypatch):
    render = Renderer.__call__

    def broken(renderer, camera, **arguments):
        rendering = render(renderer, camera, **arguments)
        if camera.name == "view_008.png":  # the second of two test views
            rendering.color[0, 5, 5] = math.nan
        return rendering

    monkeypatch.setattr(Renderer, "__call__", broken)
    row = worked("out")
    assert not row["ok"] and "the rendering of view_008.png has NaN or infinite pixels" in row["reason"]


def test_a_row_is_written_before_its_model_is_removed(content, tmp_path, monkeypatch):
    """Whatever happens in between, nothing is trained again."""
    monkeypatch.setattr(cells.shutil, "rmtree", lambda path, **options: there.append((tmp_path / "row.json").exists()))
    there = []
    cells.work(expand(content, "").cells[0], str(tmp_path), time.time())
    assert there == [True]


def test_a_row_says_that_its_cell_shared_its_processor(worked):
    alone, shared, uncounted = worked("one", 1), worked("two", 2), worked("three")
    assert (alone["machine"].pop("cells_at_once"), shared["machine"].pop("cells_at_once")) == (1, 2)
    assert alone["machine"] == shared["machine"] == uncounted["machine"]
    for row in (alone, shared):
        assert row["ok"] and row["train_seconds"] > 0 and row["fps"] > 0
    assert alone["cell"] == shared["cell"] and alone["protocol"] == shared["protocol"]


def test_a_training_that_goes_on_from_one_that_shared_its_processor_shared_it_too(worked):
    """Its seconds hold those of the attempt that was not alone."""
    worked("out", 3)
    again = worked("out", 1)
    assert again["protocol"]["continued"] and again["machine"]["cells_at_once"] == 3


def test_the_process_of_a_cell_is_told_its_gpu_and_how_many_have_it(cell_file, tmp_path, monkeypatch):
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho $CUDA_VISIBLE_DEVICES $*\n")
    python.chmod(0o755)
    monkeypatch.setattr(cells.sys, "executable", str(python))
    assert cells.main([str(cell_file[1]), str(tmp_path / "out"), "--gpus", "7", "--per-device", "2",
                       "--locks", str(tmp_path / "locks")]) == 0
    said = (tmp_path / "out" / "log.txt").read_text().split()
    assert said[0] == "7" and said[-3:] == ["--inside", "--per-device", "2"]
