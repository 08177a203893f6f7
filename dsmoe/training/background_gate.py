"""The background's gate lambda, learned with the scene."""
from __future__ import annotations

import math
from typing import Any, Dict

import torch

from diff_smoe_rasterization.optimizers import corrected_rates
from diff_smoe_rasterization.settings import MAX_BACKGROUND_GATE

from ..config import TrainConfig
from ..optimizer import batch_betas

LIMIT = math.log(MAX_BACKGROUND_GATE)  # of |p|: beyond it float32 would soon be 0 or infinite
EPSILON = 1e-8  # of Adam
_OPS = torch.ops.diff_smoe_rasterization


class LearnedGate:
    """lambda = bound + exp(p): p is stepped by Adam; with the bound 0 too, lambda stays positive and finite.

    A step is one kernel, without autograd and without an optimizer.
    """

    def __init__(self, config: TrainConfig, device: str) -> None:
        """config: has bound, start and rate; by its views a step rate and betas go as those of the Gaussians."""
        self.bound = config.background_gate_bound
        self.logarithm = torch.full((1,), math.log(config.background_gate_start - self.bound), device=device)
        self._group = {"lr": config.background_gate_lr * math.sqrt(config.batch), "betas": batch_betas(config.batch)}
        self._adam: Dict[str, Any] = {}
        self.value = torch.zeros_like(self.logarithm)  # [1], always this tensor, so that renderers may hold it
        self._evaluate()
        self.gradient = torch.zeros_like(self.value)  # [1] by lambda; passes write into this tensor

    @torch.no_grad()
    def step(self) -> None:
        """One step of Adam by `gradient`; the host does not wait for the device."""
        adam = self._adam
        if not adam:
            adam.update(step=0, exp_avg=torch.zeros_like(self.value), exp_avg_sq=torch.zeros_like(self.value))
        adam["step"] = int(adam["step"]) + 1
        self._launch(adam["exp_avg"], adam["exp_avg_sq"], self.gradient, *corrected_rates(self._group, adam["step"]))

    def _evaluate(self) -> None:
        """Sets the value by a step of nothing: so it has the bits that a step gives it."""
        moment, square, gradient = self.logarithm.new_zeros(3, 1)
        self._launch(moment, square, gradient, 0.0, 1.0)

    def _launch(self, moment: torch.Tensor, square: torch.Tensor, gradient: torch.Tensor, rate: float,
                root_scale: float) -> None:
        _OPS.gate_adam(self.logarithm, moment, square, self.value, gradient, rate, root_scale, *self._group["betas"],
                       EPSILON, self.bound, LIMIT)

    def state_dict(self) -> Dict[str, Any]:
        """Tensors and plain values of a checkpoint."""
        return {"logarithm": self.logarithm, "adam": dict(self._adam)}

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        """Takes what `state_dict` gave."""
        self.logarithm.copy_(state["logarithm"])
        self._evaluate()
        self._adam = {name: value.to(self.value.device, copy=True) if isinstance(value, torch.Tensor) else value
                      for name, value in state["adam"].items()}
