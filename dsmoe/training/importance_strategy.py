"""The strategy `importance`: to a given number of Gaussians, those that explain most.

It grows well beyond the budget. Then it removes in steps the Gaussians whose removal changes the training views least,
and moves the cheapest of what is left to where the error is. Cost and error are sums over pixels of squared colours, so
they can be compared: `Splats.importance`. The rules and what they are worth: docs/trainer.md.
"""
from __future__ import annotations

import math
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np
import torch

from ..errors import ConfigError
from ..model import PARAMETERS, inverse_sigmoid, rotation_matrices
from ..options.config import TrainConfig
from ..scenes.images import View
from .randomness import draw
from .strategy import Look, SteadyStrategy, Step, StrategyContext, is_due

# Milestones, as parts of densify_until_iter (15,000): growth ends at 8,000, sixteen removals are at 8,200 to 13,825,
# moves are every 500 until 20,000.
GROWTH_ENDS = 8 / 15
REMOVALS_BEGIN, REMOVALS_END = 8.2 / 15, 14.2 / 15
REMOVALS_BEGIN_FROM_MODEL = 0.02  # a model that has enough Gaussians does not grow
MOVES_END = 4 / 3

# The average begins behind 21,000. Between two of its terms are so many steps, fewer in the shortest runs, and at least
# a batch.
AVERAGE_BEGINS = 7 / 5
MOST_BETWEEN_TERMS = 10
TERMS = 100  # in densify_until_iter, at least, if that has so many steps

# A view needs a Gaussian if its removal costs more than this there: squared colours, summed over pixels.
NEEDED_COST = 1e-3

NEAREST_POINTS = 0.01  # the scene begins behind this part of the points, seen from a camera in any direction
NUMBERS_AT_ONCE = 2 ** 22  # coordinates of Gaussians, each seen from every camera: 16 MB of them are in memory

# Growth beyond this many, or beyond twice the budget if that is more, would cost time and memory: no budget above
# 200,000 was tried with more.
MOST_OVERSHOOT = 2_000_000

# A split along the longest axis: each child's offset and scale, in standard deviations of its parent, and the opacity
# at which both together cover what the parent did.
CHILD_OFFSET = 0.5
CHILD_SCALE = 0.65
CHILD_COVER = 0.744


def reached_from(config: TrainConfig, start: int) -> int:
    """How many Gaussians growth can make of so many: a densification doubles at most."""
    return start * 2**_densifications(config, config.densify_from_iter)


def _growth_end(config: TrainConfig) -> int:
    return round(GROWTH_ENDS * config.densify_until_iter)


def _densifications(config: TrainConfig, behind: int) -> int:
    """How many densifications of growth come behind an iteration."""
    return sum(is_due(iteration, config.densification_interval, config.batch)
               for iteration in range(config.batch, _growth_end(config), config.batch) if iteration > behind)


class ImportanceStrategy(SteadyStrategy):
    """Overshoot, remove by exact cost, then move by cost against error. From any start, below or above the budget."""

    def __init__(self, context: StrategyContext) -> None:
        config = context.config
        self.options = config.importance_options()
        super().__init__(context)
        context.optimizer.scale_rate("shs", self.options.bands)
        self.start = context.num_gaussians
        until = config.densify_until_iter
        is_enough = bool(config.init) and self.start >= config.budget
        self.growth_ends = 0 if is_enough else _growth_end(config)
        begin = REMOVALS_BEGIN_FROM_MODEL if is_enough else REMOVALS_BEGIN
        count = self.options.removals
        last = config.iterations - config.batch  # the last step changes nothing
        self.removals = [min(last, round(until * (begin + (REMOVALS_END - begin) * i / count))) for i in range(count)]
        self.drops_unneeded = is_enough
        interval = max(1, round(until / self.options.pace))
        self.moves_end = round(MOVES_END * until)
        self.moves = [iteration for iteration in range(interval, self.moves_end + 1, interval)
                      if iteration > self.removals[-1] and self.options.moves > 0]
        self.average_begins = round(AVERAGE_BEGINS * until)
        self.between_terms = max(config.batch, min(MOST_BETWEEN_TERMS, until // TERMS))
        self.average_span = self.options.average * until  # steps
        self._looked: List[View] = []  # by the step in progress
        self._find_free_space()
        self._check_reach()

    def _check_reach(self) -> None:
        """Raises ConfigError if growth cannot lead to the budget."""
        config = self.context.config
        most = reached_from(config, self.start)
        if most < config.budget:
            raise ConfigError(f"--budget is {config.budget}; it must be at most {most}: that is what {self.start} "
                              "points reach with one densification each --densification-interval "
                              f"{config.densification_interval} between --densify-from-iter "
                              f"{config.densify_from_iter} and step {self.growth_ends}, where growth ends")

    def _find_free_space(self) -> None:
        """Around each training camera is a ball in which nothing can be, as the points of the scene begin behind it."""
        points = self.context.shards.every(self.context.model.raw["means3D"].detach())
        nearest = max(1, int(NEAREST_POINTS * len(points)))
        centers = np.stack([view.camera.center for view in self.context.views])
        self.cameras = torch.tensor(centers, dtype=points.dtype, device=points.device)  # [views, 3]
        # Many cameras at once: on a GPU torch finds the kth of one row by one thread block.
        parts = self.cameras.split(max(1, NUMBERS_AT_ONCE // points.numel()))
        begins = [(points - part[:, None]).norm(dim=2).kthvalue(nearest, dim=1).values for part in parts]
        self.free_radii = self.options.near * torch.cat(begins)  # [views] world units

    def is_near(self) -> torch.Tensor:
        """[N] which Gaussians float in front of a training camera.

        They are haze that changes the training views a little, and covers a test view whose camera is closer to them.
        """
        parts = self.context.model.raw["means3D"].detach().split(max(1, NUMBERS_AT_ONCE // self.cameras.numel()))
        return torch.cat([((part[:, None] - self.cameras).square().sum(2) < self.free_radii.square()).any(1)
                          for part in parts])

    def is_of_few(self) -> torch.Tensor:
        """[N] which Gaussians few views need, at most half of all; of views that a decision looks at, as small a part.

        Of one or two views no Gaussian could have three.
        """
        views = len(self.context.views)
        return self.needed * views < min(self.options.needs, views / 2) * self.looks

    def squares(self, iteration: int) -> float:
        return self.options.squares if iteration > self.moves_end else 0.0

    def before_render(self, iteration: int) -> None:
        if self.options.anneal != 1:
            span = max(1, self.context.config.position_lr_max_steps - self.moves_end)
            share = min(max((iteration - self.moves_end) / span, 0.0), 1.0)
            self.context.optimizer.scale_other_rates(self.options.anneal**share)

    def before_backward(self, step: Step) -> None:
        for view, look in zip(self._looked, step.looks):
            self._add(view, look)

    def after_step(self, step: Step) -> None:
        if self.drops_unneeded and step.reaches(self.context.config.batch):
            self.drop_unneeded()
        if any(map(step.reaches, self.removals)):  # a large batch has some in the first step too
            self.remove(1 + sum(later > step.iteration for later in self.removals))
        elif any(map(step.reaches, self.moves)):
            self.move()
        behind, between = step.iteration - self.average_begins, self.between_terms
        if self.average_span > 0 and behind >= between and is_due(behind, between, step.batch):
            # At first all terms weigh the same, as else the first one would weigh more than others to the end.
            terms = behind // between
            part = min(1.0, between / min(self.average_span, terms * between))
            gate = self.context.render.background_gate
            self.context.optimizer.add_to_average(part, gate if isinstance(gate, torch.Tensor) else None)

    @property
    def looks(self) -> int:
        """How many training views a decision looks at."""
        return min(self.options.views, len(self.context.views))

    @property
    def densify_until(self) -> int:
        return self.growth_ends

    def growth(self, iteration: int) -> Tuple[int, Optional[int]]:
        """At least what reaches the budget and at most what reaches the overshoot, in equal steps."""
        config, now = self.context.config, self.context.num_gaussians
        steps = 1 + _densifications(config, iteration)
        least = -(-max(0, config.budget - now) // steps)
        if self.options.overshoot == 0:
            return least, None
        return least, -(-max(0, self.overshoot() - now) // steps)

    def most(self) -> int:
        if self.growth_ends == 0:
            return self.start
        return 0 if self.options.overshoot == 0 else self.overshoot()

    def overshoot(self) -> int:
        """How many Gaussians growth leads to, if the gradients suffice."""
        budget = self.context.config.budget
        wanted = round(self.options.overshoot * budget)
        return max(min(wanted, max(2 * budget, MOST_OVERSHOOT)), 2 * self.start)

    def remove(self, steps_left: int) -> None:
        """Removes the cheapest, down to the budget in steps of equal ratios. steps_left: with this one."""
        now, budget = self.context.num_gaussians, self.context.config.budget
        if now <= budget:
            return
        ratio = now / budget
        kept = budget if steps_left == 1 else round(budget * ratio ** ((steps_left - 1) / steps_left))
        self._look_at_the_rest()
        self._keep(kept)

    def drop_unneeded(self) -> None:
        """Removes what no view that a decision looks at needs, as far as the budget allows."""
        self._look_at_the_rest()
        needed = self.context.shards.every(self.needed)
        self._keep(max(self.context.config.budget, int((needed > 0).sum())))

    def _keep(self, kept: int) -> None:
        """Removes all but so many.

        First go those that float in front of a camera, then those that few views need.
        """
        now, shards = self.context.num_gaussians, self.context.shards
        scores = torch.where(self.is_of_few(), -1 / self.costs, self.costs).masked_fill(self.is_near(), -math.inf)
        best = shards.decide(lambda every: torch.topk(every, kept).indices, scores)
        mask = torch.zeros(now, dtype=torch.bool, device=scores.device)
        mask[best] = True
        own = shards.own_rows(mask)
        self.context.optimizer.keep(own)
        shards.settle(torch.zeros_like(own, dtype=torch.long)[own])
        self._forget_statistics()

    def move(self) -> None:
        """Moves the cheapest Gaussians to others, drawn by their error, which are split there.

        Those that few views need and those that float in front of a camera count as free of cost, and no other moves to
        the latter.
        """
        self._look_at_the_rest()
        near = self.is_near()
        costs, errors = self.costs.masked_fill(near | self.is_of_few(), 0), self.errors.masked_fill(near, 0)
        self._forget_looks()
        moves = self.context.shards.decide(self._choose_moves, costs, errors)
        self.split(*moves.unbind(1))

    def _choose_moves(self, costs: torch.Tensor, errors: torch.Tensor) -> torch.Tensor:
        """[M, 2] rows of Gaussians to split, and of those that move there. costs, errors: [N] of all Gaussians."""
        count = int(self.options.moves * len(costs))
        costs, sources = torch.topk(costs, count, largest=False)
        errors = errors.index_fill(0, sources, 0)
        count = min(count, int((errors > 0).sum()))
        if count == 0:
            return sources.new_empty((0, 2))
        targets = draw(errors, count)
        errors, order = errors[targets].sort(descending=True)
        worth = (costs[:count] < self.options.worth * errors).nonzero().squeeze(1)
        return torch.stack([targets[order][worth], sources[worth]], 1)

    def split(self, parents: torch.Tensor, places: torch.Tensor) -> None:
        """Splits Gaussians in two along their longest axis. places: of those whose places the second children take.

        Both are rows among all Gaussians. The children begin without Adam's first moment, and with their parent's
        second one.
        """
        parents, places, send = self.context.shards.route(parents, places)
        raw = {name: self.context.model.raw[name].detach().index_select(0, parents) for name in PARAMETERS}
        scales = raw["scales"].exp()
        axis = scales.argmax(dim=1, keepdim=True)
        directions = rotation_matrices(raw["rotations"]).gather(2, axis.unsqueeze(1).expand(-1, 3, 1)).squeeze(2)
        offsets = CHILD_OFFSET * scales.gather(1, axis) * directions
        opacities = self.context.model.opacities.detach().index_select(0, parents)
        children = torch.minimum(opacities, (1 - (1 - opacities).sqrt()) / CHILD_COVER)
        raw["opacities"] = inverse_sigmoid(children.clamp(max=1 - 1e-6))  # of 1 it is infinite
        raw["scales"] = torch.where(torch.arange(3, device=axis.device) == axis, (CHILD_SCALE * scales).log(),
                                    raw["scales"])
        means = raw["means3D"]
        second = {name: send(rows) for name, rows in {**raw, "means3D": means - offsets}.items()}
        overwrite = self.context.optimizer.overwrite
        overwrite(parents, {**raw, "means3D": means + offsets}, lambda squares: squares.index_select(0, parents))
        overwrite(places, second, lambda squares: send(squares.index_select(0, parents)))

    def looks_at(self, iteration: int, views: Sequence[View]) -> List[int]:
        """Those that the next decision wants: the first of each group, in the last round of the views."""
        removes = self.context.num_gaussians > self.context.config.budget
        begun = iteration - self.context.config.batch
        following = next((later for later in [*self.removals, *self.moves] if later > begun), None)
        wanted: List[int] = []
        if (following is not None and following - iteration < len(self.context.views)
                and (removes or following > self.removals[-1])):
            wanted = self._firsts(views)
        self._looked = [views[index] for index in wanted]
        return wanted

    def _firsts(self, views: Sequence[View]) -> List[int]:
        """Which of the views are the first of a group that is sought."""
        groups = [self.sought.get(view.camera.name) for view in views]
        return [index for index, group in enumerate(groups) if group is not None and group not in groups[:index]]

    def _add(self, view: View, look: Look) -> None:
        """Adds what each Gaussian is worth to one rendering."""
        self.costs += look.costs
        self.needed += look.costs > NEEDED_COST
        self.errors += look.errors
        group = self.sought.get(view.camera.name)
        self.sought = {name: other for name, other in self.sought.items() if other != group}

    def _look_at_the_rest(self) -> None:
        """Renders what the steps before the decision did not show."""
        views = [self.context.views[index] for index in self._firsts(self.context.views)]
        for view, look in zip(views, self.context.look(views)):
            self._add(view, look)

    def _forget_statistics(self) -> None:
        super()._forget_statistics()
        self._forget_looks()

    def _forget_looks(self) -> None:
        """Begins new sums, [N], for the next decision, which looks at a view of each group of neighbours."""
        self.costs = torch.zeros_like(self.view_count)  # squared change of the images on the Gaussian's removal
        self.errors = torch.zeros_like(self.view_count)  # the squared error of its pixels, by its share
        self.needed = torch.zeros_like(self.view_count)  # how many of the views need the Gaussian
        views = self.context.views
        count = self.looks
        first = int(torch.randint(len(views), ()))
        # The group of each view, by name. A look at a view takes out its group.
        self.sought = {views[(first + i) % len(views)].camera.name: i * count // len(views) for i in range(len(views))}

    def state_dict(self) -> Dict[str, Any]:
        return {**super().state_dict(), "start": self.start, "costs": self.costs, "errors": self.errors,
                "needed": self.needed, "sought": self.sought}

    def load_state_dict(self, state: Dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.start = state["start"]
        self.costs, self.errors, self.needed = state["costs"], state["errors"], state["needed"]
        self.sought = dict(state["sought"])
