"""weightedDistance against all distances in float64."""
from __future__ import annotations

import pytest
import torch

from diff_smoe_rasterization.integrations import weighted_distance


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
