"""The passes of a step over a batch of views, with the Gaussians divided over the processes of a group."""
from __future__ import annotations

from typing import Callable, Dict, Iterator, Optional, Sequence

import torch

from ..model import GaussianModel
from ..optimizer import GaussianOptimizer
from ..results.rendering import Renderer
from ..scenes.images import View
from ..system.group import Group
from ..training.gate import LearnedGate
from ..training.passes import Compare, Passes, ViewOver
from ..training.strategy import Look, Step, look_at
from .batch import Batch


class BatchPasses(Passes):
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
        batch = self._batch = Batch(self.group, self.model, settings, note=int(self.wants_stop()))
        self.asked = any(batch.notes)
        # Losses, and gradients by the background's gate.
        numbers = torch.zeros(2, len(views), device=self.model.raw["means3D"].device)
        looks: Dict[int, Look] = {}

        def blend(index: int) -> Optional[torch.Tensor]:  # what a view has saved is gone before the next one is blended
            drawn = batch.draw(index)
            if drawn is None:
                return None
            view, image = drawn
            target, loss, gradient = compare(views[view], image.color)
            if view in looked:
                looks[view] = look_at(views[view].view, target, image.color, image.splats())
            records, dL_dgate = image.backward(gradient, self.gate is not None)
            numbers[0, view] = loss
            if self.gate:
                numbers[1, view] = dL_dgate[0]
            return records

        for index in range(len(batch.rounds)):
            batch.send_back(index, blend(index))
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
            batch = Batch(self.group, self.model, settings)
            looks: Dict[int, Look] = {}
            drawn = batch.draw(0, for_backward=False)
            if drawn:
                view, image = drawn
                looks[view] = look_at(some[view], some[view].image, image.color, image.splats())
            yield from batch.looks(looks, range(len(some)))

    @torch.no_grad()
    def backward(self, step: Step) -> None:
        batch, self._batch = self._batch, None  # it holds on to memory
        assert batch is not None, "render comes first"
        step.seen += zip(batch.backward(), batch.radii)
        if self.gate:
            self.gate.gradient.copy_(sum(self._dL_dgates.unbind(), torch.zeros_like(step.loss)))

    def update(self) -> None:
        self.optimizer.step()
        for tensor in self.model.stored.values():  # the next gradients are not there beside these
            tensor.grad = None
