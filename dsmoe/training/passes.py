"""How a step comes from its views to gradients and to the next parameters, in three kinds with the same numbers.

`AutogradPasses` takes any rasterizer. `DirectPasses` is for a GPU, on which a step is bound by memory traffic and by
Python: it steps spherical harmonics lazily, makes one pass of activations and Adam, writes no gradient of what was not
seen, and repeats steps as CUDA graphs. `BatchPasses`, in distributed/passes.py, take several views and processes.
"""
from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any, Callable, Iterator, Optional, Sequence, Set, Tuple

import torch

from diff_smoe_rasterization.settings import Rendering
from diff_smoe_rasterization.splats import Splats

from ..model import PARAMETERS, GaussianModel
from ..optimizer import GaussianOptimizer
from ..results.rendering import Renderer, package_rasterizer
from ..scenes.cameras import Camera
from ..scenes.images import View
from .gate import LearnedGate
from .graphs import Graphs, NoGraphs
from .step_parts import ACTIVATED, GEOMETRY, Compare, Drawn, Frame, Launched, Numbers, StepParts, ViewOver
from .strategy import Look, Step, ViewStep, look_at


class Passes:
    """Begins one step after the other, and renders views beside them."""

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer,
                 gate: Optional[LearnedGate] = None) -> None:
        """gate: the background's, if it is learned."""
        self.model, self.optimizer, self.renderer, self.gate = model, optimizer, renderer, gate

    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare, looked: Sequence[int] = ()) -> Step:
        """Renders the views of the step that ends with this iteration, compares them, and looks at some of them."""
        raise NotImplementedError

    def look(self, views: Sequence[View]) -> Iterator[Look]:
        """Renders views beside the steps, and looks at each."""
        for view in views:
            rendering, splats = self.renderer.with_splats(view.camera)
            yield look_at(view, view.image, rendering.color, splats)


@torch.enable_grad()
def add_gradient(model: GaussianModel, name: str, number: float) -> None:
    """`Step.add_gradient` where the gradients are those of the parameters."""
    value = model.activated()[ACTIVATED.index(name)]
    value.backward(torch.full_like(value, number))


@dataclass(repr=False)  # a ViewStep's: `backward` deletes fields
class AutogradStep(ViewStep):
    """A step of `AutogradPasses`."""

    optimizer: GaussianOptimizer
    means2D: torch.Tensor  # [N, 3], whose .grad the rendering sets if radii > 0
    dL_dcolor: torch.Tensor

    def backward(self) -> None:
        self.rendering.color.backward(self.dL_dcolor)
        gradient = self.means2D.grad
        assert gradient is not None
        self.seen.append((gradient, self.rendering.radii))
        del self.means2D, self.dL_dcolor  # which hold on to memory

    def add_gradient(self, name: str, number: float) -> None:
        add_gradient(self.optimizer.model, name, number)

    def update(self) -> None:
        self.optimizer.step()


class AutogradPasses(Passes):
    """The passes as torch knows them."""

    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare, looked: Sequence[int] = ()
               ) -> AutogradStep:
        (shown,) = views
        means2D = torch.zeros_like(self.model.raw["means3D"], requires_grad=True)
        rendering, splats = self._draw(shown.view.camera, shown.background, means2D)
        target, loss, dL_dcolor = compare(shown, rendering.color.detach())
        step = AutogradStep(iteration, 1, loss, shown.view, target, rendering, self.optimizer, means2D, dL_dcolor)
        step.looks += [look_at(shown.view, target, rendering.color, splats()) for _ in looked]
        return step

    def _draw(self, camera: Camera, background: Optional[torch.Tensor], means2D: torch.Tensor
              ) -> Tuple[Rendering, Callable[[], Splats]]:
        """The image, and what it says of each Gaussian. background: in place of the renderer's."""
        gate = None
        if self.gate:
            gate = self.gate.value.clone().requires_grad_()
            gate.grad = self.gate.gradient.zero_()  # to which autograd adds; 0 if a given rasterizer leaves it out
        view = (camera, background, gate)
        if self.renderer.rasterize is package_rasterizer():
            rendering, splats = self.renderer.with_splats(*view, means2D=means2D)
            return rendering, lambda: splats
        return self.renderer(*view, means2D=means2D), lambda: self.renderer.with_splats(*view)[1]


class DirectStep(ViewStep):
    """A step of `DirectPasses`."""

    def __init__(self, iteration: int, frame: Frame, launched: Launched, parts: StepParts, numbers: Numbers,
                 drawn: Drawn) -> None:
        """numbers: as they were sent."""
        super().__init__(iteration, 1, drawn.loss, frame.shown.view, drawn.target, drawn.rendering)
        # Weak: parameters that a densification replaces are freed at once, not at the next rendering.
        self._rendered = {name: weakref.ref(tensor) for name, tensor in launched.model.stored.items()}
        self._launched, self._parts, self._numbers, self._drawn = launched, parts, numbers, drawn
        self._radii = drawn.rendering.radii
        self._stepped = self._radii  # [N] above 0 if a Gaussian has a gradient

    @torch.no_grad()
    def backward(self) -> None:
        self._gradients = self._launched.geometry_gradients()
        self._parts.differentiate(self._drawn)
        self.seen.append((self._launched.means2D_gradient(), self._radii))
        del self._drawn  # which holds on to memory

    def add_gradient(self, name: str, number: float) -> None:
        if self._stepped is self._radii:  # rows that were not seen hold anything
            for gradient in self._gradients.values():
                gradient.masked_fill_((self._radii <= 0).unsqueeze(1), 0)
            self._stepped = torch.ones_like(self._radii)
        self._gradients[name] += number

    @torch.no_grad()
    def update(self) -> None:
        launched, parts, model = self._launched, self._parts, self._launched.model
        del self._parts  # a captured step holds on to memory
        same = {name for name in PARAMETERS if model.stored[name] is self._rendered[name]()}
        geometry = same.issuperset(GEOMETRY)
        lazy = model.lazy if same.issuperset(model.color_sources().values()) else None
        numbers = self._numbers
        if geometry:
            launched.count_step()
            numbers = numbers._replace(geometry=launched.geometry_rates(0))
        elif same.intersection(GEOMETRY):
            self._step_some(same.intersection(GEOMETRY))
        if lazy:
            missed, rates = lazy.begin_step()
            numbers = numbers._replace(missed=missed, colors=rates)
        if numbers != self._numbers:  # a hook has changed learning rates, or read the model
            launched.numbers.send(numbers)
        if geometry and lazy and self._stepped is self._radii:
            parts.update(self._radii)
        else:
            if geometry:
                launched.step_geometry(self._stepped)
            if lazy:
                launched.step_colors(self._radii)
        if lazy:
            lazy.end()

    def _step_some(self, names: Set[str]) -> None:
        """If an opacity reset has replaced a parameter: the others are stepped by the dense optimizer."""
        unseen = (self._stepped <= 0).unsqueeze(1)
        gradients = {name: gradient.masked_fill(unseen, 0) for name, gradient in self._gradients.items()}
        stored = self._launched.model.stored
        raw = torch.ops.diff_smoe_rasterization.activate_backward(
            [stored[name] for name in ACTIVATED], self._launched.activations, *(gradients[name] for name in ACTIVATED))
        gradients.update(zip(ACTIVATED, raw))
        for name in names:
            stored[name].grad = gradients[name]
        self._launched.optimizer.step()


class DirectPasses(Passes):
    """The same numbers as those of `AutogradPasses`, for a GPU, where a step is bound by memory traffic and by Python.

    Spherical harmonics are stepped lazily, activations and Adam are one pass, no gradient of what was not seen is
    written, and steps that are alike are captured once.
    """

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer,
                 gate: Optional[LearnedGate] = None, loss_rule: Callable[[int], Any] = lambda iteration: iteration,
                 graphs: Optional[Graphs] = None) -> None:
        """loss_rule: `Strategy.loss_rule`. graphs: capture the steps; None: they are not."""
        super().__init__(model, optimizer, renderer, gate)
        self._launched = Launched(model, optimizer, gate)
        self._loss_rule, self._graphs = loss_rule, graphs or NoGraphs()

    @torch.no_grad()
    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare, looked: Sequence[int] = ()
               ) -> DirectStep:
        (shown,) = views
        launched, lazy = self._launched, self.optimizer.lazy_colors()
        launched.activate()
        missed = lazy.begin_catch_up()
        frame = Frame(shown, self.renderer.settings_of(shown.view.camera, shown.background))
        memory = [*self.model.stored.values(), lazy]
        parts = self._graphs.parts(launched, frame, compare, self._loss_rule(iteration), memory)
        numbers = Numbers(missed, launched.geometry_rates(1), lazy.next_rates())
        parts.send(frame, numbers)
        drawn = parts.draw(frame, compare)
        lazy.end()
        step = DirectStep(iteration, frame, launched, parts, numbers, drawn)
        step.looks += [look_at(shown.view, drawn.target, drawn.rendering.color, drawn.direct.splats()) for _ in looked]
        return step
