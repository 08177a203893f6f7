"""The passes of a step over a batch of views, with the Gaussians divided over the processes of a group."""
from __future__ import annotations

from typing import Callable, Dict, Iterator, Optional, Sequence

import torch

from diff_smoe_rasterization.direct import DirectRendering

from ..model import GaussianModel
from ..optimizer import GaussianOptimizer
from ..results.rendering import Renderer
from ..scenes.images import View
from ..system.group import Group
from ..training.background_gate import LearnedGate
from ..training.passes import Compare, DirectPasses, ViewOver
from ..training.strategy import Look, Step, look_at
from .batch import Batch, gaussians_of


class BatchPasses(DirectPasses):
    """Each view is blended in one of the processes; each process gets the gradients of its own Gaussians."""

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer,
                 gate: Optional[LearnedGate], group: Group, wants_stop: Callable[[], bool]) -> None:
        """wants_stop: whether this process was asked to stop; `asked` says whether one was, before the latest step."""
        super().__init__(model, optimizer, renderer, gate)
        self.group, self.wants_stop, self.asked = group, wants_stop, False
        self._batch: Optional[Batch] = None

    @torch.no_grad()
    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare, looked: Sequence[int] = ()) -> Step:
        settings = [self.renderer.settings_of(shown.view.camera, shown.background) for shown in views]
        lazy, gaussians = self._begin(), self._gaussians()
        self._send_numbers(self._sent)
        to_read = [DirectRendering(settings=each, **gaussians).visible_radii() for each in settings]
        lazy.launch_catch_up(torch.stack(to_read).amax(0), self._numbers[:1])
        lazy.end()
        batch = self._batch = Batch(self.group, gaussians, settings, note=int(self.wants_stop()))
        self._radii = self._stepped = batch.radii
        self.asked = any(batch.notes)
        # Losses, and gradients by the background's gate.
        numbers = torch.zeros(2, len(views), device=self.model.raw["means3D"].device)
        self._records: Dict[int, torch.Tensor] = {}
        looks: Dict[int, Look] = {}

        def blend(view: int) -> None:  # what one view has saved is gone before the next one is blended
            drawn = batch.draw(view, settings[view])
            target, loss, gradient = compare(views[view], drawn.color)
            if view in looked:
                looks[view] = look_at(views[view].view, target, drawn.color, drawn.splats())
            self._records[view], dL_dgate = drawn.backward(gradient, self.gate is not None)
            numbers[0, view] = loss
            if self.gate:
                numbers[1, view] = dL_dgate[0]

        for view in batch.own_views:
            blend(view)
        self.group.add_up(numbers)
        losses, self._dL_dgates = numbers
        step = Step(iteration, len(views), losses.mean(), self._add_gradient)
        if looked:
            step.looks += batch.looks(looks, looked)
        return step

    @torch.no_grad()
    def look(self, views: Sequence[View]) -> Iterator[Look]:
        for first in range(0, len(views), self.group.size):
            some = views[first:first + self.group.size]
            settings = [self.renderer.settings_of(view.camera) for view in some]
            batch = Batch(self.group, gaussians_of(self.model), settings)
            looks: Dict[int, Look] = {}
            for index in batch.own_views:
                drawn = batch.draw(index, settings[index], for_backward=False)
                looks[index] = look_at(some[index], some[index].image, drawn.color, drawn.splats())
            yield from batch.looks(looks, range(len(some)))

    @torch.no_grad()
    def backward(self, step: Step) -> None:
        batch, self._batch = self._batch, None  # it holds on to memory
        assert batch is not None, "render comes first"
        means2D = batch.backward(batch.give_back(self._records), self._buffers_of_gradients())
        step.seen += [(gradients, projected.radii) for gradients, projected in zip(means2D, batch.projected)]
        if self.gate:
            self.gate.gradient.copy_(sum(self._dL_dgates.unbind(), torch.zeros_like(step.loss)))
