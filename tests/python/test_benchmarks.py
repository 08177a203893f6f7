"""The benchmark command runs, and the memory that a rendering keeps is what the project promises."""
from __future__ import annotations

import json
import os
import sys

import pytest
import torch

from diff_smoe_rasterization.settings import BLEND_MODES

sys.path.insert(0, os.path.join(os.path.dirname(__file__), "..", "..", "benchmarks"))
import cpu_rasterizer  # noqa: E402
import memory  # noqa: E402
import models  # noqa: E402


@pytest.fixture(autouse=True)
def same_number_of_threads_afterwards():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_the_command_measures_every_case(tmp_path, capsys):
    path = tmp_path / "out.json"
    assert cpu_rasterizer.main(["--synthetic", "300", "--repeats", "1", "--threads", "1,2", "--modes", "alpha,smoe",
                                "--no-memory", "--json", str(path)]) == 0
    rows = {(row["mode"], row["threads"]): row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}
    assert sorted(rows) == [("alpha", 1), ("alpha", 2), ("smoe", 1), ("smoe", 2)]
    for row in rows.values():
        stages = [row[name] for name in cpu_rasterizer.STAGES]
        assert min(stages) > 0
        assert sum(stages) <= row["total"]
        # A gate reaches 4.8 sigma, an alpha at most 3.33: more pairs are walked. Threads change nothing.
        assert 0 < rows["alpha", 1]["forward_pairs"] < rows["smoe", 1]["forward_pairs"]
        assert row["forward_pairs"] == rows[row["mode"], 1]["forward_pairs"]
    assert "times the floor" in capsys.readouterr().out


def test_the_command_refuses_what_does_not_fit(capsys):
    for arguments, reason in ((["--synthetic", "9", "--modes", "beta"], "--modes"), ([], "--synthetic"),
                              (["--ply", "a.ply"], "--scene"), (["--synthetic", "9", "--views", "1"], "--views")):
        with pytest.raises(SystemExit):
            cpu_rasterizer.main(arguments)
        assert reason in capsys.readouterr().err


@pytest.mark.parametrize("mode", BLEND_MODES)
def test_a_graph_keeps_less_than_the_limits(mode):
    model = models.synthetic(2000)
    counts, kept = memory.kept_tensors(model.inputs, model.settings(0, mode))
    assert counts[:2] == (2000, 800 * 533)
    assert counts.instances > 2000
    by_unit = memory.per_unit(counts, kept)
    assert all(0 < by_unit[unit] <= memory.LIMITS[unit] for unit in memory.UNITS)
    # Whatever no unit explains is one number a tile.
    unexplained = sum(size for _, size in kept) - sum(count * by_unit[unit] for count, unit in zip(counts, by_unit))
    assert 0 <= unexplained <= 8 * (800 // 16 * (533 // 16 + 1) + 1)
