"""Ways to train and render a cell: the native trainer, and public trainers' checkouts."""
from __future__ import annotations

from typing import Any, Dict

from ..names import NATIVE
from .checkout import run_checkout
from .native import run_native
from .outcome import Outcome


def run(cell: Dict[str, Any], output: str) -> Outcome:
    return (run_native if cell["method"]["name"] == NATIVE else run_checkout)(cell, output)
