"""The parts of a step on a GPU, between which hooks run: `Launched` computes them, graphs.py captures that."""
from __future__ import annotations

from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

import torch

from diff_smoe_rasterization.direct import DirectRendering
from diff_smoe_rasterization.extension import BACKENDS  # noqa: F401  (loading it registers the ops)
from diff_smoe_rasterization.gaussians import activate
from diff_smoe_rasterization.lazy_adam import LazyAdam
from diff_smoe_rasterization.optimizers import corrected_rates
from diff_smoe_rasterization.settings import GaussianRasterizationSettings, Rendering

from ..model import PARAMETERS, GaussianModel
from ..optimizer import GaussianOptimizer
from ..scenes.images import View
from .gate import LearnedGate

_OPS = torch.ops.diff_smoe_rasterization
ACTIVATED = ("opacities", "scales", "rotations")
GEOMETRY = ("means3D", *ACTIVATED)  # what the projection reads of every Gaussian


class ViewOver(NamedTuple):
    """A training view, and the background of this step."""

    view: View
    background: Optional[torch.Tensor]  # [3] in place of the renderer's


Compare = Callable[[ViewOver, torch.Tensor], Tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
"""From a rendering [3, H, W] to what it is compared with, the loss, and its gradient by the rendering."""


class Frame(NamedTuple):
    """What a step renders."""

    shown: ViewOver
    settings: GaussianRasterizationSettings


class Numbers(NamedTuple):
    """What else the launches read that changes from step to step."""

    missed: int  # steps that rows of the harmonics may have missed
    geometry: List[float]  # Adam's rates, two for each of GEOMETRY
    colors: List[float]  # and for each colour parameter


class DeviceNumbers:
    """The numbers in memory of the device, which all steps share."""

    def __init__(self, like: torch.Tensor) -> None:
        self._all = like.new_zeros(1 + 2 * len(PARAMETERS))
        self.missed = self._all[:1]
        self.geometry, self.colors = self._all[1:].view(-1, 2).split([len(GEOMETRY), len(PARAMETERS) - len(GEOMETRY)])

    def send(self, numbers: Numbers, to: Sequence[torch.Tensor] = (), given: Sequence[torch.Tensor] = ()) -> None:
        """Sets them, and copies given tensors to others, in one launch."""
        values = [float(numbers.missed), *numbers.geometry, *numbers.colors]
        _OPS.set_inputs(list(to), list(given), self._all[:len(values)], values)


class Drawn(NamedTuple):
    """What a step has rendered and compared."""

    direct: DirectRendering
    rendering: Rendering
    target: torch.Tensor
    loss: torch.Tensor
    dL_dcolor: torch.Tensor


class StepParts:
    """The parts of a step, called in this order. All that changes from step to step is in memory of the device."""

    numbers: DeviceNumbers

    def send(self, frame: Frame, numbers: Numbers) -> None:
        """Sends the numbers, and what the view needs."""
        raise NotImplementedError

    def draw(self, frame: Frame, compare: Compare) -> Drawn:
        """Renders, and compares; the results hold until these parts draw again."""
        raise NotImplementedError

    def differentiate(self, drawn: Drawn) -> None:
        """From the gradient by the image to those by all parameters and the gate."""
        raise NotImplementedError

    def update(self, radii: torch.Tensor) -> None:
        """Steps all parameters. radii: of what was drawn."""
        raise NotImplementedError


class Launched(StepParts):
    """The parts of a step, launched; and the memory of gradients, numbers and activations, which all steps share."""

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, gate: Optional[LearnedGate]) -> None:
        self.model, self.optimizer, self.gate = model, optimizer, gate
        self.numbers = DeviceNumbers(model.stored["means3D"])
        self.activations: List[torch.Tensor] = []  # of the parameters named in ACTIVATED
        self._made_of: List[Tuple[torch.Tensor, int]] = []  # these, and their versions at that time
        self._buffers: Dict[str, torch.Tensor] = {}

    def send(self, frame: Frame, numbers: Numbers) -> None:
        self.numbers.send(numbers)

    def draw(self, frame: Frame, compare: Compare) -> Drawn:
        parameters = self.model.stored
        colors = {argument: parameters[name] for argument, name in self.model.color_sources().items()}
        opacities, scales, rotations = self.activations
        direct = DirectRendering(
            parameters["means3D"], opacities, frame.settings, means2D=self._buffer("means2D", "means3D"),
            scales=scales, rotations=rotations, **colors)
        self._lazy.launch_catch_up(direct.visible_radii(), self.numbers.missed)
        rendering = direct.render()
        return Drawn(direct, rendering, *compare(frame.shown, rendering.color))

    def differentiate(self, drawn: Drawn) -> None:
        gradients = {**self.geometry_gradients(), "means2D": self.means2D_gradient()}
        gradients.update(zip(self.model.color_sources(), self._lazy.gradients))
        if self.gate:
            gradients["background_gate"] = self.gate.gradient
        drawn.direct.backward({"color": drawn.dL_dcolor}, gradients)

    def update(self, radii: torch.Tensor) -> None:
        self.step_geometry(radii)
        self.step_colors(radii)

    def step_geometry(self, seen: torch.Tensor) -> None:
        """seen: [N] int32 above 0 if there is a gradient."""
        raw, states = [self.model.stored[name] for name in GEOMETRY], self._states()
        group, zeros = self.optimizer.group("scales"), [0.0] * len(raw)
        _OPS.gaussian_adam(raw, self.activations, list(self.geometry_gradients().values()),
                           [state["exp_avg"] for state in states], [state["exp_avg_sq"] for state in states],
                           seen, zeros, zeros, *group["betas"], group["eps"], self.numbers.geometry)
        self._made_of = [(tensor, tensor._version) for tensor in raw[1:]]

    def step_colors(self, radii: torch.Tensor) -> None:
        self._lazy.launch_step(radii, self.numbers.missed, self.numbers.colors[:len(self._lazy.parameters)])

    def count_step(self) -> None:
        """Counts a step of the geometry, which its rates depend on."""
        for state in self._states():
            state["step"] = int(state["step"]) + 1

    def geometry_rates(self, ahead: int) -> List[float]:
        """Of the latest step, or of one ahead of it; row by row, as `gaussian_adam` takes them."""
        return [number for name, state in zip(GEOMETRY, self._states())
                for number in corrected_rates(self.optimizer.group(name), int(state["step"]) + ahead)]

    def _states(self) -> List[Dict[str, Any]]:
        """Adam's, of the geometry."""
        states = []
        for name in GEOMETRY:
            tensor = self.model.stored[name]
            state = self.optimizer.adam.state[tensor]
            if not state:
                state.update(step=0, exp_avg=torch.zeros_like(tensor), exp_avg_sq=torch.zeros_like(tensor))
            states.append(state)
        return states

    def activate(self) -> None:
        """Makes the activations anew if something else than `update` has changed what they are made of."""
        raw = [self.model.stored[name] for name in ACTIVATED]
        if len(self._made_of) != len(raw) or any(tensor is not made_of or tensor._version != version
                                                 for tensor, (made_of, version) in zip(raw, self._made_of)):
            values = list(activate(*raw))
            if [value.shape for value in values] == [value.shape for value in self.activations]:
                for value, new in zip(self.activations, values):  # graphs know where they lie
                    value.copy_(new)
            else:
                self.activations = values
            self._made_of = [(tensor, tensor._version) for tensor in raw]

    def geometry_gradients(self) -> Dict[str, torch.Tensor]:
        """By the activated geometry, in the order of GEOMETRY; written in rows of radii above 0."""
        return {name: self._buffer("d" + name, name) for name in GEOMETRY}

    def means2D_gradient(self) -> torch.Tensor:
        """By the places on the image, likewise."""
        return self._buffer("dmeans2D", "means3D")

    def _buffer(self, name: str, like: str) -> torch.Tensor:
        """Memory of the shape of a parameter, the same in every step as long as that is."""
        parameter, buffer = self.model.stored[like], self._buffers.get(name)
        if buffer is None or buffer.shape != parameter.shape:
            buffer = self._buffers[name] = torch.empty_like(parameter, requires_grad=False)
        return buffer

    @property
    def _lazy(self) -> LazyAdam:
        assert self.model.lazy is not None, "a step begins with lazy_colors"
        return self.model.lazy
