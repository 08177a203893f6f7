"""The examples of integrations/README.md run, in their order and in one namespace, and give what their text says."""
from __future__ import annotations

import re
from pathlib import Path

import torch

from diff_smoe_rasterization.integrations.contracts import CONTRACTS

README = Path(__file__).resolve().parents[3] / "diff_smoe_rasterization" / "integrations" / "README.md"


def test_the_examples_run():
    text = README.read_text(encoding="utf-8")
    preamble, *flavours = re.split(r"^## ([\w, ]+)$", text, flags=re.MULTILINE)
    names, sections = flavours[::2], flavours[1::2]
    assert names == ["inria", "inria_2024", "depth, depth_alpha", "More than images", "taming", "c3dgs", "scaffold",
                     "gsplat", "Which projects"]
    torch.manual_seed(0)
    variables = {}
    example = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    exec(example.search(preamble).group(1), variables)
    for name, section in zip(names[:-1], sections):
        code, = example.findall(section)
        exec(code, variables)
        if name == "gsplat":
            assert variables["renders"].shape == (2, 48, 64, 4) and variables["alphas"].max() > 0.1
            # The same scene through two APIs; float32 sums of some hundred terms, some of whose pairs lie at a cut-off.
            difference = variables["renders"][0, ..., :3].permute(2, 0, 1) - variables["from_inria"]
            assert difference.abs().mean() < 1e-4
        else:
            assert variables["color"].shape == (3, 48, 64) and variables["color"].max() > 0.1
            assert (variables["radii"] > 0).any()
        if name == "taming":
            assert len(variables["accum_weights"]) == 500 and variables["accum_blend"].sum() > 1
            assert ((variables["accum_count"] > 0) <= (variables["radii"] > 0)).all()
        if name == "More than images":  # 1e-3: float32 sums of some hundred terms
            signed, absolute = variables["signed"].abs(), variables["absolute"]
            assert (absolute > 0.999 * signed - 1e-3).all() and signed.any()
        if name == "inria":
            variables["from_inria"] = variables["color"]
        if name == "depth, depth_alpha":
            assert (variables["over_white"] >= variables["color"]).all() and variables["depth"].max() > 1
        if name == "c3dgs":
            used = torch.zeros(40, dtype=torch.bool).index_fill(0, variables["sh_indices"], True)
            assert torch.equal(variables["sh_codebook"].grad.flatten(1).any(1), used)
        if name == "inria_2024":
            assert (variables["dc"] != variables["shs"][:, :1]).any() and variables["inverse_depth"].max() > 0.1


def test_the_table_is_that_of_the_contracts():
    rows = {cells[2].strip(" `"): cells for cells in (line.split("|") for line in README.read_text().splitlines())
            if len(cells) == 5}
    for contract in CONTRACTS:
        _, used_by, _, results, _ = rows[contract.name]
        assert used_by.strip() == contract.used_by
        assert contract.name == "taming" or results.strip().startswith(", ".join(contract.results))
