"""The Gaussians that a viewer shows: a trained model, or the last checkpoint of a training that goes on."""
from __future__ import annotations

import os
from typing import Any, List, Optional, Tuple

from ..errors import TrainerError
from ..inspection import Trained, open_trained, places
from ..options.config import CHECKPOINT_NAME, TrainConfig, holds_run
from ..results.modelfile import model_path
from ..results.rendering import Renderer, background_color
from ..scenes.cameras import Camera
from ..scenes.orbit import Orbit
from ..system.device import check_device
from ..system.files import is_file
from ..training.checkpoint import made_so_far


class Followed:
    """A model; of a run, `poll` takes over what a training has written since."""

    renderer: Renderer
    cameras: List[Camera]
    orbit: Orbit
    progress: str  # of a training, in words

    def __init__(self, source: str, blend_mode: Optional[str] = None, background_gate: Optional[float] = None,
                 device: str = "cpu", faint_below: Optional[float] = None, **options: Any) -> None:
        """Arguments as in `open_trained`. Raises TrainerError, also if a run has no checkpoint yet."""
        self._arguments = (source, blend_mode, background_gate, device, faint_below)
        self._options = options
        self._config: Optional[TrainConfig] = None  # of the run that is shown
        self._seen: Optional[Tuple[str, int]] = None  # the file that is shown, and when it was written
        self._is_run = holds_run(source)
        check_device(device)
        if self._is_run:
            self.poll()
        else:
            self._take(open_trained(*self._arguments, **options))

    def poll(self) -> bool:
        """Looks for a newer checkpoint, the end, or another run in the folder; returns whether there is one.

        What was shown stays if this raises: TrainerError, or what a file that is being replaced causes.
        """
        if not self._is_run:
            return False
        config = TrainConfig.load(self._arguments[0]).changed(**self._options)
        newest = self._newest(config)
        if (config, newest) == (self._config, self._seen):
            return False
        if newest[0] == CHECKPOINT_NAME:
            self._take_checkpoint(config)
        else:
            self._take(open_trained(*self._arguments, **self._options))
            self.progress = f"trained, {config.iterations:,} iterations"
        self._config, self._seen = config, newest
        return True

    def _newest(self, config: TrainConfig) -> Tuple[str, int]:
        """The file in the run's folder that has the Gaussians, and when it was written."""
        for name in (model_path("", config.iterations), CHECKPOINT_NAME):
            path = os.path.join(config.output, name)
            if is_file(path):
                return name, os.stat(path).st_mtime_ns
        raise TrainerError(f"{path}: no such file yet; the training writes it every --checkpoint-every "
                           f"{config.checkpoint_every} iterations")

    def _take(self, trained: Trained) -> None:
        self.renderer, self.cameras, self.orbit = trained.renderer, trained.cameras, trained.orbit
        self.progress = ""

    def _take_checkpoint(self, config: TrainConfig) -> None:
        device = self._arguments[3]
        so_far = made_so_far(config, device)
        renderer = Renderer(so_far.model, str(config.blend_mode), background_color(config.white_background, device),
                            config.antialiasing, background_gate=so_far.background_gate,
                            faint_below=config.unusual_faint)
        if config != self._config:
            self.cameras, self.orbit = places(config, so_far.model, needed="scene" in self._options)
        self.renderer = renderer
        self.progress = f"training, iteration {so_far.iteration:,} of {config.iterations:,}"
