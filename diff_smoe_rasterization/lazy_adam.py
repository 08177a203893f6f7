"""Adam that touches only the rows that a step reads, with the results of Adam over all rows.

Dense Adam reads four numbers and writes three for every number of every Gaussian, in every step: in training that is
more memory traffic than all else. A view shows a third of the Gaussians or less. The others have no gradient, but Adam
moves them on by their momentum, so they cannot just be left out. They can wait, though: nobody reads the spherical
harmonics of a Gaussian that is not seen. So a row's last gradient waits with it, and when the row is next read, that
step and all that it has missed since are made at once, in registers.
"""
from __future__ import annotations

from typing import Any, Dict, List, Optional, Sequence, Tuple

import torch

from .checks import check_tensors
from .extension import BACKENDS  # noqa: F401  (loading it registers the ops)
from .optimizers import FusedAdam, corrected_rates

_OPS = torch.ops.diff_smoe_rasterization
_CAPACITY = 4096  # steps whose rates are kept; then every row is brought up to date


class LazyAdam:
    """Steps parameters of a FusedAdam whose rows are read now and then: bit for bit as the FusedAdam would.

    A step has three parts:

        lazy.catch_up(radii)    # the rows that will be read are brought up to date
        ...                     # their gradients are written into lazy.gradients, in rows of radii > 0
        lazy.step(radii)        # the step is made on these rows when they are next caught up

    The parameters, and their moments in the FusedAdam, are up to date after `catch_up()`. They may be changed then, in
    place or by load_state_dict, and so may betas and eps; if a parameter gets another number of rows, make a new
    LazyAdam. Learning rates may change between steps.

    Both functions raise RuntimeError if something else than a learning rate has changed while steps waited, and
    ValueError if the groups do not fit, as the constructor does.
    """

    def __init__(self, adam: FusedAdam, parameters: Sequence[torch.Tensor]) -> None:
        """parameters: of `adam`, 1 to 4, [N, ...] dense, which the caller does not let it step. They have one age."""
        if not isinstance(adam, FusedAdam):
            raise TypeError(f"LazyAdam: adam is of type {type(adam).__name__}; it must be a FusedAdam")
        self.adam = adam
        self.parameters = list(parameters)
        if not self.parameters:
            raise ValueError("LazyAdam: parameters is empty; it must be 1 to 4 tensors")
        check_tensors("LazyAdam", **{f"parameters[{index}]": value for index, value in enumerate(self.parameters)})
        self._steps = 0  # since all rows were up to date
        self._constants: List[float] = []  # betas and eps
        self._left: List[Tuple[torch.Tensor, int]] = []
        self._left_ages: List[int] = []
        self._look_up()
        self.gradients = [torch.empty_like(parameter, requires_grad=False) for parameter in self.parameters]
        """The memory for the gradients of rows that are seen; a row keeps its gradient until it is caught up."""
        rows = len(self.parameters[0])
        self._marks = torch.zeros(rows, dtype=torch.int32, device=self.parameters[0].device)
        self._rates = self.parameters[0].new_zeros(_CAPACITY, len(self.parameters), 2)

    def _look_up(self) -> None:
        """Takes groups and states as the FusedAdam has them now: load_state_dict puts others in their place."""
        groups = {id(parameter): group for group in self.adam.param_groups for parameter in group["params"]}
        if any(id(parameter) not in groups for parameter in self.parameters):
            raise ValueError("LazyAdam: a parameter is not among those of adam")
        self._groups: List[Dict[str, Any]] = [groups[id(parameter)] for parameter in self.parameters]
        constants, *others = [[*group["betas"], group["eps"]] for group in self._groups]
        if any(other != constants for other in others):
            raise ValueError("LazyAdam: the parameters' groups differ in betas or eps; they must be the same")
        if any(group.get(option) for group in self._groups for option in ("weight_decay", "amsgrad", "maximize")):
            raise ValueError("LazyAdam: a group asks for weight_decay, amsgrad or maximize, which it does not have")
        if self._steps and (constants != self._constants or not self._is_as_left()):
            raise RuntimeError(
                f"LazyAdam: a parameter, its state in adam, betas or eps have changed while {self._steps} steps wait "
                "to be made on rows; call catch_up() before such a change, or make a new LazyAdam after it")
        self._constants = constants
        for parameter in self.parameters:
            if not self.adam.state[parameter]:
                self.adam.state[parameter].update(step=0, exp_avg=torch.zeros_like(parameter),
                                                  exp_avg_sq=torch.zeros_like(parameter))
        self._states = [self.adam.state[parameter] for parameter in self.parameters]
        if len({int(state["step"]) for state in self._states}) != 1:
            raise ValueError("LazyAdam: the parameters have made different numbers of steps; they must be the same")

    def _tensors(self) -> List[Optional[torch.Tensor]]:
        """What a step that waits will change."""
        states = [self.adam.state.get(parameter, {}) for parameter in self.parameters]
        return [*self.parameters, *(state.get(name) for state in states for name in ("exp_avg", "exp_avg_sq"))]

    def _ages(self) -> List[int]:
        return [int(self.adam.state.get(parameter, {}).get("step", 0)) for parameter in self.parameters]

    def _is_as_left(self) -> bool:
        return self._ages() == self._left_ages and all(
            left._version == version and tensor is left for tensor, (left, version) in zip(self._tensors(), self._left))

    @torch.no_grad()
    def catch_up(self, radii: Optional[torch.Tensor] = None) -> None:
        """Brings rows up to date: all, or those whose radii [N] (int32) are above 0."""
        if radii is not None:
            check_tensors("LazyAdam.catch_up", radii=radii)
        if self._steps == 0:
            return
        self._look_up()
        self._launch_catch_up(radii, None)
        self.end()
        if radii is None:
            self._marks.zero_()
            self._steps = 0

    @torch.no_grad()
    def step(self, radii: torch.Tensor) -> None:
        """Makes a step. Rows whose radii [N] (int32) are above 0 are up to date, and `gradients` has theirs."""
        check_tensors("LazyAdam.step", radii=radii)
        age, rates = self._next_step()
        _OPS.lazy_adam_step(self._marks, self._rates, self._steps, *map(list, zip(*rates)), radii)
        self._count_step(age)  # behind the op: if it refuses radii no step is counted
        self.end()

    # The same in two parts: the host's, and the launches, which read their numbers from device memory. So a loop can
    # capture the launches in a CUDA graph, and do the host's part before each replay.

    def begin_catch_up(self) -> int:
        """The host's part of `catch_up(radii)`; returns the number that `launch_catch_up` reads."""
        self._make_room()
        if self._steps > 0:
            self._look_up()
        return self._steps

    @torch.no_grad()
    def launch_catch_up(self, radii: torch.Tensor, steps: torch.Tensor) -> None:
        """The launch of `catch_up(radii)`. steps: [1] of the parameters' type, what `begin_catch_up` returned."""
        self._launch_catch_up(radii, steps)

    def next_rates(self) -> List[float]:
        """The rates that `begin_step` will return, as the learning rates are now."""
        age = int(self._states[0]["step"]) + 1
        return [number for group in self._groups for number in corrected_rates(group, age)]

    def begin_step(self) -> Tuple[int, List[float]]:
        """The host's part of `step`; returns the numbers that `launch_step` reads: steps, and the rates row by row."""
        age, rates = self._next_step()
        steps = self._steps
        self._count_step(age)
        return steps, [number for rate in rates for number in rate]

    @torch.no_grad()
    def launch_step(self, radii: torch.Tensor, steps: torch.Tensor, rates: torch.Tensor) -> None:
        """The launch of `step(radii)`. steps: [1], rates: [parameters, 2], what `begin_step` returned."""
        zeros = [0.0] * len(self.parameters)
        _OPS.lazy_adam_step(self._marks, self._rates, 0, zeros, zeros, radii, steps, rates)

    def end(self) -> None:
        """Accepts the changes up to here as the caller's launches. Call it after both, captured or not."""
        self._left = [(tensor, tensor._version) for tensor in self._tensors() if tensor is not None]
        self._left_ages = self._ages()

    def _launch_catch_up(self, radii: Optional[torch.Tensor], given_steps: Optional[torch.Tensor]) -> None:
        group = self._groups[0]
        _OPS.lazy_adam_catch_up(self.parameters, [state["exp_avg"] for state in self._states],
                                [state["exp_avg_sq"] for state in self._states], self.gradients, self._marks,
                                self._rates, self._steps, *group["betas"], group["eps"], radii, given_steps)

    def _make_room(self) -> None:
        if self._steps == len(self._rates):
            self.catch_up()

    def _next_step(self) -> Tuple[int, List[Tuple[float, float]]]:
        """How old the parameters are after the next step, and its rates."""
        self._make_room()
        self._look_up()
        age = int(self._states[0]["step"]) + 1
        return age, [corrected_rates(group, age) for group in self._groups]

    def _count_step(self, age: int) -> None:
        for state in self._states:
            state["step"] = age
        self._steps += 1
