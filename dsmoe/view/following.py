"""The Gaussians that a viewer shows: a trained model, or the last checkpoint of a training that goes on."""
from __future__ import annotations

import os
from typing import Any, List, Optional, Tuple

from ..errors import TrainerError
from ..inspection import Trained, open_checkpoint, open_trained, places
from ..options.config import CHECKPOINT_NAME, TrainConfig, holds_run
from ..results.modelfile import model_path
from ..results.rendering import Renderer
from ..scenes.cameras import Camera
from ..scenes.orbit import Orbit
from ..system.device import check_device
from ..system.files import is_file


class Followed:
    """A model; of a run, `poll` takes over what a training has written since."""

    renderer: Renderer
    cameras: List[Camera]
    orbit: Orbit
    progress: str  # of a training, in words

    def __init__(self, source: str, blend_mode: Optional[str] = None, background_gate: Optional[float] = None,
                 device: str = "cpu", faint_below: Optional[float] = None, **options: Any) -> None:
        """Arguments as in `open_trained`. Raises TrainerError, also if a run has no checkpoint yet."""
        self._source, self._device = source, device
        self._blend_mode, self._background_gate, self._faint_below = blend_mode, background_gate, faint_below
        self._options = options
        self._config: Optional[TrainConfig] = None  # of the run that is shown
        self._seen: Optional[Tuple[str, int]] = None  # the file that is shown, and when it was written
        self._is_run = holds_run(source)
        check_device(device)
        if self._is_run:
            self.poll()
        else:
            self._take(self._opened())

    def poll(self) -> bool:
        """Looks for a newer checkpoint, the end, or another run in the folder; returns whether there is one.

        What was shown stays if this raises: TrainerError, or what a file that is being replaced causes.
        """
        if not self._is_run:
            return False
        config = TrainConfig.load(self._source).changed(**self._options)
        newest = self._newest(config)
        if (config, newest) == (self._config, self._seen):
            return False
        if newest[0] == CHECKPOINT_NAME:
            self._take_checkpoint(config)
        else:
            self._take(self._opened())
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

    def _opened(self) -> Trained:
        return open_trained(self._source, self._blend_mode, self._background_gate, self._device, self._faint_below,
                            **self._options)

    def _take(self, trained: Trained) -> None:
        self.renderer, self.cameras, self.orbit = trained.renderer, trained.cameras, trained.orbit
        self.progress = ""

    def _take_checkpoint(self, config: TrainConfig) -> None:
        renderer, so_far = open_checkpoint(config, self._blend_mode, self._background_gate, self._device,
                                           asked_faint=self._faint_below)
        if config != self._config:
            self.cameras, self.orbit = places(config, so_far.model, needed="scene" in self._options)
        self.renderer = renderer
        self.progress = f"training, iteration {so_far.iteration:,} of {config.iterations:,}"
