"""The Gaussians that a viewer shows: a trained model, or the last checkpoint of a training that goes on."""
from __future__ import annotations

import os
from typing import Any, List, Optional

from ..trainer.config import LEARNED, TrainConfig
from ..trainer.errors import TrainerError
from ..trainer.model import GaussianModel
from ..trainer.opening import open_trained, places
from ..trainer.results.modelfile import model_path
from ..trainer.results.rendering import Renderer, background_color
from ..trainer.scenes.cameras import Camera
from ..trainer.scenes.orbit import Orbit
from ..trainer.system.files import is_file, is_folder
from ..trainer.training.background_gate import LearnedGate
from ..trainer.training.checkpoint import CHECKPOINT_NAME, load_checkpoint
from ..trainer.training.loop import check_device


class Followed:
    """A model by its run's folder or its .ply; `poll` takes over what a training has written since."""

    renderer: Renderer
    cameras: List[Camera]
    orbit: Orbit
    progress: str  # of a training, in words

    def __init__(self, source: str, blend_mode: Optional[str] = None, background_gate: Optional[float] = None,
                 device: str = "cpu", **options: Any) -> None:
        """Arguments as in `open_trained`. Raises TrainerError, also where a run has no checkpoint yet."""
        self._arguments = (source, blend_mode, background_gate, device)
        self._options = options
        self._seen: Optional[float] = None  # when the checkpoint was written that is shown; None: the run has ended
        check_device(device)
        self._config = TrainConfig.load(source).changed(**options) if is_folder(source) else None
        if self._config is None or self._has_ended():
            self._show_trained()
        else:
            self._show_checkpoint(self._checkpoint_time())
            self.cameras, self.orbit = places(self._config, self.renderer.model, needed="scene" in options)

    def poll(self) -> bool:
        """Looks for a newer checkpoint, or the end; returns whether the Gaussians have changed."""
        if self._seen is None:
            return False
        if self._has_ended():
            self._show_trained()
            return True
        time = self._checkpoint_time()
        if time == self._seen:
            return False
        self._show_checkpoint(time)
        return True

    def _has_ended(self) -> bool:
        return is_file(model_path(self._config.output, self._config.iterations))

    def _checkpoint_time(self) -> float:
        path = os.path.join(self._config.output, CHECKPOINT_NAME)
        if not is_file(path):
            raise TrainerError(f"{path}: no such file yet; the training writes it every --checkpoint-every "
                               f"{self._config.checkpoint_every} iterations")
        return os.stat(path).st_mtime

    def _show_trained(self) -> None:
        trained = open_trained(*self._arguments, **self._options)
        self._seen = None
        self.renderer, self.cameras, self.orbit = trained.renderer, trained.cameras, trained.orbit
        self.progress = "" if self._config is None else f"trained, {self._config.iterations:,} iterations"

    def _show_checkpoint(self, time: float) -> None:
        config, device = self._config, self._arguments[-1]
        state = load_checkpoint(os.path.join(config.output, CHECKPOINT_NAME), device)
        model = GaussianModel(state["raw"], config.sh_degree)
        model.active_sh_degree = state["active_sh_degree"]
        if config.background_gate == LEARNED:
            learned = LearnedGate(config, device)
            learned.load_state_dict(state["gate"])
            gate = float(learned.value)
        else:
            gate = float(config.background_gate)
        self.renderer = Renderer(model, str(config.blend_mode), background_color(config.white_background, device),
                                 config.antialiasing, background_gate=gate)
        self.progress = f"training, iteration {state['iteration']:,} of {config.iterations:,}"
        self._seen = time
