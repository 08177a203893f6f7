"""The passes of a step over a batch of views, with the Gaussians divided over the processes of a group."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Dict, Iterator, Optional, Sequence

import torch

from ..model import GaussianModel
from ..optimizer import GaussianOptimizer
from ..results.rendering import Renderer
from ..scenes.images import View
from ..system.group import Group
from ..training.gate import LearnedGate
from ..training.passes import Passes, add_gradient
from ..training.step_parts import Compare, ViewOver
from ..training.strategy import Look, Step
from .batch import Batch


@dataclass(repr=False)
class BatchStep(Step):
    """A step of `BatchPasses`."""

    parts: Batch
    optimizer: GaussianOptimizer
    gate: Optional[LearnedGate]
    dL_dgates: torch.Tensor  # [views] by the background's gate

    @torch.no_grad()
    def backward(self) -> None:
        self.seen += zip(self.parts.backward(), self.parts.radii)
        del self.parts  # which holds on to memory
        if self.gate:
            self.gate.gradient.copy_(sum(self.dL_dgates.unbind(), torch.zeros_like(self.loss)))

    def add_gradient(self, name: str, number: float) -> None:
        add_gradient(self.optimizer.model, name, number)

    def update(self) -> None:
        self.optimizer.step()
        for tensor in self.optimizer.model.stored.values():  # the next gradients are not there beside these
            tensor.grad = None


class BatchPasses(Passes):
    """Each view is blended in one of the processes; each process gets the gradients of its own Gaussians."""

    def __init__(self, model: GaussianModel, optimizer: GaussianOptimizer, renderer: Renderer,
                 gate: Optional[LearnedGate], group: Group, wants_stop: Callable[[], bool]) -> None:
        """wants_stop: whether this process was asked to stop; `asked` says whether one was, before the latest step."""
        super().__init__(model, optimizer, renderer, gate)
        self.group, self.wants_stop, self.asked = group, wants_stop, False

    @torch.no_grad()
    def render(self, iteration: int, views: Sequence[ViewOver], compare: Compare, looked: Sequence[int] = ()) -> Step:
        settings = [self.renderer.settings_of(shown.view.camera, shown.background) for shown in views]
        batch = Batch(self.group, self.model, settings, note=int(self.wants_stop()))
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
                looks[view] = image.look(views[view].view, target)
            records, dL_dgate = image.backward(gradient, self.gate is not None)
            numbers[0, view] = loss
            if self.gate:
                numbers[1, view] = dL_dgate[0]
            return records

        for index in range(len(batch.rounds)):
            batch.send_back(index, blend(index))
        self.group.add_up(numbers)
        losses, dL_dgates = numbers
        step = BatchStep(iteration, len(views), losses.mean(), batch, self.optimizer, self.gate, dL_dgates)
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
                looks[view] = image.look(some[view], some[view].image)
            yield from batch.looks(looks, range(len(some)))
