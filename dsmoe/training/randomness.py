"""All chance of a training: seeds and states of generators, the order of views, and rows drawn by weights."""
from __future__ import annotations

import random
from typing import Any, Dict, List

import numpy as np
import torch

from ..errors import TrainerError

MOST_ROWS = 2 ** 24  # of which torch.multinomial draws


def seed_everything(seed: int) -> None:
    """Seeds every generator that a run may use."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def random_state(device: str) -> Dict[str, Any]:
    """The states of all generators of a training on the device, as tensors and plain values.

    Of GPUs only the process's own: a run may go on where there are fewer.
    """
    name, keys, position, has_gauss, gauss = np.random.get_state()
    return {
        "python": random.getstate(),
        "numpy": (name, keys.tolist(), position, has_gauss, gauss),
        "torch": torch.get_rng_state(),
        "cuda": [] if device == "cpu" else [torch.cuda.get_rng_state()],
    }


def restore_random_state(state: Dict[str, Any], device: str) -> None:
    """Takes what `random_state` gave, of several GPUs the first."""
    version, numbers, gauss = state["python"]
    random.setstate((version, tuple(numbers), gauss))
    name, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, np.array(keys, np.uint32), position, has_gauss, gauss))
    torch.set_rng_state(state["torch"].cpu())
    if state["cuda"] and device != "cpu":
        torch.cuda.set_rng_state(state["cuda"][0].cpu())


class ViewOrder:
    """The order in which training views are seen: random, without replacement, epoch after epoch.

    It has a random generator of its own, so that nothing else shifts the order.
    """

    def __init__(self, count: int, seed: int) -> None:
        self.count = count
        self.random = random.Random(seed)
        self.remaining: List[int] = []

    def next(self) -> int:
        """The next view; each is seen once before any is seen again."""
        if not self.remaining:
            self.remaining = list(range(self.count))
            self.random.shuffle(self.remaining)
        return self.remaining.pop()

    def state_dict(self) -> Dict[str, Any]:
        return {"left": list(self.remaining), "random": self.random.getstate()}

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        version, numbers, gauss = state["random"]
        self.remaining = list(state["left"])
        self.random.setstate((version, tuple(numbers), gauss))


def draw(weights: torch.Tensor, count: int, replacement: bool = False) -> torch.Tensor:
    """Returns rows [count], drawn by weights [N], 0 or more; without replacement `count` of them must be above 0.

    Raises TrainerError for weights that no training in order has, such as NaN.
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
