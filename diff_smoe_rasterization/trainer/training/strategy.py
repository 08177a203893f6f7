"""Where Gaussians are added and removed: one small interface, and the recipe of 3DGS behind it.

A new strategy is one class with the hooks below and one line in strategies.py. What it may need of the run, extra
renderings of training views included, is in StrategyContext.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Dict, Optional, Sequence, Tuple

import torch

from ...gaussians import add_view
from ...settings import Rendering
from ..config import TrainConfig
from ..model import GaussianModel, GaussianOptimizer, inverse_sigmoid, quaternion_to_matrix
from ..results.rendering import Renderer
from ..scenes.cameras import Camera
from ..scenes.images import View

MIN_OPACITY = 0.005  # fainter Gaussians are pruned
RESET_OPACITY = 0.01  # an opacity reset leaves no Gaussian above this
MAX_SCALE = 0.1  # of the scene extent; larger Gaussians are pruned after the first reset
CHILDREN = 2  # a split makes so many
SPLIT_SHRINK = 0.8 * CHILDREN  # a child's scale is its parent's divided by this


@dataclass
class StrategyContext:
    """What a strategy works on, for the whole run."""

    config: TrainConfig
    model: GaussianModel
    optimizer: GaussianOptimizer
    extent: float  # scene extent, world units
    views: Sequence[View]  # for training
    render: Renderer  # for passes of the strategy's own


@dataclass
class Step:
    """One training step, as far as it has come when a hook is called."""

    iteration: int  # counts from 1
    camera: Camera
    rendering: Rendering
    means2D: torch.Tensor  # [N, 3]; after backward its .grad holds dL/dpixel times (0.5 W, 0.5 H) where radii > 0
    loss: torch.Tensor


class Strategy:
    """Does nothing: a fixed set of Gaussians. The base of every strategy.

    Hooks run in this order in each step; rows may be added or removed in the last two (through the optimizer), which
    the last iteration of a run leaves out.
    """

    uses_gradients = False  # whether after_backward reads or changes the .grad of parameters, which else have none

    def __init__(self, context: StrategyContext) -> None:
        """May change the first Gaussians; a resumed run replaces them and loads the state."""
        self.context = context

    def before_backward(self, step: Step) -> None:
        """The loss is known, its gradients are not."""

    def after_backward(self, step: Step) -> None:
        """Gradients are known, the optimizer has not stepped. A parameter replaced here is not stepped."""

    def after_step(self, step: Step) -> None:
        """The optimizer has stepped."""

    def state_dict(self) -> Dict[str, Any]:
        """Tensors and plain values that a checkpoint must hold."""
        return {}

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        """Takes what `state_dict` gave."""


class ThreeDGSStrategy(Strategy):
    """Adaptive density control of 3D Gaussian Splatting (Kerbl et al. 2023, section 5.2), as its release runs it.

    Its 20-pixel screen-size prune is absent here because it never fires there: the radii it looks at are zeroed by
    the densification just before. What prunes is opacity and, after the first opacity reset, world scale.
    """

    resets_opacity = True
    prunes_large = True

    def __init__(self, context: StrategyContext) -> None:
        super().__init__(context)
        self._forget_statistics()

    def after_backward(self, step: Step) -> None:
        config = self.context.config
        if step.iteration >= self.densify_until:
            return
        self._observe(step)
        if step.iteration > config.densify_from_iter and step.iteration % config.densification_interval == 0:
            self.densify(self._mean_gradients(), *self.growth(step.iteration))
            self.prune(large_too=self.prunes_large and step.iteration > config.opacity_reset_interval)
            self._forget_statistics()
        # On white, 3DGS resets once more where densification starts.
        starts_on_white = config.white_background and step.iteration == config.densify_from_iter
        if self.resets_opacity and (step.iteration % config.opacity_reset_interval == 0 or starts_on_white):
            self.reset_opacities()

    @property
    def densify_until(self) -> int:
        """The step before which densification ends."""
        return self.context.config.densify_until_iter

    def growth(self, iteration: int) -> Tuple[int, Optional[int]]:
        """How many Gaussians a densification adds at least and, but for None, at most."""
        budget = self.context.config.budget
        return 0, max(0, budget - self.context.model.num_gaussians) if budget else None

    def densify(self, gradients: torch.Tensor, least: int = 0, most: Optional[int] = None) -> None:
        """Clones small and splits large Gaussians whose mean gradient [N] reaches the threshold.

        Where those are fewer than `least` or more than `most`, so many of the largest gradients are taken.
        """
        config, model = self.context.config, self.context.model
        wanted = gradients >= config.densify_grad_threshold
        if least > 0 or most is not None:
            count = max(int(wanted.sum()), least)
            count = min(count, int((gradients > 0).sum()), count if most is None else most)
            wanted = torch.zeros_like(wanted)
            wanted[torch.topk(gradients, count).indices] = True
        large = model.scales.detach().max(dim=1).values > config.percent_dense * self.context.extent
        parents = wanted & large
        clones = (wanted & ~large).nonzero().squeeze(1)
        children = parents.nonzero().squeeze(1).repeat(CHILDREN)
        means, scales = self._children(children)
        raw = model.raw
        self.context.optimizer.take(torch.cat([(~parents).nonzero().squeeze(1), clones, children]), {
            "means3D": torch.cat([raw["means3D"].detach().index_select(0, clones), means]),
            "scales": torch.cat([raw["scales"].detach().index_select(0, clones), scales])})

    def _children(self, parents: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor]:
        """Means and raw scales of smaller Gaussians, at places drawn from their parents' own distribution.

        parents: the row of each one's parent.
        """
        raw = {name: self.context.model.raw[name].detach().index_select(0, parents)
               for name in ("means3D", "scales", "rotations")}
        scales = raw["scales"].exp()
        offsets = torch.normal(torch.zeros_like(scales), scales)
        turned = torch.bmm(quaternion_to_matrix(raw["rotations"]), offsets.unsqueeze(2)).squeeze(2)
        return raw["means3D"] + turned, torch.log(scales / SPLIT_SHRINK)

    def prune(self, large_too: bool) -> None:
        """Removes faint Gaussians and, if asked, those larger than a tenth of the scene."""
        model = self.context.model
        doomed = model.opacities.detach().squeeze(1) < MIN_OPACITY
        if large_too:
            doomed |= model.scales.detach().max(dim=1).values > MAX_SCALE * self.context.extent
        self.context.optimizer.keep(~doomed)

    def reset_opacities(self) -> None:
        """Lowers every opacity to at most RESET_OPACITY."""
        opacities = self.context.model.opacities.detach()
        self.context.optimizer.set_opacity_logits(inverse_sigmoid(opacities.clamp(max=RESET_OPACITY)))

    def _observe(self, step: Step) -> None:
        add_view(step.means2D.grad, step.rendering.radii, self.gradient_sum, self.view_count)

    def _mean_gradients(self) -> torch.Tensor:
        """[N] over the views that saw each Gaussian since the last densification; 0 where none did."""
        return self.gradient_sum / self.view_count.clamp(min=1)

    def _forget_statistics(self) -> None:
        means = self.context.model.raw["means3D"]
        self.gradient_sum = means.new_zeros(len(means))
        self.view_count = means.new_zeros(len(means))

    def state_dict(self) -> Dict[str, Any]:
        return {"gradient_sum": self.gradient_sum, "view_count": self.view_count}

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        self.gradient_sum, self.view_count = state["gradient_sum"], state["view_count"]


class SteadyStrategy(ThreeDGSStrategy):
    """The same density control without what destroys Gaussians wholesale: no opacity reset, no size prune."""

    resets_opacity = False
    prunes_large = False
