"""The order in which training views are seen: random, without replacement, epoch after epoch."""
from __future__ import annotations

import random
from typing import Any, Dict, List


class ViewOrder:
    """Draws view indices with a random generator of its own, so that nothing else shifts the order."""

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
