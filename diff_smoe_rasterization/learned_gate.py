"""The background's gate lambda as a parameter of this process, which a trainer that cannot be edited learns.

`background_gate="learned"` in the settings of a rendering takes it. The gate steps with the optimizer that holds the
centres of the Gaussians; if none does, with the first that steps after a backward pass. Of an optimizer that is none of
torch's it learns at the next rendering, by the centres that have changed in place. A trainer that replaces an optimizer
and keeps the old one, between a backward pass and its step, costs the gate that step.
"""
from __future__ import annotations

import gc
import importlib
import math
import warnings
import weakref
from typing import Any, Dict, Iterable, Optional, Sequence, Tuple, Union

import torch

from . import extension  # noqa: F401  (loading it registers the ops)
from .optimizers import corrected_rates
from .settings import MAX_BACKGROUND_GATE

START = 0.1
RATE = 0.03  # of Adam, for the logarithm
BETAS = (0.9, 0.999)
EPSILON = 1e-8
LIMIT = math.log(MAX_BACKGROUND_GATE)  # of |log lambda|: beyond it float32 would soon be 0 or infinite
_gate_adam = torch.ops.diff_smoe_rasterization.gate_adam.default


def launch_step(logarithm: torch.Tensor, moment: torch.Tensor, square: torch.Tensor, value: torch.Tensor,
                gradient: torch.Tensor, rate: float, root_scale: float, betas: Tuple[float, float],
                bound: float) -> None:
    """One step of Adam in place on a gate's logarithm p; value becomes bound + exp(p). Tensors [1]; nothing waits.

    gradient: by the value; one that is not finite counts as 0. rate, root_scale: as `corrected_rates` gives them.
    """
    _gate_adam(logarithm, moment, square, value, gradient, rate, root_scale, *betas, EPSILON, bound, LIMIT)


def step_gate(logarithm: torch.Tensor, adam: Dict[str, Any], value: torch.Tensor, gradient: torch.Tensor, rate: float,
              betas: Tuple[float, float], bound: float) -> None:
    """`launch_step` with Adam's state, {} before the first step, and a rate that is not corrected yet."""
    if not adam:
        adam.update(step=0, exp_avg=torch.zeros_like(logarithm), exp_avg_sq=torch.zeros_like(logarithm))
    adam["step"] = int(adam["step"]) + 1
    corrected = corrected_rates({"lr": rate, "betas": betas}, adam["step"])
    launch_step(logarithm, adam["exp_avg"], adam["exp_avg_sq"], value, gradient, *corrected, betas, bound)


class ProcessGate:
    """lambda = exp(p) of this process, stepped by Adam. Start and rate are those of `dsmoe train`; it has no bound."""

    def __init__(self) -> None:
        self._hook: Any = None
        self.reset()

    def reset(self, frozen: bool = False) -> None:
        """Begins at START. frozen: the gate of a trained model; `found` sets it, nothing steps it."""
        self.frozen = frozen
        self.renders = False  # whether anything was rendered, with this gate or another
        self.blend_mode: Optional[str] = None  # of the last rendering with this gate; None: there was none
        self._found: Optional[float] = None  # what a file said of it, until it is stepped
        self._adam: Dict[str, Any] = {}
        self._learns = False  # whether a rendering had its gradient
        self._centres: Any = None  # a weak reference to those of the last one, if they are a parameter
        self._version = 0  # of their values then
        self._holder: Any = None  # likewise to the optimizer that holds them
        self._unheld: Any = None  # likewise to centres that no optimizer was found to hold
        self._put(torch.full((1,), math.log(START)))

    def _put(self, logarithm: torch.Tensor) -> None:
        with torch.inference_mode(False):
            self._logarithm = logarithm.clone()
            self._value = self._logarithm.exp().requires_grad_()
        if not _HAS_HOOKS:
            self._value.register_hook(self._step)

    @property
    def learns(self) -> bool:
        """Whether a rendering of this process had its gradient."""
        return self._learns

    @property
    def is_known(self) -> bool:
        """Whether it is learned here, or a file has said it."""
        return not self.frozen or self._found is not None

    def value(self) -> float:
        """Returns lambda; on a GPU the host waits for it. Raises RuntimeError if a trained model has not said it."""
        if self._found is not None:
            return self._found
        if self.frozen:
            raise RuntimeError("the model was trained with a learned background gate, and no file that was read says "
                               "which (its .ply, .npz or checkpoint): give it as a number, --background_gate V")
        return float(self._value.detach())

    def found(self, value: float, state: Optional[Dict[str, Any]] = None) -> None:
        """Takes the lambda of a model that was read; with the `state_dict` of its training that goes on exactly."""
        start = value if value > 0 else START
        state = state or {"logarithm": math.log(start), "adam": {}}
        with torch.inference_mode(False), torch.no_grad():  # renderings that come later have gradients
            self._logarithm.fill_(state["logarithm"])
            self._value.data = torch.full_like(self._value, start)
            self._adam = {name: one if name == "step" else torch.full_like(self._logarithm, one)
                          for name, one in state["adam"].items()}
        self._found, self._value.grad = value, None

    def state_dict(self) -> Dict[str, Any]:
        """Returns plain numbers, for a checkpoint; on a GPU the host waits for them."""
        return {"logarithm": float(self._logarithm),
                "adam": {name: one if name == "step" else float(one) for name, one in self._adam.items()}}

    def of_rendering(self, blend_mode: str, tensors: Sequence[torch.Tensor], means3D: Optional[torch.Tensor]
                     ) -> Union[float, torch.Tensor]:
        """Returns the lambda of a rendering. It has a gradient if one of the tensors has one. Raises RuntimeError.

        tensors: of the Gaussians; lambda has the type and device of the first. means3D: their centres, if known.
        """
        self.blend_mode, like = blend_mode, tensors[0]
        with_gradient = not self.frozen and torch.is_grad_enabled() and any(one.requires_grad for one in tensors)
        if not with_gradient and (self.frozen or self._found is not None):
            return self.value()
        if like.is_cuda and torch.cuda.is_current_stream_capturing():
            raise RuntimeError("Python steps a learned background gate, and a CUDA graph does not repeat that; where a "
                               "graph is captured give background_gate as a tensor or a number")
        if self._logarithm.device != like.device and not self._learns:
            self._adam = {name: one if name == "step" else one.to(like.device) for name, one in self._adam.items()}
            self._put(self._logarithm.to(like.device))
        if not with_gradient:
            return self._value.detach().to(like)
        self._begin()
        if means3D is not None:
            self._watch(means3D)
        value = self._value.view(1)  # a step between a rendering and its backward pass changes none: see `_step`
        if self._found == 0:  # the logarithm cannot begin there: until the first step 0 is rendered
            value = value - self._value.detach()
        return value.to(like)

    def _begin(self) -> None:
        distributed = torch.distributed
        if not self._learns and distributed.is_available() and distributed.is_initialized() and (
                distributed.get_world_size() > 1):
            warnings.warn(f"diff_smoe_rasterization: each of the {distributed.get_world_size()} processes of this "
                          "training learns a background gate of its own, by its own views, and records that; "
                          "background_gate as a number is the same in all", stacklevel=2)
        self._learns = True
        if _HAS_HOOKS and self._hook is None:
            self._hook = _optimizers.register_optimizer_step_post_hook(self._after_step)
        elif not _HAS_HOOKS:
            self._value.grad = None  # it was stepped in the backward pass

    def _watch(self, means3D: torch.Tensor) -> None:
        """Notes whose step the gate waits for.

        A gradient may wait that no optimizer of torch took. If the centres were changed in place, and none of torch
        is known to hold them, an optimizer of another kind has stepped. If their gradient is gone or all 0, or they
        are gone, the trainer dropped it.
        """
        if not means3D.is_leaf or not means3D.requires_grad:
            self._centres = None
            return
        before = _alive(self._centres)
        gradient = self._value.grad
        if gradient is not None and before is means3D and means3D._version != self._version and (
                _alive(self._holder) is None):
            self._step(gradient)
            self._value.grad = None
        elif self._centres is not None and (before is None or before is means3D and means3D.grad is None):
            self._value.grad = None
        elif gradient is not None and before is means3D:
            gradient *= means3D.grad.any()  # zero_grad(set_to_none=False); the host does not wait
        self._centres, self._version = weakref.ref(means3D), means3D._version

    def _after_step(self, optimizer: Any, *_: Any) -> None:
        centres, holder = _alive(self._centres), _alive(self._holder)
        if centres is not None and optimizer is not holder and _holds(optimizer, centres):
            holder, self._holder = optimizer, weakref.ref(optimizer)
        gradient = self._value.grad
        if gradient is None:
            return
        if centres is not None and holder is None and _alive(self._unheld) is not centres:
            holder = next((one for one in _all_optimizers() if _holds(one, centres)), None)
            self._holder = None if holder is None else weakref.ref(holder)
            self._unheld = weakref.ref(centres) if holder is None else None
        # While the gate waits, densification may replace the centres in their optimizer, or both by others.
        if self._centres is None or holder is None or optimizer is holder:
            self._step(gradient)
            self._value.grad = None

    @torch.no_grad()
    def _step(self, gradient: torch.Tensor) -> None:
        """One step, in one launch: the new value has memory of its own, and renderings keep the one that they have."""
        value = torch.empty_like(self._value)
        step_gate(self._logarithm, self._adam, value, gradient, RATE, BETAS, 0.0)
        self._value.data, self._found = value, None


def _alive(reference: Any) -> Any:
    """What a weak reference refers to; None if that is gone, or there is no reference."""
    return None if reference is None else reference()


def _holds(optimizer: Any, parameter: torch.Tensor) -> bool:
    return any(one is parameter for group in optimizer.param_groups for one in group["params"])


def _all_optimizers() -> Iterable[Any]:
    """Those of torch's kind in this process: torch has no list of them."""
    return (one for one in gc.get_objects() if issubclass(type(one), _optimizers.Optimizer))


_optimizers: Any = importlib.import_module("torch.optim.optimizer")
_HAS_HOOKS = hasattr(_optimizers, "register_optimizer_step_post_hook")  # torch 2.0; before, it steps in backward passes

gate = ProcessGate()
"""The gate of `background_gate="learned"`, in every rendering of this process."""


def gate_of(background_gate: Any, blend_mode: str, tensors: Iterable[torch.Tensor],
            means3D: Optional[torch.Tensor] = None) -> Any:
    """Returns what a rendering takes for a resolved background gate: itself, or for LEARNED `gate.of_rendering`."""
    gate.renders = True
    if isinstance(background_gate, str):
        return gate.of_rendering(blend_mode, [tensor for tensor in tensors if tensor is not None], means3D)
    return background_gate
