"""The examples of integrations/README.md run, in their order and in one namespace, and give what their text says."""
from __future__ import annotations

import re
from pathlib import Path

import torch

from diff_smoe_rasterization.integrations.contracts import CONTRACTS

README = Path(__file__).resolve().parents[3] / "integrations" / "README.md"


def test_the_examples_run():
    text = README.read_text(encoding="utf-8")
    preamble, *flavours = re.split(r"^## ([\w, ]+)$", text, flags=re.MULTILINE)
    names, sections = flavours[::2], flavours[1::2]
    assert names == ["inria", "Any combination", "gsplat", "Which projects"]
    torch.manual_seed(0)
    variables = {}
    example = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    exec(example.search(preamble).group(1), variables)
    for name, section in zip(names, sections):
        examples = example.findall(section)
        assert len(examples) == (name in ("inria", "gsplat"))
        for code in examples:
            exec(code, variables)
        if name == "gsplat":
            assert variables["renders"].shape == (2, 48, 64, 4) and variables["alphas"].max() > 0.1
            # The same scene through two APIs; float32 sums of some hundred terms, some of whose pairs lie at a cut-off.
            difference = variables["renders"][0, ..., :3].permute(2, 0, 1) - variables["from_inria"]
            assert difference.abs().mean() < 1e-4
        else:
            assert variables["color"].shape == (3, 48, 64) and variables["color"].max() > 0.1
            assert (variables["radii"] > 0).any()
        if name == "inria":
            variables["from_inria"] = variables["color"]


def test_the_table_is_that_of_the_contracts():
    rows = {cells[2].strip(" `"): cells for cells in (line.split("|") for line in README.read_text().splitlines())
            if len(cells) == 5}
    for contract in CONTRACTS:
        _, used_by, _, results, _ = rows[contract.name]
        assert used_by.strip() == contract.used_by
        assert contract.name == "taming" or results.strip().startswith(", ".join(contract.results))
