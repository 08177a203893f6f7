"""The strategy `mcmc`: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024, arXiv:2404.09591).

Written from the paper: its noise on positions, its relocation of dead Gaussians, its regularisers, its growth to a
given number.
"""
from __future__ import annotations

from typing import Dict

import torch

from diff_smoe_rasterization.gaussians import divided

from ..model import PARAMETERS, inverse_sigmoid, rotation_matrices
from .randomness import draw
from .strategy import Step, Strategy, StrategyContext

DEAD_OPACITY = 0.005  # fainter Gaussians are relocated
START_OPACITY, START_SCALE = 0.5, 0.1  # of Gaussians at points; the scale is this part of 3DGS's
OPACITY_WEIGHT = SCALE_WEIGHT = 0.01  # lambda_o and lambda_Sigma of the loss
NOISE_RATE = 5e5  # lambda_noise
NOISE_STEEPNESS = 100.0  # k: Gaussians are moved by the noise if they are faint
GROWTH = 0.05  # of the Gaussians, at each step of growth
GROWTH_ENDS = 5 / 3  # of densify_until_iter: 25,000


class MCMCStrategy(Strategy):
    """Relocates dead Gaussians to others in a way that keeps the image, grows to the budget, explores by noise."""

    def __init__(self, context: StrategyContext) -> None:
        super().__init__(context)
        if context.config.init:  # a model's Gaussians are not first guesses
            return
        with torch.no_grad():
            context.model.raw["opacities"].fill_(float(inverse_sigmoid(torch.tensor(START_OPACITY))))
            context.model.raw["scales"] += float(torch.tensor(START_SCALE).log())

    def after_backward(self, step: Step) -> None:
        """Adds the gradients of the two regularisers, which are means over the Gaussians, for each view of the step."""
        for name, weight in (("opacities", OPACITY_WEIGHT), ("scales", SCALE_WEIGHT)):
            numbers = self.context.num_gaussians * self.context.model.stored[name].shape[1]
            step.add_gradient(name, step.batch * weight / numbers)

    def after_step(self, step: Step) -> None:
        config = self.context.config
        if (config.densify_from_iter < step.iteration < round(GROWTH_ENDS * config.densify_until_iter)
                and step.due(config.densification_interval)):
            self.relocate()
            self.grow()
        self.shake()

    def relocate(self) -> None:
        """Moves dead Gaussians to living ones, drawn by opacity."""
        shards = self.context.shards
        drawn, dead = shards.decide(self._choose_relocations, self.context.model.opacities.squeeze(1)).unbind(1)
        origins, places, send = shards.route(drawn, dead)
        joining = self._divide(origins)
        self.context.optimizer.overwrite(places, {name: send(rows) for name, rows in joining.items()})

    def _choose_relocations(self, opacities: torch.Tensor) -> torch.Tensor:
        """[M, 2] rows of living Gaussians, and of the dead ones that join them. opacities: [N] of all Gaussians."""
        alive, dead = (opacities > DEAD_OPACITY).nonzero().squeeze(1), (opacities <= DEAD_OPACITY).nonzero().squeeze(1)
        if len(alive) == 0 or len(dead) == 0:
            return dead.new_empty((0, 2))
        return torch.stack([alive[draw(opacities[alive], len(dead), replacement=True)], dead], 1)

    def grow(self) -> None:
        """Adds Gaussians, at least one, at others, drawn by opacity, up to the budget."""
        model, shards, now = self.context.model, self.context.shards, self.context.num_gaussians
        count = min(self.context.config.budget, max(now + 1, int((1 + GROWTH) * now))) - now
        if count <= 0:
            return
        drawn = shards.decide(lambda every: draw(every, count, replacement=True).sort().values,
                              model.opacities.squeeze(1))
        own, before = shards.route(drawn, drawn).origins, model.num_gaussians
        self.context.optimizer.append(self._divide(own))
        shards.settle((torch.arange(model.num_gaussians, device=own.device) >= before).long())

    def _divide(self, drawn: torch.Tensor) -> Dict[str, torch.Tensor]:
        """Makes room at the drawn rows [M], of which some may be equal. Returns the M raw Gaussians that join them."""
        raw = self.context.model.raw
        opacities, scales, _ = self.context.model.activated()
        rows, times = drawn.unique(return_counts=True)
        new_opacities, factors = divided(opacities[rows].squeeze(1), times + 1)
        changed = {name: raw[name].detach().index_select(0, rows) for name in PARAMETERS}
        changed["opacities"] = inverse_sigmoid(new_opacities.clamp(DEAD_OPACITY, 1 - 1e-6)).unsqueeze(1)
        changed["scales"] = (scales[rows] * factors.unsqueeze(1)).log()
        self.context.optimizer.overwrite(rows, changed)
        return {name: raw[name].detach().index_select(0, drawn) for name in PARAMETERS}

    def shake(self) -> None:
        """Adds noise to the positions, in the shape of each Gaussian, if it is faint (Eq. 8)."""
        opacities, scales, rotations = self.context.model.activated()
        means = self.context.model.stored["means3D"]
        axes = rotation_matrices(rotations) * scales.unsqueeze(1)
        # Neither torch.sigmoid nor torch.bmm: they may round otherwise for another number of rows.
        faint = 1 / (1 + torch.exp(NOISE_STEEPNESS * (opacities - DEAD_OPACITY)))
        normal = self.context.shards.own_rows(torch.randn(self.context.num_gaussians, 3, device=means.device))
        noise = faint * (NOISE_RATE * self.context.optimizer.position_rate) * normal
        along = (axes * noise.unsqueeze(2)).sum(1)
        means += (axes * along.unsqueeze(1)).sum(2)
