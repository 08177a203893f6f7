"""Rows that are drawn by weights, also if torch.multinomial takes no more rows."""
from __future__ import annotations

import math

import pytest
import torch

from dsmoe.errors import TrainerError
from dsmoe.training import randomness

WEIGHTS = torch.tensor([0.0, 1.0, 2.0, 0.0, 5.0, 0.0])
DRAWS = 20_000


@pytest.mark.parametrize("most", [randomness.MOST_ROWS, 5])
def test_rows_come_as_often_as_their_weights_say(most, monkeypatch):
    monkeypatch.setattr(randomness, "MOST_ROWS", most)
    torch.manual_seed(0)
    shares = torch.bincount(randomness.draw(WEIGHTS, DRAWS, replacement=True), minlength=6) / DRAWS
    firsts = torch.stack([randomness.draw(WEIGHTS, 3) for _ in range(2000)])
    assert (firsts.sort(dim=1).values == torch.tensor([1, 2, 4])).all()  # each once, and none of weight 0
    for found, count in ((shares, DRAWS), (torch.bincount(firsts[:, 0], minlength=6) / 2000, 2000)):
        # Five standard deviations of a share of so many draws, at the most 0.5 / sqrt(count).
        torch.testing.assert_close(found, WEIGHTS / 8, rtol=0, atol=2.5 / count ** 0.5)
        assert (found[WEIGHTS == 0] == 0).all()


@pytest.mark.parametrize("weight", [math.nan, math.inf, 0.0])
def test_weights_of_a_diverged_training_are_told(weight):
    with pytest.raises(TrainerError, match="the training has diverged: .* lower the learning rates"):
        randomness.draw(torch.tensor([0.0, weight, 0.0]), 1)


def test_more_rows_than_torch_draws_of():
    weights = torch.zeros(randomness.MOST_ROWS + 3)
    weights[-2:] = 1
    with pytest.raises(RuntimeError, match="2\\^24"):
        torch.multinomial(weights, 1)
    last = len(weights) - 1
    assert set(randomness.draw(weights, 64, replacement=True).tolist()) == {last - 1, last}
    assert set(randomness.draw(weights, 2).tolist()) == {last - 1, last}
