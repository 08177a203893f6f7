"""Mean squared distance to the three nearest points, against brute force; on every device."""
from __future__ import annotations

import pytest
import torch
from devices import random_normal

from diff_smoe_rasterization.neighbors import distCUDA2


def brute_force(points):
    """[N] in double, over all pairs."""
    points = points.double()
    squared = (points[:, None] - points[None]).pow(2).sum(dim=2)
    squared.fill_diagonal_(float("inf"))
    count = min(3, len(points) - 1)
    return squared.sort(dim=1).values[:, :count].mean(dim=1) if count > 0 else torch.zeros(len(points)).double()


def close(actual, expected, dtype):
    # Differences of coordinates are exact to their rounding; the rest is a relative error of a few units.
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(actual.double(), expected, rtol=tolerance, atol=tolerance * float(expected.max()) * 1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
# Below, at and above the 256 points of a box; several boxes.
@pytest.mark.parametrize("count", [2, 3, 4, 5, 255, 256, 257, 1500])
def test_random_points(device, dtype, count):
    points = random_normal((count, 3), count, dtype)
    actual = distCUDA2(points)
    assert actual.shape == (count,) and actual.dtype == dtype and actual.device == points.device
    close(actual, brute_force(points), dtype)


def test_clusters_far_apart(device):
    """Almost all points fall into few cells of any grid over the bounding box."""
    centers = random_normal((8, 3), 1) * 1e4
    points = centers.repeat_interleave(100, dim=0) + 0.01 * random_normal((800, 3), 2)
    close(distCUDA2(points), brute_force(points), torch.float64)


def test_points_on_a_line_and_on_a_plane(device):
    line = random_normal((700, 3), 3)
    line[:, 1:] = 5.0
    close(distCUDA2(line), brute_force(line), torch.float64)
    plane = random_normal((700, 3), 4)
    plane[:, 2] = -1.0
    close(distCUDA2(plane), brute_force(plane), torch.float64)


def test_a_lattice_by_hand(device):
    axis = torch.arange(10, dtype=torch.float32)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3) * 2
    # Each corner, edge, face and inner point has at least three neighbours at distance 2.
    assert torch.equal(distCUDA2(points), torch.full((1000,), 4.0))


def test_duplicates_are_at_distance_zero(device):
    points = random_normal((300, 3), 5).repeat(2, 1)
    points[:4] = points[0].clone()
    actual = distCUDA2(points)
    close(actual, brute_force(points), torch.float64)
    assert (actual[:4] == 0).all(), "four points in one place"
    assert (distCUDA2(torch.ones(1000, 3)) == 0).all()


def test_few_points(device):
    assert distCUDA2(torch.zeros(0, 3)).shape == (0,)
    assert torch.equal(distCUDA2(torch.ones(1, 3)), torch.zeros(1))
    pair = torch.tensor([[0.0, 0, 0], [3, 4, 0]])
    assert torch.equal(distCUDA2(pair), torch.full((2,), 25.0))
    triple = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 3, 0]])
    assert torch.equal(distCUDA2(triple), torch.tensor([5.0, 5.5, 9.5]))


def test_slices_and_parameters(device):
    wide = random_normal((50, 6), 6, torch.float32).requires_grad_()
    points = wide[:, ::2]
    actual = distCUDA2(points)
    assert not actual.requires_grad
    close(actual, brute_force(points.detach()), torch.float32)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_point_that_is_not_finite_is_named(device, value):
    points = random_normal((10, 3), 7)
    points[6, 1] = value
    with pytest.raises(ValueError, match=r"distCUDA2: points\[6\] is not finite"):
        distCUDA2(points)


@pytest.mark.parametrize("dtype", [torch.int64, torch.float16])
def test_another_type_is_refused(device, dtype):
    with pytest.raises(TypeError, match=f"points is {str(dtype)[6:]}; it must be float32 or float64"):
        distCUDA2(torch.zeros(10, 3, dtype=dtype))


def test_another_shape_is_refused(device):
    with pytest.raises(ValueError, match=r"points has shape \[10, 2\]; it must be \[N, 3\]"):
        distCUDA2(torch.zeros(10, 2))
