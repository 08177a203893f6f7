"""patches/README.md has every trainer, rule and state, under the names that the program uses."""
from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[3] / "patches" / "README.md"


def rows():
    """The cells of the tables' rows, by their first cell."""
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in README.read_text().splitlines()
             if line.startswith("| `")]
    return {row[0].strip(" `|"): row for row in cells}


def test_trainers_rules_and_states_are_in_it():
    pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")
    from diff_smoe_rasterization.patches import engine
    from diff_smoe_rasterization.patches.patch import OPTIONS
    from diff_smoe_rasterization.patches.trainers import TRAINERS

    table = rows()
    for trainer in TRAINERS:
        row = table[trainer.name]
        assert f"`{trainer.flavour}`" in row[2]
        assert {rule.name for rule in trainer.rules} <= set(table)
        if trainer.name != "hac-plus":  # "the same"
            functions = {rule.function for rule in trainer.rules if rule.name == "pipe-blend-mode"}
            assert functions == set(re.findall(r"`(\w+)`", row[3]))
    for option, optional_rules in OPTIONS.items():
        assert f"## --{option}\n" in README.read_text()
        assert {rule.name for rule in optional_rules} <= set(table)
    assert all(state in README.read_text() for state in engine.STATES)
