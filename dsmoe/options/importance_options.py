"""What `--strategy-options` may set of the strategy `importance`, and in which ranges."""
from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Any, Callable, Dict

from ..errors import ConfigError


def _setting(default: Any, holds: Callable[[Any], bool], requirement: str) -> Any:
    return dataclasses.field(default=default, metadata={"holds": holds, "requirement": requirement})


@dataclass(frozen=True)
class ImportanceOptions:
    """Settings of the strategy `importance`."""

    # Growth ends at so many times the budget; 0: wherever the threshold leads.
    overshoot: float = _setting(10.0, lambda x: x == 0 or x >= 1, "0 or at least 1")
    # Steps down to the budget.
    removals: int = _setting(16, lambda x: 1 <= x <= 1000, "at least 1 and at most 1000")
    # Training views that a decision looks at.
    views: int = _setting(80, lambda x: x >= 1, "at least 1")
    # The most Gaussians that move at a time, as a part of all; 0: none.
    moves: float = _setting(0.1, lambda x: 0 <= x <= 1, "between 0 and 1")
    # Moves are this part of densify_until_iter apart: one over the number.
    pace: int = _setting(30, lambda x: 1 <= x <= 1000, "at least 1 and at most 1000")
    # A Gaussian moves if its cost is below this part of the error at its new place.
    worth: float = _setting(0.2, lambda x: x >= 0, "at least 0")
    # The learning rate of the higher SH bands is so many times that of the recipe.
    bands: float = _setting(2.0, lambda x: x > 0, "above 0")
    # What fewer than so many training views need is removed and moved first; 0: only what costs least.
    needs: int = _setting(3, lambda x: x >= 0, "at least 0")
    # Nearer to a camera than this part of the distance from where its points begin nothing stays; 0: anything may.
    near: float = _setting(0.5, lambda x: 0 <= x <= 1, "between 0 and 1")
    # Behind the moves all learning rates but the positions' fall to this part of themselves.
    anneal: float = _setting(1.0, lambda x: x > 0, "above 0")
    # There too the loss has so many times the squared error in place of the absolute one; 0: it keeps that one. With 30
    # both pull alike if they differ by 1/60.
    squares: float = _setting(30.0, lambda x: x >= 0, "at least 0")
    # At the end the model is a running average over about this part of densify_until_iter; 0: none.
    average: float = _setting(0.13, lambda x: x >= 0, "at least 0")


@functools.lru_cache(maxsize=None)
def parse_importance_options(text: str) -> ImportanceOptions:
    """The settings from `NAME=X,...`; what is not named keeps its default.

    Raises ConfigError with the name, the value and what it must be.
    """
    known = {option.name: option for option in dataclasses.fields(ImportanceOptions)}
    values: Dict[str, Any] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.strip().partition("=")
        if name not in known:
            raise ConfigError(f"--strategy-options: {name!r} is unknown; it may name {', '.join(known)}")
        if name in values:
            raise ConfigError(f"--strategy-options: {name} stands there twice; it must stand there once")
        kind, requirement = type(known[name].default), known[name].metadata["requirement"]
        try:
            values[name] = kind(value)
            if not abs(values[name]) < math.inf:
                raise ValueError(value)
        except ValueError as error:
            what = "a whole number" if kind is int else "a finite number"
            raise ConfigError(f"--strategy-options: {name} is {value!r}; it must be {what}, {requirement}") from error
        if not known[name].metadata["holds"](values[name]):
            raise ConfigError(f"--strategy-options: {name} is {value}; it must be {requirement}")
    return ImportanceOptions(**values)


def importance_settings(options: ImportanceOptions) -> str:
    """All settings, as `parse_importance_options` takes them."""
    return ",".join(f"{name}={value:.12g}" for name, value in dataclasses.asdict(options).items())
