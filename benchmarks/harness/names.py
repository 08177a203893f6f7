"""The names of what a suite may ask for, and of the files in RESULTS; the Snakefile repeats the latter."""
from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Mapping, Sequence, Union

from diff_smoe_rasterization.settings import EVERYWHERE, GATED_MODES, PAPER, PAPER_PROGRAM

from ..options.config import RECIPE as TRAINER_RECIPE
from .errors import BenchError

SHIPPED = {path.stem: str(path) for path in Path(__file__).with_name("shipped").glob("*.yaml")}  # suites, by name
SCENES = {path.stem: str(path) for path in Path(__file__).with_name("shipped").glob("scenes/*.yaml")}
# The axes of a suite (schema.py), and what a cell calls its value.
AXIS_OF = {"blend_modes": "blend_mode", "background_gates": "background_gate", "faint_belows": "faint_below",
           "densify_grad_thresholds": "densify_grad_threshold", "strategies": "strategy", "budgets": "budget",
           "seeds": "seed"}
UNSAID = {"faint_below": None, "budget": 0}  # what cells without such a field have; their names are older than it
SELECTORS = ("method", "scene", *AXIS_OF.values(), "headline")  # fields by which `--only` chooses cells
NATIVE = "native"
LPIPS_KINDS = ("lpips_vgg_inria", "lpips_vgg_std", "lpips_alex")
VARIANTS = ("native", "unpatched", "patched", "fused")  # fused: by a patch with --fuse
# Of each public trainer, whether it can be patched to this package's rasterizer (patches).
CHECKOUTS = {"3dgs-2023": True, "3dgs-2024": True, "taming": True, "c3dgs": True, "compact-3dgs": True, "hac": True,
             "hac-plus": True, "2dgs": False, "dbs": False}
WITHOUT_STRATEGY = ("hac", "hac-plus", "dbs")  # they grow and prune by rules of their own
COUNTED_BY = {"taming": "--budget", "dbs": "--cap_max"}  # they are given a number of primitives, and have no threshold
NEEDS = {"dbs": "--cap_max"}  # an argument without which a method has no size
OF_NATIVE_ALONE = ("strategy_options",)
# Options of the recipe that a trainer has no flag for, or whose flag does nothing or means something else in it.
OF_3DGS_ALONE = ("antialiasing", "feature_lr", "percent_dense", "opacity_reset_interval")
LACKS = {"3dgs-2023": ("antialiasing",), "3dgs-2024": (), "c3dgs": ("antialiasing",), "2dgs": ("antialiasing",),
         "taming": ("antialiasing", "feature_lr"),  # it has a second rate for the higher SH bands
         "dbs": OF_3DGS_ALONE, "compact-3dgs": ("antialiasing", "sh_degree"),  # its colours are of degree 0
         **dict.fromkeys(("hac", "hac-plus"), (*OF_3DGS_ALONE, "sh_degree", "sh_degree_interval", "opacity_lr",
                                               "rotation_lr", "densify_from_iter", "densify_until_iter",
                                               "densification_interval"))}

# In RESULTS:
ROWS_NAME = "rows.jsonl"  # all rows, one a line
CELLS_FOLDER = "cells"  # a folder for each cell, by its name
CELL_NAME = "cell.json"  # in it: what is trained on what
ROW_NAME = "row.json"  # in it too: what came out
SUITE_NAME = "suite.json"  # its name, its protocol, and the names of all its cells, run or not

# Options of the native trainer's schedule, which a suite may set. The others have a field of their own.
RECIPE = (*TRAINER_RECIPE, "strategy_options")

# LPIPS's weights, .npz: conv1.weight [outputs, inputs, h, w], conv1.bias, ..., lin0.weight, ..., lin4.weight.
VARIABLES = {"vgg": "DSMOE_LPIPS_VGG", "alex": "DSMOE_LPIPS_ALEX"}


def read_json(path: Union[str, Path]) -> Any:
    return json.loads(Path(path).read_text(encoding="utf-8"))


def blend_of(row: Mapping[str, Any]) -> str:
    """Such as "smoe 0.05", "smoe learned" or "smoe paper"; rows that say no gate are of 0."""
    mode, gate, faint = row["blend_mode"], row.get("background_gate") or 0, row.get("faint_below")
    if is_paper(row):
        return f"{mode} {PAPER}"
    if mode not in GATED_MODES:
        return mode
    said = [mode, *([] if gate == 0 else [gate if isinstance(gate, str) else format(gate, "g")])]
    return " ".join([*said, *([] if faint is None else ["all" if faint >= EVERYWHERE else f"below {faint:g}"])])


def is_paper(row: Mapping[str, Any]) -> bool:
    """Whether a row or a cell is of the program of the paper's authors."""
    return all(row.get(name) == value for name, value in PAPER_PROGRAM.items())


def net_of(kind: str) -> str:
    return "alex" if kind == "lpips_alex" else "vgg"


def check_weights(kinds: Sequence[str]) -> None:
    """Raises BenchError if a variable names a file of weights that is wanted and not there."""
    for kind in kinds:
        variable = VARIABLES[net_of(kind)]
        if os.environ.get(variable) and not os.path.isfile(os.environ[variable]):
            raise BenchError(f"{variable}: {os.environ[variable]}: no such file, where the weights of {kind} must be; "
                             "name it, or unset the variable to have torchmetrics download them")
