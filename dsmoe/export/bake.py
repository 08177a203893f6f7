"""Fine-tuning of a model of another blend to alpha, which every viewer shows."""
from __future__ import annotations

import math
import sys
from typing import Any, Dict, NamedTuple, Optional

from diff_smoe_rasterization.settings import resolve_background_gate, trained_faint_below

from ..errors import TrainerError
from ..inspection import compared
from ..model import GaussianModel, finite_rows
from ..options.config import TrainConfig
from ..results.evaluation import evaluate
from ..results.rendering import Renderer
from ..results.rows import viewer_warning
from ..scenes.scene import load_scene
from ..train import Run
from ..training.strategy import Step, Strategy, StrategyContext
from ..training.trainer import Trainer

RISE = 0.4  # the part of the iterations in which the background gate goes to 1
LEAST_GATE = 0.01  # a gate of 0 starts here, because no factor raises 0


class Baked(NamedTuple):
    """A model for alpha, and the mean PSNR of the test views in dB; None if the scene has none."""

    renderer: Renderer
    trained: Optional[float]  # before, in its own blend
    shown: Optional[float]  # before, blended by alpha, as viewers do
    baked: Optional[float]


class FixedGaussians(Strategy):
    """Gaussians are neither added nor removed."""

    def __init__(self, context: StrategyContext, squares: float = 0.0) -> None:
        """squares: the weight of the squared error in place of L1, as at the end of `importance`; 0: L1."""
        super().__init__(context)
        self._squares = squares

    def squares(self, iteration: int) -> float:
        return self._squares


class RisingGate(FixedGaussians):
    """The background gate goes to 1 by the same factor in each step; then the blend is alpha."""

    def __init__(self, context: StrategyContext, squares: float = 0.0) -> None:
        super().__init__(context, squares)
        self.first = max(float(context.render.background_gate), LEAST_GATE)

    def after_step(self, step: Step) -> None:
        renderer, gate = self.context.render, self.gate(step.iteration)
        if gate != 1:
            renderer.background_gate = gate
        elif renderer.blend_mode != "alpha":
            renderer.blend_by("alpha", 1.0)

    def gate(self, iteration: int) -> float:
        """The gate of the step behind this iteration: 1 from the end of its rise on."""
        share = iteration / (RISE * self.context.config.iterations)
        return 1.0 if share >= 1 else math.exp((1 - share) * math.log(self.first))


class _Baking(Run):
    """A run of minutes, which writes neither checkpoints nor results."""

    @property
    def title(self) -> str:
        return "baking to alpha"

    def save_checkpoint(self) -> None:
        """Writes nothing; only raises if a checkpoint could not be written."""
        self._state()

    def _write_results(self) -> Dict[str, Any]:
        return {}


def bake(config: TrainConfig, renderer: Renderer, iterations: int, progress: bool = True,
         run: Optional[TrainConfig] = None) -> Baked:
    """Fine-tunes the renderer's Gaussians to alpha, by config's scene and options on config.device.

    Gaussians are neither added nor removed. In a mode without a background gate the whole training is in alpha. run:
    the model's; a line says if the scene is not the one that it was trained on. Raises TrainerError.
    """
    mode, gate = renderer.blend_mode, float(renderer.background_gate)
    if not viewer_warning({"blend_mode": mode, "background_gate": gate}):
        raise TrainerError("the model is blended by alpha already; leave out --bake")
    if iterations < 1:
        raise TrainerError(f"--bake-iterations is {iterations}; it must be at least 1")
    blend: Dict[str, Any] = {"blend_mode": "alpha"}
    if _takes_gate(mode):
        blend = {"blend_mode": mode, "background_gate": gate,
                 "faint_below": trained_faint_below(mode, renderer.faint_below)}
    squares = config.importance_options().squares if config.strategy == "importance" else 0.0
    config = config.changed(
        **blend, strategy="steady", densify_until_iter=0, budget=0, batch=1, iterations=iterations,
        sh_degree=renderer.model.sh_degree, position_lr_max_steps=iterations, eval_every=0,
        # Trained positions move little: they start at the geometric mean of the run's rates.
        position_lr_init=math.sqrt(config.position_lr_init * config.position_lr_final),
        position_lr_final=config.position_lr_final)
    scene = load_scene(config, progress, checksums=run is not None)
    note = compared(scene, run)[0] if run else ""
    if note:
        print(note, file=sys.stderr)
    trainer = Trainer(config, scene)
    shown = finite_rows(renderer.model.raw)  # the rasterizer leaves out the others, and so do the formats
    trainer.optimizer.replace_all({name: tensor.detach()[shown] for name, tensor in renderer.model.raw.items()})
    trainer.model.active_sh_degree = renderer.model.active_sh_degree
    strategy = RisingGate if _takes_gate(mode) else FixedGaussians
    trainer.strategy = strategy(trainer.strategy.context, squares)
    trained = _psnr(renderer, trainer)
    by_viewers = _psnr(_alpha(renderer, renderer.model), trainer)
    _Baking(trainer, progress).train()
    result = _alpha(renderer, trainer.model)
    return Baked(result, trained, by_viewers, _psnr(result, trainer))


def _takes_gate(mode: str) -> bool:
    try:
        resolve_background_gate(mode, 0.5)
    except ValueError:
        return False
    return True


def _alpha(renderer: Renderer, model: GaussianModel) -> Renderer:
    return Renderer(model, "alpha", renderer.background, renderer.antialiasing, background_gate=1.0)


def _psnr(renderer: Renderer, trainer: Trainer) -> Optional[float]:
    return evaluate(renderer, trainer.scene.test, trainer.config.device, passes=1).metrics["psnr"]
