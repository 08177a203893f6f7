"""How long a training on a processor will take, said as soon as its first steps show it."""
from __future__ import annotations

import time
from typing import Optional

from ..options.config import TrainConfig, flags_text
from ..options.presets import FAST
from ..options.short_run import FLAG, smaller_images
from ..scenes.scene import Scene

STEPS = 10  # that are measured, behind the first one, which is slower
ENOUGH_SECONDS = 20.0  # or as many steps as take so long
LONG_SECONDS = 900.0  # from which on a shorter training is proposed


class Forecast:
    """Call it after each step; it returns what to say once, else None."""

    def __init__(self, config: TrainConfig, scene: Scene) -> None:
        self.config = config
        camera = scene.train[0].camera
        count = len(scene.points.positions)
        self.removes = scene.start is not None and 0 < config.budget < count
        self.keeps = scene.start is not None and config.strategy == "importance" and config.budget == count
        smaller = smaller_images(camera.width, camera.height)
        is_short = self.removes or config.iterations <= FAST["cpu"].iterations and not smaller
        self.shorter = "" if is_short else f"{FLAG} {flags_text(smaller)}".rstrip()
        self.begun: Optional[float] = None
        self.first = 0
        self.said = False

    def __call__(self, iteration: int) -> Optional[str]:
        if self.said:
            return None
        now = time.monotonic()
        if self.begun is None:
            self.begun, self.first = now, iteration
            return None
        steps = (iteration - self.first) // self.config.batch
        if steps < STEPS and now - self.begun < ENOUGH_SECONDS:
            return None
        self.said = True
        left = self.config.iterations - iteration
        seconds = left * (now - self.begun) / (iteration - self.first)
        return self.text(left, seconds) if left else None

    def text(self, left: int, seconds: float) -> str:
        """left: iterations."""
        line = f"at this speed the other {left:,} iterations take about {duration(seconds)}"
        if not self.keeps:
            line += ", less and less as Gaussians are removed" if self.removes else ", longer as Gaussians are added"
        if seconds < LONG_SECONDS or not self.shorter:
            return line
        return f"{line}. A GPU takes minutes. For a result in minutes on this CPU add: --overwrite {self.shorter}"


def duration(seconds: float) -> str:
    """In words, to two digits or so."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"
