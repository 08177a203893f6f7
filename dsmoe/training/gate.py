"""The background's gate lambda, learned with the scene."""
from __future__ import annotations

import math
from typing import Any, Dict

import torch

from diff_smoe_rasterization.learned_gate import launch_step, step_gate

from ..optimizer import batch_betas
from ..options.config import GateOptions


class LearnedGate:
    """lambda = bound + exp(p): p is stepped by Adam; with the bound 0 too, lambda stays positive and finite.

    A step is one kernel, without autograd and without an optimizer.
    """

    def __init__(self, options: GateOptions, batch: int, device: str) -> None:
        """batch: views a step; rate and betas follow it, as those of the Gaussians do."""
        self.bound = options.bound
        self.logarithm = torch.full((1,), math.log(options.start - self.bound), device=device)
        self._rate, self._betas = options.rate * math.sqrt(batch), batch_betas(batch)
        self._adam: Dict[str, Any] = {}
        self.value = torch.zeros_like(self.logarithm)  # [1], always this tensor, so that renderers may hold it
        self._evaluate()
        self.gradient = torch.zeros_like(self.value)  # [1] by lambda; passes write into this tensor

    @torch.no_grad()
    def step(self) -> None:
        """One step of Adam by `gradient`; the host does not wait for the device."""
        step_gate(self.logarithm, self._adam, self.value, self.gradient, self._rate, self._betas, self.bound)

    def _evaluate(self) -> None:
        """Sets the value by a step of nothing: so it has the bits that a step gives it."""
        moment, square, gradient = self.logarithm.new_zeros(3, 1)
        launch_step(self.logarithm, moment, square, self.value, gradient, 0.0, 1.0, self._betas, self.bound)

    def state_dict(self) -> Dict[str, Any]:
        """Tensors and plain values of a checkpoint."""
        return {"logarithm": self.logarithm, "adam": dict(self._adam)}

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        """Takes what `state_dict` gave."""
        self.logarithm.copy_(state["logarithm"])
        self._evaluate()
        self._adam = {name: value.to(self.value.device, copy=True) if isinstance(value, torch.Tensor) else value
                      for name, value in state["adam"].items()}
