"""The strategy `mcmc`: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024, arXiv:2404.09591).

Written from the paper: its noise on positions, its relocation of dead Gaussians, its regularisers, its growth to a
given number.
"""
from __future__ import annotations

from typing import Dict

import torch

from diff_smoe_rasterization.gaussians import divided

from ..model import PARAMETERS, inverse_sigmoid, quaternion_to_matrix
from .drawing import draw
from .strategy import Step, Strategy, StrategyContext

DEAD_OPACITY = 0.005  # fainter Gaussians are relocated
START_OPACITY, START_SCALE = 0.5, 0.1  # of the first Gaussians; the scale is a part of that of 3DGS
OPACITY_WEIGHT = SCALE_WEIGHT = 0.01  # lambda_o and lambda_Sigma of the loss
NOISE_RATE = 5e5  # lambda_noise
NOISE_STEEPNESS = 100.0  # k: Gaussians are moved by the noise where they are faint
GROWTH = 0.05  # of the Gaussians, at each step of growth
GROWTH_ENDS = 5 / 3  # of densify_until_iter: 25,000


class MCMCStrategy(Strategy):
    """Relocates dead Gaussians to others in a way that keeps the image, grows to the budget, explores by noise."""

    def __init__(self, context: StrategyContext) -> None:
        super().__init__(context)
        with torch.no_grad():
            context.model.raw["opacities"].fill_(float(inverse_sigmoid(torch.tensor(START_OPACITY))))
            context.model.raw["scales"] += float(torch.tensor(START_SCALE).log())

    def after_backward(self, step: Step) -> None:
        """Adds the gradients of the two regularisers, which are means over the Gaussians."""
        for name, weight in (("opacities", OPACITY_WEIGHT), ("scales", SCALE_WEIGHT)):
            step.add_gradient(name, weight / self.context.model.stored[name].numel())

    def after_step(self, step: Step) -> None:
        config = self.context.config
        if (config.densify_from_iter < step.iteration < round(GROWTH_ENDS * config.densify_until_iter)
                and step.iteration % config.densification_interval == 0):
            self.relocate()
            self.grow()
        self.shake()

    def relocate(self) -> None:
        """Moves dead Gaussians to living ones, drawn by opacity."""
        opacities = self.context.model.opacities.squeeze(1)
        alive, dead = (opacities > DEAD_OPACITY).nonzero().squeeze(1), (opacities <= DEAD_OPACITY).nonzero().squeeze(1)
        if len(alive) == 0 or len(dead) == 0:
            return
        drawn = alive[draw(opacities[alive], len(dead), replacement=True)]
        self.context.optimizer.overwrite(dead, self._divide(drawn))

    def grow(self) -> None:
        """Adds Gaussians, at least one, at others, drawn by opacity, up to the budget."""
        model, budget = self.context.model, self.context.config.budget
        now = model.num_gaussians
        count = min(budget, max(now + 1, int((1 + GROWTH) * now))) - now
        if count <= 0:
            return
        drawn = draw(model.opacities.squeeze(1), count, replacement=True)
        self.context.optimizer.append(self._divide(drawn))

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
        """Adds noise to the positions, in the shape of each Gaussian and where it is faint (Eq. 8)."""
        opacities, scales, rotations = self.context.model.activated()
        means = self.context.model.stored["means3D"]
        axes = quaternion_to_matrix(rotations) * scales.unsqueeze(1)
        faint = torch.sigmoid(NOISE_STEEPNESS * (DEAD_OPACITY - opacities))
        noise = faint * (NOISE_RATE * self.context.optimizer.position_rate) * torch.randn_like(means)
        means += torch.bmm(axes, torch.bmm(axes.transpose(1, 2), noise.unsqueeze(2))).squeeze(2)
