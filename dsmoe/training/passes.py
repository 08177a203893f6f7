"""How a step comes from its views to gradients and to the next parameters, in three kinds with the same numbers.

`AutogradPasses` takes any rasterizer. `DirectPasses` is for a GPU, where a step is bound by memory traffic and by
Python: it steps spherical harmonics lazily, makes one pass of activations and Adam, and writes no gradient of what was
not seen. `BatchPasses`, in distributed/passes.py, take several views and several processes.
"""
from __future__ import annotations

import weakref
from typing import Callable, Dict, List, NamedTuple, Optional, Sequence, Set, Tuple

import torch

from diff_smoe_rasterization.direct import DirectRendering
from diff_smoe_rasterization.extension import BACKENDS  # noqa: F401  (loading it registers the ops)
from diff_smoe_rasterization.gaussians import activate
from diff_smoe_rasterization.optimizers import corrected_rates
from diff_smoe_rasterization.settings import Rendering
from diff_smoe_rasterization.splats import Splats

from ..model import PARAMETERS, GaussianModel
from ..optimizer import GaussianOptimizer
from ..results.rendering import Renderer, package_rasterizer
from ..scenes.cameras import Camera
from ..scenes.images import View
from .background_gate import LearnedGate
from .strategy import Step, ViewStep

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
        """gate: the background's, where it is learned."""
        self.model, self.optimizer, self.renderer, self.gate = model, optimizer, renderer, gate

    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare) -> Step:
        """Renders the views of the step that ends with this iteration, and compares them."""
        raise NotImplementedError

    def backward(self, step: Step) -> None:
        """From the gradients by the images to those by all parameters and the gate; sets `seen` of the step."""
        raise NotImplementedError

    def update(self) -> None:
        """Steps the parameters that have not been replaced since `render`."""
        raise NotImplementedError


class _OneView(Passes):
    """What the two kinds for one view share."""

    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare) -> ViewStep:
        (shown,) = views
        rendering, self._means2D = self._draw(shown.view.camera, shown.background)
        target, loss, self._dL_dcolor = compare(shown, rendering.color.detach())
        return ViewStep(iteration, 1, loss, shown.view, target, rendering, self._splats, self._add_gradient)

    def backward(self, step: Step) -> None:
        assert isinstance(step, ViewStep)
        self._differentiate(self._dL_dcolor)
        gradient = self._means2D.grad
        assert gradient is not None
        step.seen.append((gradient, step.rendering.radii))
        del self._means2D, self._dL_dcolor  # they hold on to memory

    def _draw(self, camera: Camera, background: Optional[torch.Tensor]) -> Tuple[Rendering, torch.Tensor]:
        """The image, and a tensor [N, 3] whose .grad `_differentiate` sets where radii > 0.

        background: in place of the renderer's.
        """
        raise NotImplementedError

    def _splats(self) -> Splats:
        """What the image of `_draw` says of each Gaussian."""
        raise NotImplementedError

    def _differentiate(self, dL_dcolor: torch.Tensor) -> None:
        """From the gradient by the image [3, H, W] to those by all parameters and the gate."""
        raise NotImplementedError

    def _add_gradient(self, name: str, number: float) -> None:
        """Adds a number to the gradient by every opacity, scale or rotation (the parameter's name); after backward."""
        raise NotImplementedError


class AutogradPasses(_OneView):
    """The passes as torch knows them."""

    _seen: Optional[Callable[[], Splats]] = None

    def _draw(self, camera: Camera, background: Optional[torch.Tensor]) -> Tuple[Rendering, torch.Tensor]:
        means2D = torch.zeros_like(self.model.raw["means3D"], requires_grad=True)
        gate = None
        if self.gate:
            gate = self.gate.value.clone().requires_grad_()
            gate.grad = self.gate.gradient.zero_()  # to which autograd adds; 0 where a given rasterizer leaves it out
        view = (camera, background, gate)
        if self.renderer.rasterize is package_rasterizer():
            rendering, splats = self.renderer.with_splats(*view, means2D=means2D)
            self._seen = lambda: splats
        else:
            rendering = self.renderer(*view, means2D=means2D)
            self._seen = lambda: self.renderer.with_splats(*view)[1]
        self._color = rendering.color
        return rendering, means2D

    def _splats(self) -> Splats:
        assert self._seen is not None, "render comes first"
        return self._seen()

    def _differentiate(self, dL_dcolor: torch.Tensor) -> None:
        self._seen = None  # which holds on to memory
        self._color.backward(dL_dcolor)

    @torch.enable_grad()
    def _add_gradient(self, name: str, number: float) -> None:
        value = self.model.activated()[ACTIVATED.index(name)]
        value.backward(torch.full_like(value, number))

    def update(self) -> None:
        self.optimizer.step()


class DirectPasses(_OneView):
    """The same numbers in fewer passes over memory."""

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer,
                 gate: Optional[LearnedGate] = None) -> None:
        super().__init__(model, optimizer, renderer, gate)
        self._values: List[torch.Tensor] = []  # what `activate` makes of the parameters
        self._made_of: List[Tuple[torch.Tensor, int]] = []  # these, and their versions at that time
        self._buffers: Dict[str, torch.Tensor] = {}  # gradients

    def _draw(self, camera: Camera, background: Optional[torch.Tensor]) -> Tuple[Rendering, torch.Tensor]:
        model = self.model
        lazy = self.optimizer.lazy_colors()
        parameters = model.stored
        # Weak, so that of what a densification replaces only 64 bytes of geometry stay till the next rendering.
        self._rendered = {name: weakref.ref(tensor) for name, tensor in parameters.items()}
        settings = self.renderer.settings_of(camera, background)
        means2D = self._buffer("means2D", parameters["means3D"]).requires_grad_()
        means2D.grad = None
        self._activate()
        colors = {argument: parameters[name] for argument, name in model.color_sources().items()}
        self._direct: Optional[DirectRendering] = DirectRendering(
            parameters["means3D"], self._values[0], settings, means2D=means2D, scales=self._values[1],
            rotations=self._values[2], **colors)
        lazy.catch_up(self._direct.visible_radii())
        rendering = self._direct.render()
        self._radii = self._stepped = rendering.radii
        return rendering, means2D

    def _splats(self) -> Splats:
        assert self._direct is not None, "render comes first"
        return self._direct.splats()

    @torch.no_grad()
    def _differentiate(self, dL_dcolor: torch.Tensor) -> None:
        parameters, lazy = self.model.stored, self.model.lazy
        assert self._direct is not None and lazy is not None, "render comes first"
        self._gradients = {name: self._buffer("d" + name, parameters[name]) for name in GEOMETRY}
        gradients = {**self._gradients, **dict(zip(self.model.color_sources(), lazy.gradients)),
                     "means2D": self._buffer("dmeans2D", parameters["means3D"])}
        if self.gate:
            gradients["background_gate"] = self.gate.gradient
        self._direct.backward({"color": dL_dcolor}, gradients)
        self._direct = None  # which holds on to memory
        self._means2D.grad = gradients["means2D"]

    def _add_gradient(self, name: str, number: float) -> None:
        if self._stepped is self._radii:  # rows that were not seen hold anything
            for gradient in self._gradients.values():
                gradient.masked_fill_((self._radii <= 0).unsqueeze(1), 0)
            self._stepped = torch.ones_like(self._radii)
        self._gradients[name] += number

    @torch.no_grad()
    def update(self) -> None:
        stored, lazy = self.model.stored, self.model.lazy
        same = {name for name in PARAMETERS if stored[name] is self._rendered[name]()}
        if same.issuperset(GEOMETRY):
            self._step_geometry()
        elif same.intersection(GEOMETRY):
            self._step_some(same)
        if lazy is not None and same.issuperset(self.model.color_sources().values()):
            lazy.step(self._radii)

    def _step_geometry(self) -> None:
        raw = [self.model.stored[name] for name in GEOMETRY]
        states, rates = [], []
        for name, tensor in zip(GEOMETRY, raw):
            state, group = self.optimizer.adam.state[tensor], self.optimizer.group(name)
            if not state:
                state.update(step=0, exp_avg=torch.zeros_like(tensor), exp_avg_sq=torch.zeros_like(tensor))
            state["step"] = int(state["step"]) + 1
            rates.append(corrected_rates(group, state["step"]))
            states.append(state)
        _OPS.gaussian_adam(raw, self._values, [self._gradients[name] for name in GEOMETRY],
                           [state["exp_avg"] for state in states], [state["exp_avg_sq"] for state in states],
                           self._stepped, *map(list, zip(*rates)), *group["betas"], group["eps"])
        self._made_of = [(tensor, tensor._version) for tensor in raw[1:]]

    def _step_some(self, same: Set[str]) -> None:
        """Where an opacity reset has replaced a parameter: the others are stepped by the dense optimizer."""
        unseen = (self._stepped <= 0).unsqueeze(1)
        gradients = {name: gradient.masked_fill(unseen, 0) for name, gradient in self._gradients.items()}
        raw = _OPS.activate_backward([self.model.stored[name] for name in ACTIVATED], self._values,
                                     *(gradients[name] for name in ACTIVATED))
        gradients.update(zip(ACTIVATED, raw))
        for name in same.intersection(GEOMETRY):
            self.model.stored[name].grad = gradients[name]
        self.optimizer.step()

    def _activate(self) -> None:
        """Makes the values anew where something else than `update` has changed what they are made of."""
        raw = [self.model.stored[name] for name in ACTIVATED]
        if len(self._made_of) != len(raw) or any(tensor is not made_of or tensor._version != version
                                                 for tensor, (made_of, version) in zip(raw, self._made_of)):
            with torch.no_grad():
                self._values = list(activate(*raw))
            self._made_of = [(tensor, tensor._version) for tensor in raw]

    def _buffer(self, name: str, like: torch.Tensor) -> torch.Tensor:
        """Memory of a gradient, the same in every step as long as its shape is."""
        buffer = self._buffers.get(name)
        if buffer is None or buffer.shape != like.shape:
            buffer = self._buffers[name] = torch.empty_like(like, requires_grad=False)
        return buffer
