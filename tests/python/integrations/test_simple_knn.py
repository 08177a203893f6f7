"""simple_knn of both kinds: the neighbours' indices against brute force, and which kind a file is written for."""
from __future__ import annotations

import importlib
import sys

import pytest
import torch
from devices import random_normal

from diff_smoe_rasterization import distCUDA2
from diff_smoe_rasterization.integrations import simple_knn


def squared_distances(points):
    squared = (points[:, None] - points[None]).double().square().sum(2)
    return squared.fill_diagonal_(torch.inf)


# Fewer than the points of a chunk, as many, one more; and several chunks.
@pytest.mark.parametrize("count", [4, 64, 65, 700])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_three_nearest_in_order(count, dtype, device):
    points = random_normal((count, 3), 11, dtype)
    points[0] *= 50  # an outlier
    found = simple_knn.neighbours_of(points, distCUDA2(points))
    assert found.dtype == torch.int32 and found.device == points.device
    assert torch.equal(found.long(), squared_distances(points).topk(3, largest=False).indices)


def test_points_that_coincide_are_each_others_neighbours(device):
    points = torch.cat([random_normal((300, 3), 12).repeat_interleave(4, 0), torch.ones(600, 3).double() * 9])
    found = simple_knn.neighbours_of(points, distCUDA2(points)).long()
    assert (points[found] == points[:, None]).all(), "four in each place"
    assert all(len({i, *row}) == 4 for i, row in enumerate(found.tolist())), "three others"


def test_fewer_than_four_points_are_refused():
    points = torch.rand(3, 3)
    with pytest.raises(ValueError, match="3 points have no three neighbours"):
        simple_knn.neighbours_of(points, distCUDA2(points))


KINDS = {  # what a trainer's file does with the results, and whether there are two
    "found = distCUDA2(points)[0].clamp_min(0)\ndistances, indices = distCUDA2(points)": True,  # FSGS
    "import simple_knn_C\ndistances, _ = simple_knn_C.distCUDA2(points)": True,
    "found = torch.clamp_min(distCUDA2(points), 0)[..., None]": False,  # 3DGS
    "found = distCUDA2(points)[:, None]": False, "a = b = distCUDA2(points)": False,
    "found = distCUDA2(points)[0]": None}  # the first result, or the first point's


@pytest.mark.parametrize("code", KINDS)
def test_a_file_that_unpacks_the_results_gets_two(code, tmp_path, monkeypatch):
    (tmp_path / "simple_knn_C.py").write_text("from diff_smoe_rasterization.integrations.simple_knn import distCUDA2\n")
    (tmp_path / "model.py").write_text("import torch\nfrom simple_knn_C import distCUDA2\n"
                                       "def kind(points):\n    return distCUDA2(points)\ndef use(points):\n    "
                                       + code.replace("\n", "\n    ") + "\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("model", "simple_knn_C"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    model = importlib.import_module("model")
    points = torch.rand(9, 3)
    if KINDS[code] is None:
        with pytest.raises(TypeError, match="model.py takes an element of what distCUDA2 returns"):
            model.kind(points)
        return
    model.use(points)
    result = model.kind(points)
    if KINDS[code]:
        assert torch.equal(result[0], distCUDA2(points)) and result[1].shape == (9, 3)
    else:
        assert torch.equal(result, distCUDA2(points))
