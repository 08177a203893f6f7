"""Stand-ins in plain torch that trainers get on a GPU: on CUDA the results that they have on the CPU."""
from __future__ import annotations

import torch

from diff_smoe_rasterization.integrations import weighted_distance
from diff_smoe_rasterization.integrations.torch_scatter import scatter, scatter_max
from diff_smoe_rasterization.patches.runtime import unique_rows


def test_the_nearest_row_of_a_codebook(gpu, monkeypatch):
    """In parts, with a row of the codebook far from all others."""
    monkeypatch.setattr(weighted_distance, "DISTANCES_AT_ONCE", 2 ** 18)
    torch.manual_seed(0)
    coefs, codebook = torch.randint(0, 64, (2000, 6)).float(), torch.randint(0, 64, (512, 6)).float()
    codebook[3] = 1e6
    distances, indices = weighted_distance.weightedDistance(coefs.to(gpu), codebook.to(gpu))
    every = (coefs.double()[:, None] - codebook.double()).square().sum(2)
    # Whole numbers: distances are exact, and those that differ do so by 1, which no product here is wrong by.
    assert torch.equal(distances.cpu().double(), every.min(1).values)
    assert torch.equal(every.gather(1, indices.cpu()[:, None])[:, 0], every.min(1).values)


def test_distinct_rows(gpu):
    torch.manual_seed(0)
    for low, high in ((-3, 3), (-90, 90), (-2 ** 31, 2 ** 31 - 1)):
        cells = torch.randint(low, high, (20_000, 3), dtype=torch.int32)
        expected = torch.unique(cells, dim=0, return_inverse=True, return_counts=True)
        for ours, torchs in zip(unique_rows(cells.to(gpu), return_inverse=True, return_counts=True), expected):
            assert ours.dtype == torchs.dtype and torch.equal(ours.cpu(), torchs)


def test_sums_and_maxima_of_groups(gpu):
    torch.manual_seed(0)
    values, index = torch.randint(-100, 100, (5000, 4)).float(), torch.randint(0, 300, (5000,))
    # Sums of integers are exact in any order.
    assert torch.equal(scatter(values.to(gpu), index.to(gpu), 0, dim_size=310).cpu(),
                       scatter(values, index, 0, dim_size=310))
    for ours, expected in zip(scatter_max(values.to(gpu), index.to(gpu), 0, dim_size=310),
                              scatter_max(values, index, 0, dim_size=310)):
        assert torch.equal(ours.cpu(), expected)
