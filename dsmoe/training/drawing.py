"""Rows that are drawn by weights, of any number of rows."""
from __future__ import annotations

import torch

from ..errors import TrainerError

MOST_ROWS = 2 ** 24  # of which torch.multinomial draws


def draw(weights: torch.Tensor, count: int, replacement: bool = False) -> torch.Tensor:
    """Returns rows [count], drawn by weights [N] of at least 0; without replacement count of them must be above 0.

    Raises TrainerError for weights of which a training that goes on has none, such as NaN.
    """
    total = float(weights.sum())
    if not 0 < total < float("inf"):
        raise TrainerError(f"the training has diverged: the weights of its Gaussians sum to {total}; lower the "
                           "learning rates")
    if len(weights) <= MOST_ROWS:
        return torch.multinomial(weights, count, replacement=replacement)
    if not replacement:  # Efraimidis and Spirakis 2006: each row waits for a time of its rate; the first ones are drawn
        return torch.topk(weights / torch.empty_like(weights).exponential_(), count).indices
    sums = weights.double().cumsum(0)
    places = torch.rand(count, dtype=sums.dtype, device=sums.device) * sums[-1]
    return torch.searchsorted(sums, places, right=True)
