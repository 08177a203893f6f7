"""Training on batches of views, on one process or with the Gaussians divided over several."""
from __future__ import annotations

from typing import Any, Callable, Dict, List, Optional, Sequence

import torch

from ..config import BATCHED, TrainConfig
from ..errors import ConfigError
from ..model import GaussianModel
from ..results.evaluation import Evaluation, rows_of_views, summary
from ..scenes.images import View
from ..scenes.scene import Scene
from ..system.group import Group
from ..training.loop import Trainer
from ..training.strategy import BatchStep
from .batch import Batch
from .shards import DividedShards


class BatchTrainer(Trainer):
    """A training run whose steps have several views; each process of the group has a part of the Gaussians."""

    def __init__(self, config: TrainConfig, scene: Scene, group: Group) -> None:
        if config.schedule not in BATCHED:
            raise ConfigError(f"--strategy is {config.schedule}; on several GPUs it must be {' or '.join(BATCHED)}")
        self.group = group
        self._asked = False
        super().__init__(config, scene)

    def _make_shards(self) -> DividedShards:
        self.divided = DividedShards(self.group, self.model, self.optimizer)
        return self.divided

    @property
    def checkpoint_device(self) -> str:
        return "cpu"  # each process then takes its own part

    @property
    def num_gaussians(self) -> int:
        return self.divided.num_gaussians

    def step(self, before_change: Optional[Callable[[], None]] = None) -> BatchStep:  # type: ignore[override]
        """One step over a batch of views, in the order that `Trainer.step` has."""
        config = self.config
        self._refuse_empty()
        self.iteration += config.batch
        step = BatchStep(self.iteration, config.batch, torch.zeros(()))
        self.optimizer.set_position_rate(self.iteration)
        if step.due(config.sh_degree_interval):
            self.model.raise_sh_degree()
        views = [self.scene.train[self.order.next()] for _ in range(config.batch)]
        with torch.no_grad():
            self._render(step, views)
        if before_change:
            before_change()
        if self.iteration < config.iterations:
            with torch.no_grad():
                self.strategy.after_backward(step)
                self.optimizer.step()
                if self.gate:
                    self.gate.step()
                self.strategy.after_step(step)
        return step

    def _render(self, step: BatchStep, views: List[View]) -> None:
        """From the views to the gradients of the parameters, the loss, and what the views saw."""
        config, device = self.config, self.model.raw["means3D"].device
        colors = [torch.rand(3, device=device) if config.random_background else None for _ in views]
        settings = [self.renderer.settings_of(view.camera) for view in views]
        settings = [each if color is None else each._replace(bg=color) for each, color in zip(settings, colors)]
        batch = Batch(self.group, self.model, settings, note=int(self.wants_stop()))
        self._asked = any(batch.notes)
        numbers = torch.zeros(2, len(views), device=device)  # losses, and gradients by the background's gate
        records: Dict[int, torch.Tensor] = {}

        def blend(view: int) -> None:  # what one view has saved is gone before the next one is blended
            drawn = batch.draw(view, settings[view])
            loss, gradient = self.loss_of(views[view], self.target_of(views[view], colors[view]), drawn.color)
            records[view], dL_dgate = drawn.backward(gradient, self.gate is not None)
            numbers[0, view] = loss
            if self.gate:
                numbers[1, view] = dL_dgate[0]

        for view in batch.own_views:
            blend(view)
        self.group.add_up(numbers)
        step.loss = numbers[0].mean()
        self.strategy.before_backward(step)
        means2D = batch.backward(batch.give_back(records))
        step.views = [(gradients, projected.radii) for gradients, projected in zip(means2D, batch.projected)]
        if self.gate:
            self.gate.take_gradient(sum(numbers[1].unbind(), torch.zeros((), device=device)))

    def stops(self) -> bool:
        """Whether a process was asked to stop before the latest step, which all learn in that step."""
        return self._asked

    def evaluate(self, progress: bool = False) -> Evaluation:
        """Renders the test views, each in one of the processes; a time of a view is that of all by their number."""
        group, device, views = self.group, self.config.device, self.scene.test

        def render(some: Sequence[View]) -> Dict[int, torch.Tensor]:
            settings = [self.renderer.settings_of(view.camera) for view in some]
            batch = Batch(group, self.model, settings)
            return {view: batch.draw(view, settings[view], for_backward=False).color for view in batch.own_views}

        def longest(seconds: float) -> float:  # all processes decide alike
            return max(group.gather_numbers([round(1000 * seconds)], device))[0] / 1000

        batches = [views[begin:begin + group.size] for begin in range(0, len(views), group.size)]
        by_process = group.gather_objects(rows_of_views(render, batches, device, progress, agreed=longest))
        return summary([by_process[index % group.size][index // group.size]  # type: ignore[index]
                        for index in range(len(views))])

    def whole_model(self) -> Optional[GaussianModel]:
        """The model with all Gaussians in the first process's host memory; None elsewhere."""
        raw = {name: self.divided.whole(tensor) for name, tensor in self.model.raw.items()}
        return GaussianModel(raw, self.model.sh_degree) if self.leads else None

    def state_dict(self) -> Dict[str, Any]:
        """What `Trainer.state_dict` gives, with all Gaussians, in the first process; the others' is of no use."""
        state = super().state_dict()
        for name in ("raw", "optimizer", "strategy"):
            state[name] = _map_tensors(state[name], self.divided.whole)
        if state["random"]["cuda"]:
            state["random"]["cuda"] = [torch.cuda.get_rng_state()]  # all processes draw the same numbers
        return state

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        """Takes what `state_dict` gave, in whatever number of processes, on the host."""
        whole = len(state["raw"]["means3D"])
        self.divided.divide(whole)
        own = {name: _map_tensors(state[name], self.divided.own_rows) for name in ("raw", "optimizer", "strategy")}
        generators = state["random"]["cuda"]
        super().load_state_dict({**state, **own, "random": {**state["random"], "cuda": []}})
        if generators and torch.cuda.is_available():
            torch.cuda.set_rng_state(generators[0].cpu())


def _map_tensors(value: Any, function: Callable[[torch.Tensor], Any]) -> Any:
    if isinstance(value, torch.Tensor):
        return function(value)
    return {key: _map_tensors(item, function) for key, item in value.items()} if isinstance(value, dict) else value
