"""`dsmoe train --fast`: a preset of the strategy `importance` for a result in seconds."""
from __future__ import annotations

from typing import Any, Dict

from .config import TrainConfig
from .errors import ConfigError

ITERATIONS = 7000
UNTIL = 0.35  # growth and removals take this part of the iterations, so that much is left to settle and to average
SETTINGS = "overshoot=1.5,removals=4"
# Without --budget: so many Gaussians for each point to start from, within these bounds.
PER_POINT = 3
LEAST, MOST = 20_000, 300_000


def with_preset(options: Dict[str, Any]) -> Dict[str, Any]:
    """The options of a training and, of those that are not given, the preset's; the budget is 0 if none is given.

    Raises ConfigError if another strategy is given.
    """
    strategy = options.get("strategy", "importance")
    if strategy != "importance":
        raise ConfigError(f"--strategy is {strategy!r}; it must be left out or importance with --fast")
    iterations = options.get("iterations", ITERATIONS)
    given = options.get("strategy_options", "")
    named = {part.partition("=")[0].strip() for part in given.split(",")}
    settings = [part for part in SETTINGS.split(",") if part.partition("=")[0] not in named]
    return {"iterations": iterations, "densify_until_iter": max(2, round(UNTIL * iterations)), **options,
            "strategy": strategy, "strategy_options": ",".join(filter(None, [given, *settings]))}


def budget_of(config: TrainConfig) -> int:
    """How many Gaussians the scene gets without --budget. Raises SceneError if it cannot be read."""
    from .scenes.scene import read_layout

    points = len(read_layout(config).points.subset(config.init_points, config.seed).positions)
    return min(max(PER_POINT * points, LEAST), MOST)
