"""The kinds of rule, as plain data: names and structure. codemods.py says how each is carried out.

`file` is relative to the checkout, `expected` is how often the rule has to match there.
"""
from __future__ import annotations

from typing import NamedTuple, Tuple

RASTERIZER = "diff_gaussian_rasterization"
PACKAGE = "diff_smoe_rasterization"
INTEGRATIONS = f"{PACKAGE}.integrations"
RUNTIME = f"{PACKAGE}.patches.runtime"


class ImportRasterizer(NamedTuple):
    """`from diff_gaussian_rasterization import ...` imports the same names from a module of ours."""

    file: str
    flavour: str
    expected: int = 1
    least: int = 1  # 0 where some of the trainer's versions have no such import
    name = "import-rasterizer"

    @property
    def right(self) -> str:
        return f"`from {RASTERIZER} import ...`"


class SettingsBlendMode(NamedTuple):
    """The settings call gets `**pipe.blend`; `pipe` is what its `debug=pipe.debug` names."""

    file: str
    expected: int = 1
    name = "settings-blend-mode"

    @property
    def right(self) -> str:
        return ("a call of GaussianRasterizationSettings by keyword, in a function whose pipeline argument it names in "
                "`debug=pipe.debug`")


class ModelParameter(NamedTuple):
    """ModelParams gets a statement that makes the options --blend_mode and --background_gate of two attributes.

    ModelParams, because of the groups of parameters it alone is saved in cfg_args.
    """

    file: str
    expected: int = 1
    name = "model-parameter"

    @property
    def right(self) -> str:
        return "a class ModelParams whose __init__ has the statement `super().__init__(...)`"


class PipeBlendMode(NamedTuple):
    """The function that gets both groups begins with `pipe.blend = blend_of(dataset)`."""

    file: str
    function: str
    dataset: str = "dataset"
    pipe: str = "pipe"
    expected: int = 1
    name = "pipe-blend-mode"

    @property
    def right(self) -> str:
        return f"a function {self.function} with the parameters {self.dataset} and {self.pipe}"


class Trainer(NamedTuple):
    """A trainer that can be patched."""

    name: str  # as in --trainer
    flavour: str  # module of integrations whose API it calls
    signs: Tuple[str, ...]  # it shows one of these ("... and ..."), as facts.py says it, and none of those before it
    rules: Tuple[NamedTuple, ...]
    results: int = 2  # how many its rasterizer returns


GR = "gaussian_renderer/__init__.py"


def shared_rules(flavour: str, imports: Tuple[str, ...] = (GR,), settings_calls: int = 1) -> Tuple[NamedTuple, ...]:
    """The rules of what all trainers have: imports in the given files, the settings calls, ModelParams."""
    return (*(ImportRasterizer(file, flavour) for file in imports), SettingsBlendMode(GR, settings_calls),
            ModelParameter("arguments/__init__.py"))
