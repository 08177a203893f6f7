"""Training on batches of views, in one process or with the Gaussians divided over several; the choice of a trainer."""
from __future__ import annotations

from typing import Any, Callable, Dict, Optional, Sequence

import torch

from ..errors import TrainerError
from ..model import PARAMETERS, GaussianModel
from ..options.config import TrainConfig
from ..results.evaluation import Evaluation, Measure, rows_of_views, summary
from ..results.rendering import Rasterize
from ..scenes.images import View
from ..scenes.scene import Scene
from ..system.group import ALONE, Group
from ..training.trainer import Trainer
from .batch import Batch
from .passes import BatchPasses
from .shards import DividedShards


class BatchTrainer(Trainer):
    """A training run whose steps have several views; each process of the group has a part of the Gaussians."""

    def __init__(self, config: TrainConfig, scene: Scene, group: Group) -> None:
        self.group = group
        super().__init__(config, scene)

    def _make_shards(self) -> DividedShards:
        self.divided = DividedShards(self.group, self.model, self.optimizer)
        return self.divided

    def _make_passes(self, rasterize: Optional[Rasterize]) -> BatchPasses:
        self.batches = BatchPasses(self.model, self.optimizer, self.renderer, self.gate, self.group,
                                   lambda: self.wants_stop())
        return self.batches

    @property
    def checkpoint_device(self) -> str:
        return "cpu"  # each process then takes its own part

    @property
    def num_gaussians(self) -> int:
        return self.divided.num_gaussians

    def stops(self) -> bool:
        """Whether a process was asked to stop before the latest step, which all learn in that step."""
        return self.batches.asked

    def _evaluate(self, views: Sequence[View], progress: bool, measure: Measure, passes: int) -> Evaluation:
        """Each view in one process; a view's time is the total divided by the number of views."""
        group, device, shown = self.group, self.config.device, self.result()

        def render(some: Sequence[View]) -> Dict[int, torch.Tensor]:
            settings = [shown.settings_of(view.camera) for view in some]
            drawn = Batch(group, shown.model, settings).draw(0, for_backward=False)
            return {drawn[0]: drawn[1].color} if drawn else {}

        def longest(seconds: float) -> float:  # all processes decide alike
            return max(group.gather_numbers([round(1000 * seconds)], device))[0] / 1000

        batches = [views[begin:begin + group.size] for begin in range(0, len(views), group.size)]
        by_process = group.gather_objects(rows_of_views(render, batches, device, progress, measure, passes, longest))
        return summary([by_process[index % group.size][index // group.size]  # type: ignore[index]
                        for index in range(len(views))])

    def whole_model(self) -> Optional[GaussianModel]:
        """What `Trainer.whole_model` gives, in the first process's host memory; None elsewhere."""
        raw = {name: self.divided.whole(tensor) for name, tensor in self.result().model.raw.items()}
        return GaussianModel(raw, self.model.sh_degree) if self.leads else None

    def state_dict(self) -> Dict[str, Any]:
        """What `Trainer.state_dict` gives, with all Gaussians, in the first process; the others' is of no use."""
        state = super().state_dict()
        for name in ("raw", "optimizer", "strategy"):
            state[name] = _map_tensors(state[name], self.divided.whole)
        state["average"] = {name: self.divided.whole(tensor) if name in PARAMETERS else tensor
                            for name, tensor in state["average"].items()}
        return state  # with the generators of one process, as all draw the same numbers

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        """Takes what `state_dict` gave, in whatever number of processes, on the host."""
        whole = len(state["raw"]["means3D"])
        self.divided.divide(whole)
        own = {name: _map_tensors(state[name], self.divided.own_rows) for name in ("raw", "optimizer", "strategy")}
        own["average"] = {name: self.divided.own_rows(tensor) if name in PARAMETERS else tensor.to(self.config.device)
                          for name, tensor in state["average"].items()}
        super().load_state_dict({**state, **own})


def new_trainer(config: TrainConfig, scene: Scene, rasterize: Optional[Rasterize] = None,
                group: Optional[Group] = None) -> Trainer:
    """The trainer of a run: the usual one for one view a step in one process, but of panoramas. Raises TrainerError.

    Only batches draw a panorama without a seam.
    """
    around = rasterize is None and any(view.camera.is_panorama for view in scene.train)
    if config.batch == 1 and (group is None or group.size == 1) and not around:
        return Trainer(config, scene, rasterize)
    if rasterize is not None:
        raise TrainerError("train: rasterize is given; batches of views and several processes need the package's own")
    return BatchTrainer(config, scene, group or ALONE)


def _map_tensors(value: Any, function: Callable[[torch.Tensor], Any]) -> Any:
    if isinstance(value, torch.Tensor):
        return function(value)
    return {key: _map_tensors(item, function) for key, item in value.items()} if isinstance(value, dict) else value
