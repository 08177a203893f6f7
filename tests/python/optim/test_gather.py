"""The op `gather_rows` against indexing, over rows of several widths, on every device."""
from __future__ import annotations

import pytest
import torch
from devices import random_normal

import diff_smoe_rasterization.optimizers  # noqa: F401  (loading it registers the ops)

gather_rows = torch.ops.diff_smoe_rasterization.gather_rows


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 3000])
def test_rows_are_those_of_indexing(device, dtype, count):
    """Widths below and above a block's 1024 numbers, and more tensors than one launch holds."""
    tensors = [random_normal((700, *shape), i, dtype) for i, shape in enumerate([(3,), (1,), (15, 3), (1500,), ()] * 4)]
    rows = (random_normal((count,), 99).abs() * 1e6).long() % 700
    for tensor, taken in zip(tensors, gather_rows(tensors, rows)):
        assert torch.equal(taken, tensor[rows])


def test_rows_without_numbers(device):
    (taken,) = gather_rows([torch.zeros(4, 0, 3)], torch.tensor([2, 0, 1]))
    assert taken.shape == (3, 0, 3)


def test_what_does_not_fit_is_refused(device):
    with pytest.raises(TypeError, match="rows is int32"):
        gather_rows([torch.zeros(4)], torch.zeros(2, dtype=torch.int32))
    with pytest.raises(TypeError, match=r"tensors\[1\] is float64"):
        gather_rows([torch.zeros(4), torch.zeros(4, dtype=torch.float64)], torch.tensor([0]))


@pytest.mark.parametrize("rows, ends", [([3, -1, 0], "from -1 to 3"), ([0, 4], "from 0 to 4"), ([2 ** 40], "")])
def test_rows_that_are_not_there_are_refused(rows, ends, device):
    with pytest.raises(IndexError, match=f"gather_rows: rows has indices {ends}.*; the tensors have 4 rows"):
        gather_rows([torch.zeros(4, 3), torch.zeros(4)], torch.tensor(rows))
