"""Adam in one pass over memory: over every Gaussian, or over those that were visible."""
from __future__ import annotations

import math
from typing import Any, Callable, Dict, Iterable, List, Optional, Tuple

import torch

from .checks import check_tensors, checked_number
from .extension import BACKENDS  # noqa: F401  (loading it registers the ops)

_OPS = torch.ops.diff_smoe_rasterization


class _Adam(torch.optim.Adam):
    """torch.optim.Adam that does not import torch._dynamo when it is made: that takes seconds."""

    def add_param_group(self, param_group: Dict[str, Any]) -> None:
        add = torch.optim.Adam.add_param_group
        getattr(add, "__wrapped__", add)(self, param_group)  # the decorator around it keeps it out of compiled graphs


class FusedAdam(_Adam):
    """Adam as torch.optim.Adam computes it, but for rounding: one kernel launch a step for each precision and device.

    Groups and state are torch.optim.Adam's but for state["step"], an int here. Each takes the state_dict() of the
    other. If a group asks for weight_decay, amsgrad or maximize, or a gradient is sparse or neither float32 nor
    float64, the step is torch.optim.Adam's own.
    """

    def __init__(self, params: Iterable[Any], lr: float = 1e-3, betas: Any = (0.9, 0.999), eps: float = 1e-8) -> None:
        for name, value in (("lr", lr), ("eps", eps)):
            if not checked_number("FusedAdam", name, value) >= 0:
                raise ValueError(f"FusedAdam: {name} is {value}; it must be 0 or more")
        if not isinstance(betas, (tuple, list)) or len(betas) != 2:
            raise TypeError(f"FusedAdam: betas is {betas!r}; it must be two numbers")
        if not all(0 <= checked_number("FusedAdam", "betas", beta) < 1 for beta in betas):
            raise ValueError(f"FusedAdam: betas is {betas}; both must be in [0, 1)")
        super().__init__(params, lr=lr, betas=tuple(betas), eps=eps)

    @torch.no_grad()
    def step(self, closure: Optional[Callable[[], Any]] = None) -> Any:
        """Steps every parameter that has a gradient."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if not all(_is_fused(group) for group in self.param_groups):
            for state in self.state.values():
                state["step"] = torch.as_tensor(state["step"], dtype=torch.float32)
            super().step()
            return loss
        launches: Dict[Any, _Launch] = {}
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state.update(step=0, **_zero_moments(parameter))
                age = state["step"] = int(state["step"]) + 1
                _launch_of(launches, parameter, group).add(parameter, state, *corrected_rates(group, age))
        for launch in launches.values():
            launch.run()
        return loss


def corrected_rates(group: Dict[str, Any], step: int) -> Tuple[float, float]:
    """The rate and the root scale (include/dsmoe/training/adam.h) of a group's step number `step`, 1 in the first."""
    beta1, beta2 = group["betas"]
    return group["lr"] / (1 - beta1**step), 1 / math.sqrt(1 - beta2**step)


class SparseGaussianAdam(_Adam):
    """Adam that steps only the Gaussians that a view saw; the call of the 3DGS (2024) and Taming trainers.

    The moments are not corrected for their start at zero, the betas are 0.9 and 0.999, and the rows of Gaussians that
    were not seen keep value and moments: as those trainers' own optimizer of this name, whose results it matches but
    for rounding. Each group holds one parameter [N, ...].
    """

    def __init__(self, params: Iterable[Any], lr: float, eps: float) -> None:
        for name, value in (("lr", lr), ("eps", eps)):
            checked_number("SparseGaussianAdam", name, value)
        super().__init__(params=params, lr=lr, eps=eps)

    @torch.no_grad()
    def step(self, visibility: torch.Tensor, N: int) -> None:  # type: ignore[override]
        """Steps the rows whose visibility [N] (bool) is set, of every parameter that has a gradient."""
        check_tensors("SparseGaussianAdam.step", visibility=visibility)
        if visibility.numel() != checked_number("SparseGaussianAdam.step", "N", N):
            raise ValueError(f"SparseGaussianAdam.step: visibility has shape {list(visibility.shape)}; "
                             f"it must be [N] with N = {N}")
        launches: Dict[Any, _Launch] = {}
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise ValueError(f"SparseGaussianAdam.step: group {group.get('name', '')!r} has "
                                 f"{len(group['params'])} parameters; each must have one")
            parameter = group["params"][0]
            if parameter.grad is None or N == 0:
                continue
            state = self.state[parameter]
            if not state:
                state.update(step=torch.tensor(0.0), **_zero_moments(parameter))
            _launch_of(launches, parameter, group).add(parameter, state, group["lr"], 1.0)
        for launch in launches.values():
            launch.run(visibility.reshape(N))


class _Launch:
    """Parameters that one call of the op steps."""

    def __init__(self, beta1: float, beta2: float, epsilon: float) -> None:
        self.constants = (beta1, beta2, epsilon)
        self.parameters: List[torch.Tensor] = []
        self.gradients: List[torch.Tensor] = []
        self.moments: List[torch.Tensor] = []
        self.squares: List[torch.Tensor] = []
        self.rates: List[float] = []
        self.root_scales: List[float] = []

    def add(self, parameter: torch.Tensor, state: Dict[str, Any], rate: float, root_scale: float) -> None:
        """rate, root_scale: as in include/dsmoe/training/adam.h."""
        self.parameters.append(parameter)
        self.gradients.append(parameter.grad)
        self.moments.append(state["exp_avg"])
        self.squares.append(state["exp_avg_sq"])
        self.rates.append(float(rate))
        self.root_scales.append(float(root_scale))

    def run(self, visible: Optional[torch.Tensor] = None) -> None:
        # The op takes rows that lie one behind the other. A parameter made from a transposed array, as trainers make
        # the first means, has other strides, and so have moments that a trainer made like it.
        updated = self.parameters + self.moments + self.squares
        dense = [tensor.contiguous() for tensor in updated]
        count = len(self.parameters)
        _OPS.adam(dense[:count], [gradient.contiguous() for gradient in self.gradients], dense[count:2 * count],
                  dense[2 * count:], self.rates, self.root_scales, *self.constants, visible)
        for tensor, copy in zip(updated, dense):
            if not tensor.is_contiguous():
                tensor.copy_(copy)


def _launch_of(launches: Dict[Any, _Launch], parameter: torch.Tensor, group: Dict[str, Any]) -> _Launch:
    """The launch that the parameter may join."""
    beta1, beta2 = group["betas"]
    key = (parameter.dtype, parameter.device, beta1, beta2, group["eps"])
    launch = launches.get(key)
    if launch is None:
        launch = launches[key] = _Launch(beta1, beta2, group["eps"])
    return launch


def _is_fused(group: Dict[str, Any]) -> bool:
    """Whether the op has what a group of torch.optim.Adam asks for; an earlier version's groups have fewer options."""
    gradients = [parameter.grad for parameter in group["params"] if parameter.grad is not None]
    return (not any(group.get(option) for option in ("weight_decay", "amsgrad", "maximize"))
            and all(gradient.dtype in (torch.float32, torch.float64) and gradient.layout == torch.strided
                    for gradient in gradients))


def _zero_moments(parameter: torch.Tensor) -> Dict[str, torch.Tensor]:
    return {name: torch.zeros_like(parameter, memory_format=torch.contiguous_format)
            for name in ("exp_avg", "exp_avg_sq")}
