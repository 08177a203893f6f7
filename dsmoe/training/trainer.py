"""A training run over a loaded scene: its state, and one step after the other."""
from __future__ import annotations

from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

import torch

from diff_smoe_rasterization.images import as_float

from ..errors import TrainerError
from ..model import GaussianModel
from ..optimizer import GaussianOptimizer
from ..options.config import LEARNED, TrainConfig
from ..results.evaluation import PASSES, Evaluation, Measure, evaluate, psnr_alone
from ..results.metrics import image_metrics, psnr
from ..results.rendering import Rasterize, Renderer, background_color
from ..results.shown import raw_of
from ..scenes.images import View
from ..scenes.scene import Scene, difference_of, scene_fingerprint
from ..scenes.straight import StraightViews
from ..system.group import ALONE
from ..system.stopwatch import Stopwatch
from .gate import LearnedGate
from .graphs import CudaGraphs
from .passes import AutogradPasses, DirectPasses, Passes
from .randomness import ViewOrder, random_state, restore_random_state, seed_everything
from .room import free_bytes, gaussian_bytes
from .shards import Shards
from .state_check import check_state
from .step_parts import ViewOver
from .strategies import STRATEGIES
from .strategy import Step, StrategyContext, ViewStep, is_due


def first_model(config: TrainConfig, scene: Scene) -> GaussianModel:
    """The Gaussians that a training begins with: round ones at the scene's points, or those of a model."""
    if scene.start is None:
        return GaussianModel.from_points(scene.points, config.sh_degree, config.device)
    return GaussianModel.from_gaussians(raw_of(scene.start.gaussians, config.device), config.sh_degree)


class Trainer:
    """A training run over a loaded scene; `step` is one iteration of 3DGS, or several over a batch of views."""

    group = ALONE  # the processes that train together

    def __init__(self, config: TrainConfig, scene: Scene, rasterize: Optional[Rasterize] = None) -> None:
        """rasterize: a function with the signature of the package's `rasterize`, which is the default."""
        seed_everything(config.seed)
        self.config = config
        self.scene = scene.to(config.device)
        self.model = first_model(config, scene)
        self.optimizer = GaussianOptimizer(self.model, config, scene.extent)
        self.shards = self._make_shards()
        background = background_color(config.white_background, config.device)
        learned = config.background_gate == LEARNED
        self.gate = LearnedGate(config.gate, config.batch, config.device) if learned else None
        self.renderer = Renderer(
            self.model, str(config.blend_mode), background, config.antialiasing, rasterize,
            background_gate=self.gate.value if self.gate else float(config.background_gate),
            faint_below=config.faint_below, deterministic=config.deterministic)
        cameras = [view.camera for view in self.scene.train]
        self.straight = StraightViews(self.scene.train)
        self.renderer.prepare([*cameras, *self.straight.cameras])
        self.strategy = STRATEGIES[str(config.strategy)](StrategyContext(
            config, self.model, self.optimizer, scene.extent, self.scene.train, self.renderer,
            lambda views: self.passes.look(views), self.shards))
        self.order = ViewOrder(len(scene.train), config.seed)
        self.watch = Stopwatch(config.device)
        self.iteration = 0
        self.wants_stop: Callable[[], bool] = lambda: False  # whether this process was asked to stop
        self.passes = self._make_passes(rasterize)

    def _make_shards(self) -> Shards:
        """Which of the Gaussians this process has; may take the others from the model."""
        return Shards()

    def _make_passes(self, rasterize: Optional[Rasterize]) -> Passes:
        """How a step comes from its views to the next parameters."""
        parts = (self.model, self.optimizer, self.renderer, self.gate)
        if self.config.device == "cpu" or rasterize is not None:
            return AutogradPasses(*parts)
        return DirectPasses(*parts, loss_rule=lambda iteration: self.strategy.loss_rule(iteration),
                            graphs=CudaGraphs(self.model.stored["means3D"].device))

    @property
    def leads(self) -> bool:
        """Whether this process prints and writes."""
        return self.group.leads

    @property
    def is_divided(self) -> bool:
        """Whether several processes train together."""
        return self.group.size > 1

    def meet(self) -> None:
        """Waits for the other processes."""
        self.group.gather_numbers([0], self.config.device)

    @property
    def checkpoint_device(self) -> str:
        """The device that a checkpoint is read to."""
        return self.config.device

    @property
    def num_gaussians(self) -> int:
        """Of all processes."""
        return self.model.num_gaussians

    def room(self) -> Optional[int]:
        """About how many Gaussians fit into the GPUs of all processes, those that there are included; None on a CPU."""
        if self.config.device == "cpu":
            return None
        pixels = max(view.camera.width * view.camera.height for view in self.scene.train)
        here = free_bytes(pixels, self.straight.most_bytes)
        free = [numbers[0] for numbers in self.group.gather_numbers([here], self.config.device)]
        return self.num_gaussians + self.group.size * min(free) // gaussian_bytes(self.config)

    def whole_model(self) -> Optional[GaussianModel]:
        """In the process that leads the model with the Gaussians of all, averaged if the strategy does so."""
        return self.result().model

    def result(self) -> Renderer:
        """Renders what the run has found so far: the average of the parameters, if one is kept."""
        average = self.optimizer.average
        if not average:
            return self.renderer
        model = GaussianModel(average, self.model.sh_degree)
        model.active_sh_degree = self.model.active_sh_degree
        return self.renderer.of(model, average.get("background_gate", self.renderer.background_gate))

    def stops(self) -> bool:
        """Whether the run is to end behind this step, before its last iteration."""
        return self.wants_stop()

    def step(self, before_change: Optional[Callable[[], None]] = None) -> Step:
        """One step of `batch` iterations, in the order of 3DGS: densification, then the optimizer's step.

        before_change: called once the gradients are known and nothing has changed yet, which is where 3DGS evaluates
        and saves. So the last iteration changes nothing: what it saves neither an opacity reset nor a densification
        may have touched.
        """
        config = self.config
        self._refuse_empty()
        self.iteration += config.batch
        self.optimizer.set_position_rate(self.iteration)
        if is_due(self.iteration, config.sh_degree_interval, config.batch):
            self.model.raise_sh_degree()
        self.strategy.before_render(self.iteration)
        views = self._next_views()
        looked = self.strategy.looks_at(self.iteration, [shown.view for shown in views])
        step = self.passes.render(self.iteration, views, self._compare, looked)
        if isinstance(step, ViewStep):  # a repeated step does not call `_compare`
            self._report = (step.rendering.color.detach(), step.target, step.view)
        self.strategy.before_backward(step)
        step.backward()
        if before_change:
            before_change()
        if self.iteration < config.iterations:
            with torch.no_grad():
                self.strategy.after_backward(step)
                step.update()
                if self.gate:
                    self.gate.step()
                self.strategy.after_step(step)
        for tensors in (step.seen, step.looks):
            tensors.clear()  # of a batch they are large
        return step

    def _next_views(self) -> List[ViewOver]:
        config = self.config
        first = self.iteration - config.batch + 1
        views = [self.straight.of(self.scene.train[self.order.next()], first + index) for index in range(config.batch)]
        return [ViewOver(view, torch.rand(3, device=config.device) if config.random_background else None)
                for view in views]

    def _compare(self, shown: ViewOver, image: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What a rendering is compared with, its loss, and the gradient of that."""
        target = self.target_of(*shown)
        return (target, *self.loss_of(shown.view, target, image))

    def _refuse_empty(self) -> None:
        if self.num_gaussians == 0:
            raise TrainerError(f"iteration {self.iteration}: every Gaussian has been pruned; "
                               "try another --densify-grad-threshold or --strategy steady")

    def target_of(self, view: View, color: Optional[torch.Tensor]) -> torch.Tensor:
        """What a rendering is compared with. color: [3] the background, if it is of this step alone."""
        return view.image if color is None or view.opacity is None else view.image_over(
            color, self.renderer.background)

    def loss_of(self, view: View, target: torch.Tensor, image: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor]:
        """The loss of a rendering and its gradient."""
        self._report = (image, target, view)
        mask, padding = view.mask_float(), view.camera.padding
        if mask is None:
            return self.strategy.loss(self.iteration, image, target, padding)
        loss, gradient = self.strategy.loss(self.iteration, image * mask, as_float(target) * mask, padding)
        return loss, gradient * mask

    def training_psnr(self) -> float:
        """PSNR of the last step's rendering, the last one of this process, against its training image."""
        image, target, view = self._report
        return psnr(image.clamp(0, 1), as_float(target), view.mask_float())

    @property
    def background_gate(self) -> float:
        """The gate that the run has found so far; if it is learned, the host waits for the device."""
        return float(self.optimizer.average.get("background_gate", self.renderer.background_gate))

    def evaluate(self, progress: bool = False) -> Evaluation:
        """Renders the test views."""
        return self._evaluate(self.scene.test, progress, image_metrics, PASSES)

    def evaluate_training_views(self, progress: bool = False) -> Optional[float]:
        """Their mean PSNR. If it rises and the test views' does not, a longer training only overfits."""
        return self._evaluate(self.scene.train, progress, psnr_alone, 1).metrics["psnr"]

    def _evaluate(self, views: Sequence[View], progress: bool, measure: Measure, passes: int) -> Evaluation:
        return evaluate(self.result(), views, self.config.device, progress, measure, passes)

    def state_dict(self) -> Dict[str, Any]:
        """Everything the rest of the run depends on, as tensors and plain values."""
        return {
            "config": self.config.record(),
            "scene": scene_fingerprint(self.scene),
            "iteration": self.iteration,
            "train_seconds": self.watch.seconds,
            "raw": {name: tensor.detach() for name, tensor in self.model.raw.items()},
            "active_sh_degree": self.model.active_sh_degree,
            "optimizer": self.optimizer.state_dict(),
            "strategy": self.strategy.state_dict(),
            "gate": self.gate.state_dict() if self.gate else None,
            "average": dict(self.optimizer.average),
            "order": self.order.state_dict(),
            "random": random_state(self.config.device),
        }

    def check_state(self, state: Dict[str, Any]) -> None:
        """Raises TrainerError if a state is another run's, Misfit and others if it can be none's."""
        differences = TrainConfig.of_record(state["config"]).differences(self.config)
        if differences:
            raise TrainerError("the checkpoint is of a run with other options: " + "; ".join(differences))
        difference = difference_of(self.scene, state["scene"])
        if difference:
            raise TrainerError(f"the checkpoint is of a run on another scene: {difference} in {self.config.scene}")
        check_state(state, self.config, self.strategy.state_dict(), self.order.count)

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        """Takes what `state_dict` gave, and `check_state` found to fit."""
        self.iteration = state["iteration"]
        self.watch.seconds = state["train_seconds"]
        self.optimizer.replace_all(state["raw"])
        self.model.active_sh_degree = state["active_sh_degree"]
        self.optimizer.load_state_dict(state["optimizer"])
        self.optimizer.average = dict(state["average"])
        self.strategy.load_state_dict(state["strategy"])
        if self.gate:
            self.gate.load_state_dict(state["gate"])
        self.order.load_state_dict(state["order"])
        restore_random_state(state["random"], self.config.device)
