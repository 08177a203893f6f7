"""scatter and scatter_max against loops over the elements."""
from __future__ import annotations

import pytest
import torch

from diff_smoe_rasterization.integrations.torch_scatter import scatter, scatter_max


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
    with pytest.raises(ValueError, match="index"):
        scatter(torch.zeros(3, 2, 2), torch.zeros(3, 2, dtype=torch.int64))
