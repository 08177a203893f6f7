"""How a step comes from its views to gradients and to the next parameters, in three kinds with the same numbers.

`AutogradPasses` takes any rasterizer. `DirectPasses` is for a GPU, on which a step is bound by memory traffic and by
Python: it steps spherical harmonics lazily, makes one pass of activations and Adam, writes no gradient of what was not
seen, and repeats steps as CUDA graphs. `BatchPasses`, in distributed/passes.py, take several views and processes.
"""
from __future__ import annotations

import weakref
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional, Sequence, Set, Tuple

import torch

from diff_smoe_rasterization.direct import DirectRendering
from diff_smoe_rasterization.extension import BACKENDS  # noqa: F401  (loading it registers the ops)
from diff_smoe_rasterization.gaussians import activate
from diff_smoe_rasterization.lazy_adam import LazyAdam
from diff_smoe_rasterization.optimizers import corrected_rates
from diff_smoe_rasterization.settings import GaussianRasterizationSettings, Rendering
from diff_smoe_rasterization.splats import Splats

from ..model import PARAMETERS, GaussianModel
from ..optimizer import GaussianOptimizer
from ..results.rendering import Renderer, package_rasterizer
from ..scenes.cameras import Camera
from ..scenes.images import View
from .gate import LearnedGate
from .graphs import Captured, Graphs, NoGraphs
from .strategy import Look, Step, ViewStep, look_at

_OPS = torch.ops.diff_smoe_rasterization
ACTIVATED = ("opacities", "scales", "rotations")
GEOMETRY = ("means3D", *ACTIVATED)  # what the projection reads of every Gaussian


class ViewOver(NamedTuple):
    """A training view, and the background of this step."""

    view: View
    background: Optional[torch.Tensor]  # [3] in place of the renderer's


Compare = Callable[[ViewOver, torch.Tensor], Tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
"""From a rendering [3, H, W] to what it is compared with, the loss, and its gradient by the rendering."""


class Passes:
    """The passes of one step after the other. Each step calls `render`, `backward` and, but for the last, `update`."""

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer,
                 gate: Optional[LearnedGate] = None) -> None:
        """gate: the background's, if it is learned."""
        self.model, self.optimizer, self.renderer, self.gate = model, optimizer, renderer, gate

    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare, looked: Sequence[int] = ()) -> Step:
        """Renders the views of the step that ends with this iteration, compares them, and looks at some of them."""
        raise NotImplementedError

    def backward(self, step: Step) -> None:
        """From the gradients by the images to those by all parameters and the gate; sets `seen` of the step."""
        raise NotImplementedError

    def update(self) -> None:
        """Steps the parameters that have not been replaced since `render`."""
        raise NotImplementedError

    def look(self, views: Sequence[View]) -> Iterator[Look]:
        """Renders views beside the steps, and looks at each."""
        for view in views:
            rendering, splats = self.renderer.with_splats(view.camera)
            yield look_at(view, view.image, rendering.color, splats)

    @torch.enable_grad()
    def _add_gradient(self, name: str, number: float) -> None:
        """Adds a number to the gradient by every opacity, scale or rotation (the parameter's name); after backward."""
        value = self.model.activated()[ACTIVATED.index(name)]
        value.backward(torch.full_like(value, number))


class AutogradPasses(Passes):
    """The passes as torch knows them."""

    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare, looked: Sequence[int] = ()
               ) -> ViewStep:
        (shown,) = views
        rendering, self._means2D, splats = self._draw(shown.view.camera, shown.background)
        target, loss, self._dL_dcolor = compare(shown, rendering.color.detach())
        step = ViewStep(iteration, 1, loss, self._add_gradient, shown.view, target, rendering)
        step.looks += [look_at(shown.view, target, rendering.color, splats()) for _ in looked]
        return step

    def backward(self, step: Step) -> None:
        assert isinstance(step, ViewStep)
        self._color.backward(self._dL_dcolor)
        gradient = self._means2D.grad
        assert gradient is not None
        step.seen.append((gradient, step.rendering.radii))
        del self._means2D, self._dL_dcolor, self._color  # which hold on to memory

    def _draw(self, camera: Camera, background: Optional[torch.Tensor]
              ) -> Tuple[Rendering, torch.Tensor, Callable[[], Splats]]:
        """The image, a tensor [N, 3] whose .grad `backward` sets if radii > 0, and what the image says of each.

        background: in place of the renderer's.
        """
        means2D = torch.zeros_like(self.model.raw["means3D"], requires_grad=True)
        gate = None
        if self.gate:
            gate = self.gate.value.clone().requires_grad_()
            gate.grad = self.gate.gradient.zero_()  # to which autograd adds; 0 if a given rasterizer leaves it out
        view = (camera, background, gate)
        if self.renderer.rasterize is package_rasterizer():
            rendering, splats = self.renderer.with_splats(*view, means2D=means2D)
            self._color = rendering.color
            return rendering, means2D, lambda: splats
        rendering = self.renderer(*view, means2D=means2D)
        self._color = rendering.color
        return rendering, means2D, lambda: self.renderer.with_splats(*view)[1]

    def update(self) -> None:
        self.optimizer.step()


class _Drawn(NamedTuple):
    """What `DirectPasses` draw of a view."""

    direct: DirectRendering
    rendering: Rendering
    target: torch.Tensor
    loss: torch.Tensor
    dL_dcolor: torch.Tensor


class DirectPasses(Passes):
    """The same numbers in fewer passes over memory; as CUDA graphs if steps are alike.

    A step has three parts, whose launches read all that changes from step to step in memory of the device: `_numbers`
    and, in a graph, copies of the view. So hooks run between the parts, whether these are launched or replayed.
    """

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer,
                 gate: Optional[LearnedGate] = None, loss_rule: Callable[[int], Any] = lambda iteration: iteration,
                 graphs: Optional[Graphs] = None) -> None:
        """loss_rule: `Strategy.loss_rule`. graphs: capture the steps; None: they are not."""
        super().__init__(model, optimizer, renderer, gate)
        self._loss_rule, self._graphs = loss_rule, graphs or NoGraphs()
        self._values: List[torch.Tensor] = []  # what `activate` makes of the parameters
        self._made_of: List[Tuple[torch.Tensor, int]] = []  # these, and their versions at that time
        self._buffers: Dict[str, torch.Tensor] = {}  # gradients
        # How many steps harmonics may have missed, then the rates of geometry and of harmonics, as the ops take them.
        self._numbers = model.stored["means3D"].new_zeros(1 + 2 * len(PARAMETERS))

    @torch.no_grad()
    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare, looked: Sequence[int] = ()
               ) -> ViewStep:
        (shown,) = views
        stored, lazy = self.model.stored, self.optimizer.lazy_colors()
        # Weak: parameters that a densification replaces are freed at once, not at the next rendering.
        self._rendered = {name: weakref.ref(tensor) for name, tensor in stored.items()}
        self._activate()
        steps = lazy.begin_catch_up()
        settings = self.renderer.settings_of(shown.view.camera, shown.background)
        kind = self._graphs.kind(settings, self._loss_rule(iteration), *shown)
        self._captured: Optional[Captured] = None  # of the step before: it may hold on to memory
        self._captured = self._graphs.find(
            [*stored.values(), lazy], kind, lambda captured: self._capture(captured, settings, shown, compare))
        self._sent = [float(steps), *self._rates(1), *lazy.next_rates()]
        numbers = self._numbers[:len(self._sent)]
        if self._captured:
            self._drawn: _Drawn = self._captured.replay_draw(numbers, self._sent, settings, *shown)
        else:
            _OPS.set_inputs([], [], numbers, self._sent)
            self._drawn = self._draw(settings, shown, compare)
        lazy.end()
        drawn = self._drawn
        self._radii = self._stepped = drawn.rendering.radii
        step = ViewStep(iteration, 1, drawn.loss, self._add_gradient, shown.view, drawn.target, drawn.rendering)
        step.looks += [look_at(shown.view, drawn.target, drawn.rendering.color, drawn.direct.splats()) for _ in looked]
        return step

    @torch.no_grad()
    def backward(self, step: Step) -> None:
        stored = self.model.stored
        self._gradients = {name: self._buffer("d" + name, stored[name]) for name in GEOMETRY}
        if self._captured:
            self._captured.replay_differentiate()
        else:
            self._differentiate(self._drawn)
        step.seen.append((self._buffer("dmeans2D", stored["means3D"]), self._radii))
        del self._drawn  # which holds on to memory

    @torch.no_grad()
    def update(self) -> None:
        stored, lazy = self.model.stored, self.model.lazy
        same = {name for name in PARAMETERS if stored[name] is self._rendered[name]()}
        geometry = same.issuperset(GEOMETRY)
        colors = lazy is not None and same.issuperset(self.model.color_sources().values())
        if not geometry and same.intersection(GEOMETRY):
            self._step_some(same)
        numbers = list(self._sent)
        if geometry:
            self._count_step()
            numbers[1:1 + 2 * len(GEOMETRY)] = self._rates(0)
        if colors and lazy is not None:
            numbers[0], numbers[1 + 2 * len(GEOMETRY):] = lazy.begin_step()
        if numbers != self._sent:  # a hook has changed learning rates, or read the model
            _OPS.set_inputs([], [], self._numbers[:len(numbers)], numbers)
        if self._captured and geometry and colors and self._stepped is self._radii:
            self._captured.replay_update()
        else:
            if geometry:
                self._step_geometry(self._stepped)
            if colors and lazy is not None:
                self._step_colors(lazy, self._radii)
        if colors and lazy is not None:
            lazy.end()

    def _capture(self, captured: Captured, settings: GaussianRasterizationSettings, shown: ViewOver,
                 compare: Compare) -> None:
        """Captures the parts of a step like this one; nothing is computed."""
        lazy = self.model.lazy
        assert lazy is not None
        settings, view, background = captured.copies(settings, *shown)

        def update() -> None:
            radii = captured.drawn.rendering.radii
            self._step_geometry(radii)
            self._step_colors(lazy, radii)

        captured.capture(lambda: self._draw(settings, ViewOver(view, background), compare), self._differentiate, update)

    def _draw(self, settings: GaussianRasterizationSettings, shown: ViewOver, compare: Compare) -> _Drawn:
        parameters, lazy = self.model.stored, self.model.lazy
        assert lazy is not None
        colors = {argument: parameters[name] for argument, name in self.model.color_sources().items()}
        direct = DirectRendering(
            parameters["means3D"], self._values[0], settings, means2D=self._buffer("means2D", parameters["means3D"]),
            scales=self._values[1], rotations=self._values[2], **colors)
        lazy.launch_catch_up(direct.visible_radii(), self._numbers[:1])
        rendering = direct.render()
        return _Drawn(direct, rendering, *compare(shown, rendering.color))

    def _differentiate(self, drawn: _Drawn) -> None:
        """From the gradient by the image to those by all parameters and the gate."""
        stored, lazy = self.model.stored, self.model.lazy
        assert lazy is not None
        gradients = {name: self._buffer("d" + name, stored[name]) for name in GEOMETRY}
        gradients.update(zip(self.model.color_sources(), lazy.gradients))
        gradients["means2D"] = self._buffer("dmeans2D", stored["means3D"])
        if self.gate:
            gradients["background_gate"] = self.gate.gradient
        drawn.direct.backward({"color": drawn.dL_dcolor}, gradients)

    def _add_gradient(self, name: str, number: float) -> None:
        if self._stepped is self._radii:  # rows that were not seen hold anything
            for gradient in self._gradients.values():
                gradient.masked_fill_((self._radii <= 0).unsqueeze(1), 0)
            self._stepped = torch.ones_like(self._radii)
        self._gradients[name] += number

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

    def _count_step(self) -> None:
        for state in self._states():
            state["step"] = int(state["step"]) + 1

    def _rates(self, ahead: int) -> List[float]:
        """Of the geometry's latest step, or of one ahead of it; row by row, as `gaussian_adam` takes them."""
        return [number for name, state in zip(GEOMETRY, self._states())
                for number in corrected_rates(self.optimizer.group(name), int(state["step"]) + ahead)]

    def _step_geometry(self, seen: torch.Tensor) -> None:
        """By the rates in `_numbers`. seen: [N] int32 above 0 if there is a gradient."""
        raw, states = [self.model.stored[name] for name in GEOMETRY], self._states()
        group, zeros = self.optimizer.group("scales"), [0.0] * len(raw)
        _OPS.gaussian_adam(raw, self._values, [self._buffer("d" + name, self.model.stored[name]) for name in GEOMETRY],
                           [state["exp_avg"] for state in states], [state["exp_avg_sq"] for state in states],
                           seen, zeros, zeros, *group["betas"], group["eps"],
                           self._numbers[1:1 + 2 * len(raw)].view(-1, 2))
        self._made_of = [(tensor, tensor._version) for tensor in raw[1:]]

    def _step_colors(self, lazy: LazyAdam, radii: torch.Tensor) -> None:
        first = 1 + 2 * len(GEOMETRY)
        rates = self._numbers[first:first + 2 * len(lazy.parameters)].view(-1, 2)
        lazy.launch_step(radii, self._numbers[:1], rates)

    def _step_some(self, same: Set[str]) -> None:
        """If an opacity reset has replaced a parameter: the others are stepped by the dense optimizer."""
        unseen = (self._stepped <= 0).unsqueeze(1)
        gradients = {name: gradient.masked_fill(unseen, 0) for name, gradient in self._gradients.items()}
        raw = _OPS.activate_backward([self.model.stored[name] for name in ACTIVATED], self._values,
                                     *(gradients[name] for name in ACTIVATED))
        gradients.update(zip(ACTIVATED, raw))
        for name in same.intersection(GEOMETRY):
            self.model.stored[name].grad = gradients[name]
        self.optimizer.step()

    def _activate(self) -> None:
        """Makes the values anew if something else than `update` has changed what they are made of."""
        raw = [self.model.stored[name] for name in ACTIVATED]
        if len(self._made_of) != len(raw) or any(tensor is not made_of or tensor._version != version
                                                 for tensor, (made_of, version) in zip(raw, self._made_of)):
            values = list(activate(*raw))
            if [value.shape for value in values] == [value.shape for value in self._values]:
                for value, new in zip(self._values, values):  # graphs know where they lie
                    value.copy_(new)
            else:
                self._values = values
            self._made_of = [(tensor, tensor._version) for tensor in raw]

    def _buffer(self, name: str, like: torch.Tensor) -> torch.Tensor:
        """Memory of a gradient, the same in every step as long as its shape is."""
        buffer = self._buffers.get(name)
        if buffer is None or buffer.shape != like.shape:
            buffer = self._buffers[name] = torch.empty_like(like, requires_grad=False)
        return buffer
