"""The background's gate lambda, learned with the scene."""
from __future__ import annotations

import math
from typing import Any, Dict

import torch

from diff_smoe_rasterization.optimizers import FusedAdam
from diff_smoe_rasterization.settings import MAX_BACKGROUND_GATE

from ..config import TrainConfig
from ..model import batch_betas

LIMIT = math.log(MAX_BACKGROUND_GATE)  # of |p|: beyond it float32 would soon be 0 or infinite


class LearnedGate:
    """lambda = bound + exp(p): p is stepped by Adam; with the bound 0 too, lambda stays positive and finite."""

    def __init__(self, config: TrainConfig, device: str) -> None:
        """config: has bound, start and rate; by its views a step rate and betas go as those of the Gaussians."""
        self.bound = config.background_gate_bound
        self.logarithm = torch.full((1,), math.log(config.background_gate_start - self.bound), device=device,
                                    requires_grad=True)
        self.adam = FusedAdam([self.logarithm], lr=config.background_gate_lr * math.sqrt(config.batch),
                              betas=batch_betas(config.batch))
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
        self.logarithm.clamp_(-LIMIT, LIMIT)
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
