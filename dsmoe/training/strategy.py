"""How Gaussians are added and removed: one small interface, and the recipe of 3DGS behind it.

A new strategy is one class with the hooks below and one line in strategies.py. What it may need of the run, extra
renderings of training views included, is in StrategyContext.
"""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

import torch

from diff_smoe_rasterization.gaussians import add_view
from diff_smoe_rasterization.images import as_float
from diff_smoe_rasterization.losses import l1_ssim_loss_and_gradient, l2_ssim_loss_and_gradient
from diff_smoe_rasterization.settings import Rendering
from diff_smoe_rasterization.splats import Splats

from ..model import GaussianModel, inverse_sigmoid, rotation_matrices
from ..optimizer import GaussianOptimizer
from ..options.config import TrainConfig
from ..results.rendering import Renderer
from ..scenes.images import View
from .shards import Shards

MIN_OPACITY = 0.005  # fainter Gaussians are pruned
RESET_OPACITY = 0.01  # an opacity reset leaves no Gaussian above this
MAX_SCALE = 0.1  # of the scene extent; larger Gaussians are pruned after the first reset
CHILDREN = 2  # a split makes so many
SPLIT_SHRINK = 0.8 * CHILDREN  # a child's scale is its parent's divided by this


class Look(NamedTuple):
    """What one view says of each Gaussian's worth: sums over its pixels of squared colours."""

    costs: torch.Tensor  # [N] how much the image changes on the removal of the Gaussian
    errors: torch.Tensor  # [N] the error of its pixels, by its share


def look_at(view: View, target: torch.Tensor, color: torch.Tensor, splats: Splats) -> Look:
    """The look at a rendering of the view. target, color: [3, H, W]."""
    error = (color.detach() - as_float(target)).square().sum(0)
    mask = view.mask_float()
    weights = None if mask is None else mask[0]
    importance = splats.importance(weights, error if weights is None else weights * error)
    return Look(importance.removal_costs, importance.shares)


@dataclass
class StrategyContext:
    """What a strategy works on, for the whole run."""

    config: TrainConfig
    model: GaussianModel
    optimizer: GaussianOptimizer
    extent: float  # scene extent, world units
    views: Sequence[View]  # for training
    render: Renderer  # for passes of the strategy's own
    look: Callable[[Sequence[View]], Iterator[Look]]  # renders views, and looks at each; rows are those of the model
    shards: Shards = field(default_factory=Shards)  # which of the Gaussians the model has

    @property
    def num_gaussians(self) -> int:
        """Of all processes."""
        return self.shards.total(self.model.num_gaussians)


Seen = Tuple[torch.Tensor, torch.Tensor]
"""Of one view dL/dpixel times (0.5 W, 0.5 H), [N, 3], if radii > 0, and these radii [N] int32."""


def is_due(iteration: int, interval: int, batch: int = 1) -> bool:
    """Whether a multiple of the interval is among the `batch` iterations up to this one; an interval of 0 has none."""
    return interval > 0 and iteration // interval > (iteration - batch) // interval


@dataclass
class Step:
    """One training step, as far as it has come when a hook is called. Iterations count views, from 1.

    The trainer calls `backward` and, but in the last step, `update`.
    """

    iteration: int  # of its last view
    batch: int  # views, each an iteration
    loss: torch.Tensor  # the mean over the views
    looks: List[Look] = field(default_factory=list, init=False)  # at the views that the strategy's `looks_at` has named
    seen: List[Seen] = field(default_factory=list, init=False)  # what each view says of the Gaussians; after backward

    def backward(self) -> None:
        """From the gradients by the images to those by all parameters and the gate; sets `seen`."""
        raise NotImplementedError

    def add_gradient(self, name: str, number: float) -> None:
        """Adds a number to the loss's gradient by every opacity, scale or rotation, as `name` says; after backward."""
        raise NotImplementedError

    def update(self) -> None:
        """Steps the parameters that have not been replaced since the step was rendered."""
        raise NotImplementedError

    def due(self, interval: int) -> bool:
        """Whether a multiple of the interval is among the step's iterations."""
        return is_due(self.iteration, interval, self.batch)

    def reaches(self, iteration: int) -> bool:
        """Whether that one is among the step's iterations."""
        return self.iteration - self.batch < iteration <= self.iteration


@dataclass
class ViewStep(Step):
    """A step over one view, in one process."""

    view: View
    target: torch.Tensor  # [3, H, W] what the rendering is compared with, uint8 or in 0 to 1
    rendering: Rendering


class Strategy:
    """Does nothing: a fixed set of Gaussians. The base of every strategy.

    Hooks run in this order in each step. Learning rates may be set in any, best in the first; rows may be added or
    removed in the last two (through the optimizer), which the last step of a run leaves out. The tensors of a step hold
    until its end. What is decided over all Gaussians is decided through `context.shards`, as a process may have
    only some of them.
    """

    def __init__(self, context: StrategyContext) -> None:
        """May change the first Gaussians; a resumed run replaces them and loads the state."""
        self.context = context

    def most(self) -> int:
        """How many Gaussians there will be at most; 0: nobody knows."""
        return self.context.config.budget

    def loss(self, iteration: int, image: torch.Tensor, target: torch.Tensor, padding: str = "same"
             ) -> Tuple[torch.Tensor, torch.Tensor]:
        """The loss of a rendering [3, H, W], and its gradient by it. target: floats, or bytes of 255ths.

        padding: of SSIM's windows, as `fused_ssim` takes it.
        """
        squares, lambda_dssim = self.squares(iteration), self.context.config.lambda_dssim
        if squares == 0:
            return l1_ssim_loss_and_gradient(image, target, lambda_dssim, padding)
        return l2_ssim_loss_and_gradient(image, target, lambda_dssim, squares, padding)

    def squares(self, iteration: int) -> float:
        """The weight of the squared error in the loss, in place of the absolute one; 0: the loss of 3DGS."""
        return 0.0

    def loss_rule(self, iteration: int) -> Any:
        """What `loss` depends on beside the images: a step may be repeated as a CUDA graph while this stays equal.

        A `loss` of a strategy's own is called anew in each step, unless the strategy says here what it depends on.
        """
        return self.squares(iteration) if type(self).loss is Strategy.loss else iteration

    def before_render(self, iteration: int) -> None:
        """A step begins that ends with this iteration."""

    def looks_at(self, iteration: int, views: Sequence[View]) -> List[int]:
        """At which of the views of the step that ends with this iteration `step.looks` is to look, rising."""
        return []

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
        if step.iteration > config.densify_from_iter and step.due(config.densification_interval):
            kinds = self.densify(self._mean_gradients(), *self.growth(step.iteration))
            kept = self.prune(large_too=self.prunes_large and step.iteration > config.opacity_reset_interval)
            self.context.shards.settle(kinds[kept])
            self._forget_statistics()
        # On white, 3DGS resets once more when densification starts.
        starts_on_white = config.white_background and step.reaches(config.densify_from_iter)
        if self.resets_opacity and (step.due(config.opacity_reset_interval) or starts_on_white):
            self.reset_opacities()

    @property
    def densify_until(self) -> int:
        """The step before which densification ends."""
        return self.context.config.densify_until_iter

    def growth(self, iteration: int) -> Tuple[int, Optional[int]]:
        """How many Gaussians a densification adds at least and, but for None, at most."""
        budget = self.context.config.budget
        return 0, max(0, budget - self.context.num_gaussians) if budget else None

    def densify(self, gradients: torch.Tensor, least: int = 0, most: Optional[int] = None) -> torch.Tensor:
        """Clones small and splits large Gaussians whose mean gradient [N] reaches the threshold.

        If those are fewer than `least` or more than `most`, so many of the largest gradients are taken. Returns the
        kinds of all Gaussians now, [N] int64: 0 for the old ones, 1 for clones, from 2 on the children of splits.
        """
        config, model = self.context.config, self.context.model
        wanted = gradients >= config.densify_grad_threshold
        if least > 0 or most is not None:
            shards = self.context.shards
            wanted = shards.own_rows(shards.decide(lambda every: self._largest(every, least, most), gradients))
        large = model.scales.detach().max(dim=1).values > config.percent_dense * self.context.extent
        parents = wanted & large
        kept, clones = (~parents).nonzero().squeeze(1), (wanted & ~large).nonzero().squeeze(1)
        split = parents.nonzero().squeeze(1)
        children = split.repeat(CHILDREN)
        means, scales = self._children(children)
        raw = model.raw
        self.context.optimizer.take(torch.cat([kept, clones, children]), {
            "means3D": torch.cat([raw["means3D"].detach().index_select(0, clones), means]),
            "scales": torch.cat([raw["scales"].detach().index_select(0, clones), scales])})
        counts = [len(kept), len(clones), *[len(split)] * CHILDREN]
        kinds = torch.arange(len(counts), device=kept.device)
        return kinds.repeat_interleave(torch.tensor(counts, device=kept.device), output_size=sum(counts))

    def _largest(self, gradients: torch.Tensor, least: int, most: Optional[int]) -> torch.Tensor:
        """Which Gaussians a densification takes that has bounds: a mask [N]. gradients: [N] of all Gaussians."""
        wanted = gradients >= self.context.config.densify_grad_threshold
        count = max(int(wanted.sum()), least)
        count = min(count, int((gradients > 0).sum()), count if most is None else most)
        mask = torch.zeros_like(wanted)
        mask[torch.topk(gradients, count).indices] = True
        return mask

    def _children(self, parents: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor]:
        """Means and raw scales of smaller Gaussians, at places drawn from their parents' own distribution.

        parents: the row of each one's parent.
        """
        raw = {name: self.context.model.raw[name].detach().index_select(0, parents)
               for name in ("means3D", "scales", "rotations")}
        scales = raw["scales"].exp()
        normal = self.context.shards.draw(lambda count: torch.randn(CHILDREN, count, 3, device=scales.device),
                                          len(parents) // CHILDREN)
        offsets = normal.reshape(-1, 3) * scales
        # No torch.bmm: it may round otherwise for another number of rows, of which a process has only some.
        turned = (rotation_matrices(raw["rotations"]) * offsets.unsqueeze(1)).sum(2)
        return raw["means3D"] + turned, torch.log(scales / SPLIT_SHRINK)

    def prune(self, large_too: bool) -> torch.Tensor:
        """Removes faint Gaussians and, if asked, those larger than a tenth of the scene. Returns which stay, [N]."""
        model = self.context.model
        doomed = model.opacities.detach().squeeze(1) < MIN_OPACITY
        if large_too:
            doomed |= model.scales.detach().max(dim=1).values > MAX_SCALE * self.context.extent
        self.context.optimizer.keep(~doomed)
        return ~doomed

    def reset_opacities(self) -> None:
        """Lowers every opacity to at most RESET_OPACITY."""
        opacities = self.context.model.opacities.detach()
        self.context.optimizer.set_opacity_logits(inverse_sigmoid(opacities.clamp(max=RESET_OPACITY)))

    def _observe(self, step: Step) -> None:
        for gradients, radii in step.seen:
            add_view(gradients, radii, self.gradient_sum, self.view_count)

    def _mean_gradients(self) -> torch.Tensor:
        """[N] over the views that saw each Gaussian since the last densification; 0 if none did."""
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
