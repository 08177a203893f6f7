"""simple_knn, torch_scatter and weighted_distance against brute force, loops over the elements and float64."""
from __future__ import annotations

import importlib
import sys

import pytest
import torch
from devices import random_normal

from diff_smoe_rasterization import distCUDA2
from diff_smoe_rasterization.integrations import simple_knn, weighted_distance
from diff_smoe_rasterization.integrations.torch_scatter import scatter, scatter_max


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


def test_sums_by_index():
    """As c3dgs calls it: rows by a vector of indices, and a vector."""
    torch.manual_seed(0)
    values, index = torch.randn(50, 6), torch.randint(0, 7, (50,))
    index[index == 3] = 4  # row 3 gets nothing
    expected = torch.zeros(9, 6)
    for row, place in zip(values, index):
        expected[place] += row
    torch.testing.assert_close(scatter(values, index, 0, reduce="sum", dim_size=9), expected)
    torch.testing.assert_close(scatter(values[:, 0], index, 0, reduce="sum", dim_size=9), expected[:, 0])
    assert scatter(values, index, 0).shape == (int(index.max()) + 1, 6)


def test_maxima_by_index():
    """As HAC calls it: an index of the values' own shape, expanded from a column."""
    torch.manual_seed(1)
    values, index = torch.randn(40, 5), torch.randint(0, 6, (40,))
    index[index == 2] = 3
    largest, places = scatter_max(values, index.unsqueeze(1).expand(-1, 5), dim=0)
    assert largest.shape == places.shape == (int(index.max()) + 1, 5)
    for row in range(len(largest)):
        for column in range(5):
            members = [(float(values[i, column]), i) for i in range(40) if index[i] == row]
            value, place = max(members, key=lambda member: (member[0], -member[1]), default=(0.0, 40))
            assert float(largest[row, column]) == value and int(places[row, column]) == place
    assert (places[2] == 40).all() and (largest[2] == 0).all()


def test_negative_and_equal_values():
    largest, places = scatter_max(torch.tensor([-3.0, -1.0, -1.0, -2.0]), torch.tensor([0, 0, 0, 2]), dim_size=3)
    assert largest.tolist() == [-1.0, 0.0, -2.0] and places.tolist() == [1, 4, 3]


def test_gradients():
    torch.manual_seed(2)
    values = torch.randn(8, 3, dtype=torch.float64, requires_grad=True)
    index = torch.tensor([0, 1, 0, 3, 3, 1, 0, 3])
    assert torch.autograd.gradcheck(lambda src: scatter(src, index, 0), (values,))
    assert torch.autograd.gradcheck(lambda src: scatter_max(src, index, 0)[0], (values,))


def test_what_is_not_offered_is_refused():
    values, index = torch.zeros(3), torch.zeros(3, dtype=torch.int64)
    with pytest.raises(NotImplementedError, match="mean"):
        scatter(values, index, reduce="mean")
    with pytest.raises(NotImplementedError, match="out"):
        scatter_max(values, index, out=values)


@pytest.mark.parametrize("shape, axes, dim", [
    ((6, 5, 3), (6, 5), 0), ((6, 5, 3), (6, 1), 0), ((6, 5, 3), (6, 5), 1), ((6, 5, 3), (1, 5, 1), 1),
    ((6, 5, 3), (5,), 1), ((6, 5, 3), (5,), -2), ((6, 5, 3), (3,), -1), ((6, 1, 3), (6, 1), 0), ((6,), (6,), -1),
    ((0, 3), (0,), 0)], ids=str)
def test_an_index_is_broadcast(shape, axes, dim):
    """Octree-AnyGS gives one of [N, C] for features [N, C, 3]. Against a loop over the elements."""
    values, index = random_normal(shape, 3), torch.randint(0, 4, axes)
    spread = [1] * (dim % len(shape)) + list(axes) if len(axes) == 1 else list(axes)
    every = index.reshape(spread + [1] * (len(shape) - len(spread))).expand(shape)
    size = [4 if axis == dim % len(shape) else length for axis, length in enumerate(shape)]
    sums, largest = torch.zeros(size).double(), torch.full(size, -torch.inf).double()
    for place in torch.cartesian_prod(*map(torch.arange, shape)).reshape(-1, len(shape)).tolist():
        to = list(place)
        to[dim] = int(every[tuple(place)])
        sums[tuple(to)] += values[tuple(place)]
        largest[tuple(to)] = max(largest[tuple(to)], values[tuple(place)])
    torch.testing.assert_close(scatter(values, index, dim, dim_size=4), sums)
    found, _ = scatter_max(values, index, dim, dim_size=4)
    assert torch.equal(found, torch.where(largest > -torch.inf, largest, torch.zeros(())))


@pytest.mark.parametrize("function", [scatter, scatter_max])
@pytest.mark.parametrize("index, dim, error, words", [
    (torch.zeros(3, 2, 2, 1, dtype=torch.int64), 0, ValueError, r"index has shape \[3, 2, 2, 1\]; it must fit src"),
    (torch.zeros(3, dtype=torch.int64), 1, ValueError, r"index has shape \[3\]; it must fit src, \[3, 2, 2\]"),
    (torch.zeros(2, 2, dtype=torch.int64), 0, ValueError, r"index has shape \[2, 2\]; it must fit"),
    (torch.zeros(3), 0, TypeError, "index is torch.float32; it must be torch.int64"),
    ([0, 0, 0], 0, TypeError, "index is of type list"),
    (torch.zeros(3, dtype=torch.int64), 3, ValueError, "dim is 3; src has 3 axes")], ids=str)
def test_an_index_that_does_not_fit_is_named(function, index, dim, error, words):
    with pytest.raises(error, match=f"{function.__name__}: {words}"):
        function(torch.zeros(3, 2, 2), index, dim)


@pytest.mark.parametrize("at_once", [2 ** 26, 50, 1])
def test_the_nearest_row(monkeypatch, at_once):
    """However many are compared at once. Rows lie close together, far from 0, where products would lose them."""
    monkeypatch.setattr(weighted_distance, "DISTANCES_AT_ONCE", at_once)
    torch.manual_seed(0)
    coefs, codebook = 100 + torch.rand(37, 6), 100 + torch.rand(11, 6)
    distances, indices = weighted_distance.weightedDistance(coefs, codebook)
    every = (coefs.double()[:, None] - codebook.double()).square().sum(2)
    assert distances.dtype == torch.float32 and indices.dtype == torch.int64
    # Differences of these float32 numbers are exact; six squares and their sum round eleven times, by half a digit.
    torch.testing.assert_close(distances.double(), every.min(1).values, rtol=11 * 2 ** -24, atol=0)
    assert (indices == every.min(1).indices).all()


@pytest.mark.parametrize("far", [1e6, 1e30, 3e38, -3e38, float("inf"), float("nan")])
def test_a_row_far_from_all_others_changes_nothing_for_these(far):
    """c3dgs makes such rows of a codebook: it divides random ones by their trace, which may be small."""
    torch.manual_seed(0)
    coefs, codebook = 100 + torch.rand(37, 6), 100 + torch.rand(11, 6)
    codebook[3] = far
    every = (coefs.double()[:, None] - codebook.double()).square().sum(2).nan_to_num(nan=torch.inf)
    assert (weighted_distance.weightedDistance(coefs, codebook)[1] == every.min(1).indices).all()
    codebook[3] = 100
    nearest = (coefs.double()[:, None] - codebook.double()).square().sum(2).min(1).indices
    coefs[5] = far
    others = torch.arange(37) != 5
    assert (weighted_distance.weightedDistance(coefs, codebook)[1] == nearest)[others].all()


def test_no_rows_and_wrong_shapes():
    distances, indices = weighted_distance.weightedDistance(torch.zeros(0, 3), torch.zeros(2, 3))
    assert distances.shape == indices.shape == (0,)
    for coefs, codebook in ((torch.zeros(4, 3), torch.zeros(2, 4)), (torch.zeros(4, 3), torch.zeros(0, 3)),
                            (torch.zeros(3), torch.zeros(2, 3))):
        with pytest.raises(ValueError, match="weightedDistance: coefs has shape"):
            weighted_distance.weightedDistance(coefs, codebook)
