"""The background's gate lambda of `smoe`, learned with the scene."""
from __future__ import annotations

import math
from typing import Any, Dict

import torch

from ...optimizers import FusedAdam
from ..model import batch_betas

LEARNING_RATE = 0.01
START = 1.0


class LearnedGate:
    """lambda = bound + exp(p): p is stepped by Adam, and lambda starts at 1."""

    def __init__(self, bound: float, device: str, batch: int = 1) -> None:
        """bound: in [0, 1). batch: views a step, by which rate and betas go as those of the Gaussians."""
        self.bound = bound
        self.logarithm = torch.full((1,), math.log(START - bound), device=device, requires_grad=True)
        self.adam = FusedAdam([self.logarithm], lr=LEARNING_RATE * math.sqrt(batch), betas=batch_betas(batch))
        self.value = self().detach()  # [1], without gradient; always this tensor, so that renderers may hold it

    def __call__(self) -> torch.Tensor:
        """[1] lambda, whose gradient reaches p."""
        return self.bound + self.logarithm.exp()

    @torch.no_grad()
    def take_gradient(self, dL_dgate: torch.Tensor) -> None:
        """Sets p's gradient from the one by lambda, one number."""
        self.logarithm.grad = dL_dgate.reshape(1) * self.logarithm.exp()

    @torch.no_grad()
    def step(self) -> None:
        """One step of Adam; the host does not wait for the device."""
        self.adam.step()
        self.logarithm.grad = None
        self.value.copy_(self())

    def state_dict(self) -> Dict[str, Any]:
        """Tensors and plain values of a checkpoint."""
        return {"logarithm": self.logarithm.detach(), "adam": dict(self.adam.state.get(self.logarithm, {}))}

    @torch.no_grad()
    def load_state_dict(self, state: Dict[str, Any]) -> None:
        """Takes what `state_dict` gave."""
        self.logarithm.copy_(state["logarithm"])
        self.value.copy_(self())
        self.adam.state.clear()
        if state["adam"]:
            self.adam.state[self.logarithm] = dict(state["adam"])
