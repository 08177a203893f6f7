"""How a step comes from a view to gradients and to the next parameters: by autograd, or directly.

Both give the same numbers. `DirectPasses` is for a GPU, where a step is bound by memory traffic and by Python: it steps
spherical harmonics lazily, makes one pass of activations and Adam, and writes no gradient of what was not seen.
`AutogradPasses` takes any rasterizer.
"""
from __future__ import annotations

import math
import weakref
from typing import Callable, Dict, List, Optional, Set, Tuple

import torch

from diff_smoe_rasterization.direct import DirectRendering
from diff_smoe_rasterization.extension import _C  # noqa: F401  (loading it registers the ops)
from diff_smoe_rasterization.gaussians import activate
from diff_smoe_rasterization.settings import GATED_MODES, Rendering
from diff_smoe_rasterization.splats import Splats

from ..model import PARAMETERS, GaussianModel, GaussianOptimizer
from ..results.rendering import Renderer, package_rasterizer
from ..scenes.cameras import Camera

_OPS = torch.ops.diff_smoe_rasterization
ACTIVATED = ("opacities", "scales", "rotations")
GEOMETRY = ("means3D", *ACTIVATED)  # what the projection reads of every Gaussian


class AutogradPasses:
    """The passes of one step after the other, as torch knows them."""

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer) -> None:
        self.model, self.optimizer, self.renderer = model, optimizer, renderer
        self._splats: Optional[Callable[[], Splats]] = None

    def render(self, camera: Camera, background: Optional[torch.Tensor],
               background_gate: Optional[torch.Tensor]) -> Tuple[Rendering, torch.Tensor]:
        """The image, and a tensor [N, 3] whose .grad `backward` sets: what densification reads.

        background, background_gate: in place of the renderer's; the latter gets its gradient.
        """
        means2D = torch.zeros_like(self.model.raw["means3D"], requires_grad=True)
        view = (camera, background, background_gate)
        if self.renderer.rasterize is package_rasterizer():
            rendering, splats = self.renderer.with_splats(*view, means2D=means2D)
            self._splats = lambda: splats
        else:
            rendering = self.renderer(*view, means2D=means2D)
            self._splats = lambda: self.renderer.with_splats(*view)[1]
        self._color = rendering.color
        return rendering, means2D

    def splats(self) -> Splats:
        """What the image of `render` says of each Gaussian."""
        assert self._splats is not None, "render comes first"
        return self._splats()

    def backward(self, dL_dcolor: torch.Tensor) -> None:
        """From the gradient by the image [3, H, W] to those by all parameters."""
        self._splats = None  # which holds on to memory
        self._color.backward(dL_dcolor)

    @torch.enable_grad()
    def add_gradient(self, name: str, number: float) -> None:
        """Adds a number to the gradient by every opacity, scale or rotation (the parameter's name); after backward."""
        value = self.model.activated()[ACTIVATED.index(name)]
        value.backward(torch.full_like(value, number))

    def update(self) -> None:
        """Steps what has not been replaced since `render`."""
        self.optimizer.step()


class DirectPasses:
    """The same numbers in fewer passes over memory."""

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer) -> None:
        self.model, self.optimizer, self.renderer = model, optimizer, renderer
        self._values: List[torch.Tensor] = []  # what `activate` makes of the parameters
        self._made_of: List[Tuple[torch.Tensor, int]] = []  # these, and their versions at that time
        self._buffers: Dict[str, torch.Tensor] = {}  # gradients

    def render(self, camera: Camera, background: Optional[torch.Tensor],
               background_gate: Optional[torch.Tensor]) -> Tuple[Rendering, torch.Tensor]:
        """As of AutogradPasses, but that .grad has rows only of Gaussians with radii above 0."""
        model = self.model
        lazy = self.optimizer.lazy_colors()
        parameters = model.stored
        # Weak, so that of what a densification replaces only 64 bytes of geometry stay till the next rendering.
        self._rendered = {name: weakref.ref(tensor) for name, tensor in parameters.items()}
        self._gate = background_gate if self.renderer.blend_mode in GATED_MODES else None
        gate = None if self._gate is None else self._gate.detach()
        settings = self.renderer.settings_of(camera, background, gate)
        self._means2D = self._buffer("means2D", parameters["means3D"]).requires_grad_()
        self._means2D.grad = None
        self._activate()
        colors = {argument: parameters[name] for argument, name in model.color_sources().items()}
        self._direct: Optional[DirectRendering] = DirectRendering(
            parameters["means3D"], self._values[0], settings, means2D=self._means2D, scales=self._values[1],
            rotations=self._values[2], **colors)
        lazy.catch_up(self._direct.visible_radii())
        rendering = self._direct.render()
        self._radii = self._stepped = rendering.radii
        return rendering, self._means2D

    def splats(self) -> Splats:
        """What the image of `render` says of each Gaussian."""
        assert self._direct is not None, "render comes first"
        return self._direct.splats()

    @torch.no_grad()
    def backward(self, dL_dcolor: torch.Tensor) -> None:
        parameters, lazy = self.model.stored, self.model.lazy
        assert self._direct is not None and lazy is not None, "render comes first"
        self._gradients = {name: self._buffer("d" + name, parameters[name]) for name in GEOMETRY}
        gradients = {**self._gradients, **dict(zip(self.model.color_sources(), lazy.gradients)),
                     "means2D": self._buffer("dmeans2D", parameters["means3D"])}
        if self._gate is not None:
            gradients["background_gate"] = torch.empty_like(self._gate)
        self._direct.backward({"color": dL_dcolor}, gradients)
        self._direct = None  # which holds on to memory
        self._means2D.grad = gradients["means2D"]
        if self._gate is not None:
            with torch.enable_grad():
                self._gate.backward(gradients["background_gate"])

    def add_gradient(self, name: str, number: float) -> None:
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
        states, rates, root_scales = [], [], []
        for name, tensor in zip(GEOMETRY, raw):
            state, group = self.optimizer.adam.state[tensor], self.optimizer.group(name)
            if not state:
                state.update(step=0, exp_avg=torch.zeros_like(tensor), exp_avg_sq=torch.zeros_like(tensor))
            beta1, beta2 = group["betas"]
            age = state["step"] = int(state["step"]) + 1
            rates.append(group["lr"] / (1 - beta1**age))
            root_scales.append(1 / math.sqrt(1 - beta2**age))
            states.append(state)
        _OPS.gaussian_adam(raw, self._values, [self._gradients[name] for name in GEOMETRY],
                           [state["exp_avg"] for state in states], [state["exp_avg_sq"] for state in states],
                           self._stepped, rates, root_scales, beta1, beta2, group["eps"])
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
