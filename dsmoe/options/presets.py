"""What `dsmoe train` chooses where nothing is given: how long, how many Gaussians, and `--fast` and `--best`."""
from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Collection, Dict, NamedTuple, Optional

from ..errors import ConfigError
from .config import TrainConfig

if TYPE_CHECKING:
    from ..scenes.layout import Layout

STRATEGY = "importance"


class Preset(NamedTuple):
    """Options in place of defaults; those that are given win."""

    iterations: int
    settings: str  # of --strategy-options
    parts: Dict[str, float] = {}  # options that are these parts of the iterations


class Numbers(NamedTuple):
    """How many Gaussians a scene gets."""

    per_point: int
    least: int
    most: int
    without_points: int  # where the first points are random, as their number says nothing of the scene
    most_points: int  # to start from


# Growth and removals are early: much is left to settle.
FAST = {"cuda": Preset(8400, "overshoot=1.5,removals=4,pace=10", {"densify_until_iter": 0.28}),
        "cpu": Preset(3000, "overshoot=1.5,removals=4", {"densify_until_iter": 0.35})}
BEST = Preset(60_000, "views=255")
PRESETS = {"fast": FAST, "best": {"cuda": BEST, "cpu": BEST}}
NUMBERS = {"cuda": Numbers(3, 20_000, 300_000, 200_000, 1_000_000),
           "cpu": Numbers(1, 10_000, 60_000, 20_000, 100_000)}

# By half of 3DGS's iterations fox, with 43 training views, gains 1.3 dB, and room35, with 30, loses 0.15 (alpha).
PER_VIEW, LEAST_ITERATIONS = 300, 15_000


def with_preset(options: Dict[str, Any], name: Optional[str], device: str) -> Dict[str, Any]:
    """The options of a training, and for those that are not given the preset's and the default strategy.

    name: in PRESETS, or None. Raises ConfigError if the preset is not of the given strategy.
    """
    options = {"strategy": STRATEGY, **options}
    if name is None:
        return options
    if options["strategy"] != STRATEGY:
        raise ConfigError(f"--strategy is {options['strategy']!r}; it must be left out or {STRATEGY} with --{name}")
    preset = PRESETS[name][device]
    iterations = options.get("iterations", preset.iterations)
    given = options.get("strategy_options", "")
    named = {part.partition("=")[0].strip() for part in given.split(",")}
    settings = [part for part in preset.settings.split(",") if part.partition("=")[0] not in named]
    parts = {name: max(2, round(part * iterations)) for name, part in preset.parts.items()}
    return {"iterations": iterations, **parts, **options,
            "strategy_options": ",".join(filter(None, [given, *settings]))}


def scheduled(options: Dict[str, Any]) -> TrainConfig:
    """The config of these options; milestones that they do not name keep their share of the iterations."""
    return dataclasses.replace(TrainConfig(**options).shortened(), **options)


def iterations_for_scene(options: Dict[str, Any], layout: Layout) -> int:
    """How long to train. options: those that are not to be chosen. layout: the scene's.

    On fox, by alpha, 30,000 iterations were worse than 15,000 with the scene's own number of Gaussians, and seeds
    differed by 0.6 dB. With a tenth or a third of it they differ by 0.05 or 0.13, and 15,000 were not measured, so a
    smaller budget keeps 30,000. So does one that growth in fewer iterations does not reach. Who moves the end of growth
    and removals means a part of 30,000.
    """
    from ..training.importance_strategy import reached_from

    config = scheduled(options)
    if config.init or {"iterations", "densify_until_iter"} & {*options}:
        return config.iterations
    wanted = max(LEAST_ITERATIONS, PER_VIEW * len(layout.train))
    shorter = scheduled({**options, "iterations": min(config.iterations, -(-wanted // config.batch) * config.batch)})
    points = _points(config, options, layout)
    reached = reached_from(shorter, points)
    is_usual = not config.budget or min(_number(config, layout, points), reached) <= config.budget <= reached
    return shorter.iterations if is_usual else config.iterations


def chosen_for_scene(config: TrainConfig, given: Collection[str], layout: Layout) -> Dict[str, Any]:
    """Options that depend on the scene, of those whose names are not given. layout: the scene's."""
    from ..starting import read_start
    from ..training.importance_strategy import reached_from

    if config.init:  # it keeps its number
        return {} if config.budget else {"budget": read_start(config.init).count}
    points = _points(config, given, layout)
    chosen: Dict[str, Any] = {}
    if points < layout.points.size_of_subset(config.init_points):
        chosen["init_points"] = points
    if not config.budget:
        chosen["budget"] = min(_number(config, layout, points), reached_from(config, points))
    return chosen


def _points(config: TrainConfig, given: Collection[str], layout: Layout) -> int:
    """How many points to start from."""
    points = layout.points.size_of_subset(config.init_points)
    bounded = layout.points.measured and "init_points" not in given
    return min(points, NUMBERS[config.device].most_points) if bounded else points


def _number(config: TrainConfig, layout: Layout, points: int) -> int:
    """How many Gaussians a scene gets of which so many points are taken, if growth reaches them."""
    numbers = NUMBERS[config.device]
    if not layout.points.measured:
        return numbers.without_points
    return min(max(numbers.per_point * points, numbers.least), numbers.most)
