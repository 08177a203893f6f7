"""Adam over the trainable Gaussians, whose moments follow when rows are added, removed or replaced."""
from __future__ import annotations

import math
from typing import Any, Callable, Dict, Optional, Tuple

import torch

from diff_smoe_rasterization.lazy_adam import LazyAdam
from diff_smoe_rasterization.optimizers import FusedAdam

from .model import PARAMETERS, GaussianModel
from .options.config import TrainConfig
from .system.process import return_spare_memory

ADAM_EPSILON = 1e-15
VALUES = ("raw", "average")  # what a new Gaussian begins with; its moments begin at zero


class GaussianOptimizer:
    """Adam over a GaussianModel, one group per parameter, with the exponential schedule of positions."""

    def __init__(self, model: GaussianModel, config: TrainConfig, extent: float) -> None:
        """extent: the scene's scale, which multiplies the learning rate of positions.

        A batch of B views takes the learning rates of one view times sqrt(B), and its betas to the power of B.
        """
        self.model = model
        self.config = config
        self.position_scale = extent * math.sqrt(config.batch)
        rates = {
            "means3D": config.position_lr_init * extent,
            "dc": config.feature_lr,
            "shs": config.feature_lr / 20,
            "opacities": config.opacity_lr,
            "scales": config.scaling_lr,
            "rotations": config.rotation_lr,
        }
        rates = {name: rate * math.sqrt(config.batch) for name, rate in rates.items()}
        self.rates = rates
        self.average: Dict[str, torch.Tensor] = {}
        """Of the parameters over steps, by name, and of the background's gate if it is learned; empty: none is kept."""
        self.adam = FusedAdam([{"params": [model.raw[name]], "lr": rates[name], "name": name} for name in PARAMETERS],
                              eps=ADAM_EPSILON, betas=batch_betas(config.batch))

    def set_position_rate(self, iteration: int) -> None:
        """Sets the positions' learning rate for this step."""
        config = self.config
        rate = exponential_rate(iteration, config.position_lr_init, config.position_lr_final,
                                config.position_lr_max_steps)
        self.group("means3D")["lr"] = rate * self.position_scale

    @property
    def position_rate(self) -> float:
        """The learning rate of positions in this step, world units."""
        return self.group("means3D")["lr"]

    def scale_rate(self, name: str, factor: float) -> None:
        """Sets one learning rate, not the positions', to its option times the factor."""
        self.rates[name] *= factor
        self.group(name)["lr"] = self.rates[name]

    def scale_other_rates(self, factor: float) -> None:
        """Sets all learning rates except the positions' to their options times the factor."""
        for name in PARAMETERS[1:]:
            self.group(name)["lr"] = factor * self.rates[name]

    def step(self) -> None:
        """Steps every parameter that has a gradient, then drops the gradients."""
        if self.model.raw["shs"].grad is not None:
            self.start_higher_bands()
        self.adam.step()
        for tensor in self.model.stored.values():
            tensor.grad = None

    @torch.no_grad()
    def add_to_average(self, part: float, background_gate: Optional[torch.Tensor] = None) -> None:
        """Takes the average this part of the way to the parameters as they are now; the first call begins it there.

        background_gate: [1] one more, if it is learned.
        """
        now = {name: tensor.detach() for name, tensor in self.model.raw.items()}
        if background_gate is not None:
            now["background_gate"] = background_gate
        if not self.average:
            self.average = {name: tensor.clone() for name, tensor in now.items()}
        for name, tensor in self.average.items():
            tensor.lerp_(now[name], part)

    def append(self, rows: Dict[str, torch.Tensor]) -> None:
        """Adds Gaussians, raw parameters as in PARAMETERS; their moments start at zero."""
        for name in PARAMETERS:
            self._replace(name, lambda tensor, new: torch.cat([tensor, new]), rows[name])
        return_spare_memory(self.model.raw["means3D"].device)

    def keep(self, mask: torch.Tensor) -> None:
        """Removes the Gaussians whose mask [N] (bool) is False."""
        self.take(mask.nonzero().squeeze(1))  # on a GPU the host waits here, once for all tensors

    def take(self, rows: torch.Tensor, new: Optional[Dict[str, torch.Tensor]] = None) -> None:
        """Puts these rows [M] of Gaussians in place of all, in one pass over memory.

        new: raw parameters of the last rows, in place of those that were there. These rows begin without moments.
        """
        new = new or {}
        fresh = max((len(values) for values in new.values()), default=0)
        for name in PARAMETERS:  # one after the other: then only one is in memory twice
            old = self._tensors(name)
            taken = torch.ops.diff_smoe_rasterization.gather_rows([tensor.detach() for tensor in old.values()], rows)
            tensors = dict(zip(old, taken))
            for key, tensor in tensors.items():
                if key not in VALUES:
                    tensor[len(tensor) - fresh:] = 0
                elif name in new:
                    tensor[len(tensor) - fresh:] = new[name]
            del old
            self._put(name, tensors)
        return_spare_memory(self.model.raw["means3D"].device)

    def set_opacity_logits(self, logits: torch.Tensor) -> None:
        """Sets all opacity logits [N, 1] and forgets their moments."""
        self._replace("opacities", lambda tensor, new: new.clone(), logits)

    @torch.no_grad()
    def overwrite(self, rows: torch.Tensor, raw: Dict[str, torch.Tensor],
                  squares: Optional[Callable[[torch.Tensor], torch.Tensor]] = None) -> None:
        """Puts Gaussians, raw parameters as in PARAMETERS, in place of those in other rows [M], which differ.

        Their moments start at zero. squares: from the second moments of all, [N, ...], to those that they begin with.
        """
        for name in PARAMETERS:
            tensor = self.model.raw[name]
            tensor.index_copy_(0, rows, raw[name])
            if name in self.average:
                self.average[name].index_copy_(0, rows, raw[name])
            state = self.adam.state.get(tensor)
            if not state:
                continue
            second = state["exp_avg_sq"]
            state["exp_avg"].index_fill_(0, rows, 0)
            if squares is None:
                second.index_fill_(0, rows, 0)
            else:
                second.index_copy_(0, rows, squares(second))

    def rearrange(self, edit: Callable[[torch.Tensor], torch.Tensor]) -> None:
        """Puts edit(rows) in place of every parameter and every moment."""
        for name in PARAMETERS:
            tensor = self.model.raw[name]
            self._replace(name, lambda rows, _: edit(rows), tensor.new_zeros(0))

    def replace_all(self, raw: Dict[str, torch.Tensor]) -> None:
        """Sets every parameter, any number of rows, and forgets all moments and the average."""
        self.model.lazy = None
        self.average = {}
        self.adam.state.clear()
        for name in PARAMETERS:
            self._replace(name, lambda _, new: new.clone(), raw[name])

    def _replace(self, name: str, edit: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
                 rows: torch.Tensor) -> None:
        """Puts edit(tensor, rows) in place of a parameter and edit(moment, zeros like rows) in place of its moments.

        Its average is edited as itself.
        """
        self._put(name, {key: edit(tensor.detach(), rows.detach() if key in VALUES else torch.zeros_like(rows))
                         for key, tensor in self._tensors(name).items()})

    def _tensors(self, name: str) -> Dict[str, torch.Tensor]:
        """The parameter, `raw`, its `average` and its moments by their names in Adam's state, if it has these."""
        parameter = self.model.raw[name]
        state = {**self.adam.state.get(parameter, {})}
        if name in self.average:
            state["average"] = self.average[name]
        return {"raw": parameter, **{key: state[key] for key in ("average", "exp_avg", "exp_avg_sq") if key in state}}

    def _put(self, name: str, tensors: Dict[str, torch.Tensor]) -> None:
        """Puts others in place of what `_tensors` gives.

        The new leaf has no gradient, so the current step leaves it alone: as in 3DGS, where an iteration that
        densifies steps nothing and one that resets opacities steps all but them.
        """
        if name in self.model.color_sources().values():
            self.model.lazy = None  # `_tensors` has brought it up to date
        moments = {key: tensor.contiguous() for key, tensor in tensors.items()}
        new = moments.pop("raw").requires_grad_()
        if "average" in moments:
            self.average[name] = moments.pop("average")
        state = self.adam.state.pop(self.model.stored[name], None)
        if state is not None:
            state.update(moments)
            self.adam.state[new] = state
        self.group(name)["params"][0] = new
        self.model.stored[name] = new

    def group(self, name: str) -> Dict[str, Any]:
        """The parameter's group in Adam."""
        return self.adam.param_groups[PARAMETERS.index(name)]

    def lazy_colors(self) -> LazyAdam:
        """What steps the spherical harmonics whose rows are read now and then; the model is up to date by it."""
        model = self.model
        names = list(model.color_sources().values())
        parameters = [model.stored[name] for name in names]
        lazy = model.lazy
        if lazy is None or [id(tensor) for tensor in lazy.parameters] != [id(tensor) for tensor in parameters]:
            if lazy is not None:
                lazy.catch_up()
            if "shs" in names:
                self.start_higher_bands()
            lazy = model.lazy = LazyAdam(self.adam, parameters)
        return lazy

    def start_higher_bands(self) -> None:
        """Gives `shs` its Adam state if it has none yet, with the step count of `dc`.

        While degree 0 is active its gradient would be zero: Adam would leave it where it is and only count the
        step. Skipping that, and taking over the count, gives the same numbers and saves most of the step's time.
        """
        bands, base = self.model.stored["shs"], self.model.stored["dc"]
        if bands in self.adam.state or base not in self.adam.state:
            return
        self.adam.state[bands] = {
            "step": self.adam.state[base]["step"],
            "exp_avg": torch.zeros_like(bands),
            "exp_avg_sq": torch.zeros_like(bands),
        }

    def state_dict(self) -> Dict[str, Dict]:
        """Adam's state by parameter name."""
        return {name: dict(self.adam.state[self.model.raw[name]]) for name in PARAMETERS
                if self.model.raw[name] in self.adam.state}

    def load_state_dict(self, states: Dict[str, Dict]) -> None:
        """Takes what `state_dict` gave."""
        self.model.lazy = None
        self.adam.state.clear()
        for name, state in states.items():
            self.adam.state[self.model.raw[name]] = dict(state)


def batch_betas(batch: int) -> Tuple[float, float]:
    """Adam's betas for the gradients of so many views at once."""
    return 0.9**batch, 0.999**batch


def exponential_rate(step: int, first: float, last: float, max_steps: int) -> float:
    """Log-linear interpolation from `first` at step 0 to `last` at max_steps, constant from there on."""
    share = min(max(step / max_steps, 0.0), 1.0)
    return math.exp((1 - share) * math.log(first) + share * math.log(last))
