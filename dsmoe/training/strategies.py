"""The strategies by the name that --strategy takes."""
from __future__ import annotations

from typing import Dict, Type

from .gate_strategy import GateStrategy
from .mcmc_strategy import MCMCStrategy
from .strategy import SteadyStrategy, Strategy, ThreeDGSStrategy

STRATEGIES: Dict[str, Type[Strategy]] = {
    "3dgs": ThreeDGSStrategy, "steady": SteadyStrategy, "gate": GateStrategy, "mcmc": MCMCStrategy}
