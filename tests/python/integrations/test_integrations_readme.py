"""The table of integrations/README.md."""
from __future__ import annotations

from pathlib import Path

from diff_smoe_rasterization.integrations.contracts import CONTRACTS

README = Path(__file__).resolve().parents[3] / "integrations" / "README.md"


def test_the_table_is_that_of_the_contracts():
    rows = {cells[2].strip(" `"): cells for cells in (line.split("|") for line in README.read_text().splitlines())
            if len(cells) == 5}
    for contract in CONTRACTS:
        _, used_by, _, results, _ = rows[contract.name]
        assert used_by.strip() == contract.used_by
        assert contract.name == "taming" or results.strip().startswith(", ".join(contract.results))
