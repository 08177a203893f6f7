"""The trainers that can be patched, as a table. It has names and structure, no line of a trainer; needs no LibCST.

A checkout is the first trainer of TRAINERS one of whose signs it shows; facts.py says what signs are.
"""
from __future__ import annotations

from typing import NamedTuple, Tuple

RASTERIZER = "diff_gaussian_rasterization"
PACKAGE = "diff_smoe_rasterization"
INTEGRATIONS = f"{PACKAGE}.integrations"
RUNTIME = f"{PACKAGE}.patches.runtime"
GR = "gaussian_renderer/__init__.py"

RIGHT = {  # of each kind of rule, what it looks for
    "import-rasterizer": f"`from {RASTERIZER} import ...`",
    "settings-blend-mode": "a call of GaussianRasterizationSettings by keyword, in a function whose pipeline argument "
                           "it names in `debug=pipe.debug`",
    "model-parameter": "a class ModelParams whose __init__ has the statement `super().__init__(...)`",
    "pipe-blend-mode": "a function {function} with the parameters {dataset} and {pipe}",
}


class Rule(NamedTuple):
    """What has to change in one file of a checkout; codemods.py says how."""

    name: str  # one of RIGHT
    file: str  # relative to the checkout
    flavour: str = ""  # module of integrations
    function: str = ""  # the one that is given both groups of options, under these names:
    dataset: str = "dataset"
    pipe: str = "pipe"
    expected: int = 1  # how often it matches
    least: int = 1  # 0 where some of the trainer's versions have no such statement

    @property
    def right(self) -> str:
        return RIGHT[self.name].format(**self._asdict())


class Trainer(NamedTuple):
    """A trainer that can be patched."""

    name: str  # as in --trainer
    flavour: str  # module of integrations whose API it calls
    signs: Tuple[str, ...]  # it shows one of these ("... and ...")
    entries: Tuple[Rule, ...]  # everything that renders is called from there
    results: int = 2  # how many its rasterizer returns
    settings: int = 1  # how many calls of GaussianRasterizationSettings its renderer has
    imports: Tuple[str, ...] = (GR,)  # where it imports the rasterizer
    may_import: Tuple[str, ...] = ()  # where some of its versions do

    @property
    def rules(self) -> Tuple[Rule, ...]:
        return (*(Rule("import-rasterizer", file, self.flavour) for file in self.imports),
                Rule("settings-blend-mode", GR, least=self.settings, expected=self.settings),
                # Of the groups of options only ModelParams is saved in cfg_args.
                Rule("model-parameter", "arguments/__init__.py"),
                *(Rule("import-rasterizer", file, self.flavour, least=0) for file in self.may_import), *self.entries)


def entry(file: str, function: str, **names: str) -> Rule:
    return Rule("pipe-blend-mode", file, function=function, **names)


TRAINING = entry("train.py", "training")
RENDERING = entry("render.py", "render_sets", pipe="pipeline")
RENDERING_IN_TRAIN = entry("train.py", "render_sets", pipe="pipeline")

TRAINERS = (
    # HAC (Chen et al. 2024) and HAC++ (2025) on Scaffold-GS (Lu et al. 2024): the second settings are those of
    # prefilter_voxel, as which radii are 0 depends on the mode.
    Trainer("hac-plus", "scaffold",
            ("imports gpcc_utils", "calls visible_filter and imports encodings and imports lpips"),
            (TRAINING, RENDERING_IN_TRAIN), settings=2),
    Trainer("hac", "scaffold", ("calls visible_filter and imports encodings",),
            (TRAINING, RENDERING_IN_TRAIN), settings=2),
    Trainer("scaffold-gs", "scaffold", ("calls visible_filter",),
            (TRAINING, RENDERING_IN_TRAIN, RENDERING), settings=2),
    # Compressed 3DGS (Niedermayr et al. 2024) trains no model: it compresses one, whose cfg_args brings the mode.
    Trainer("c3dgs", "c3dgs", ("imports GaussianRasterizerIndexed", "sets clamp_color"),
            (entry("compress.py", "run_vq", dataset="model_params", pipe="pipeline_params"), RENDERING)),
    # Taming 3DGS (Mallick et al. 2024) scores by renderings through the pipeline that `training` was given.
    Trainer("taming", "taming", ("sets pixel_weights",), (TRAINING, RENDERING), results=13,
            imports=(GR, "scene/gaussian_model.py")),
    # 3DGS (Kerbl et al. 2023) of 2024. Whoever imports SparseGaussianAdam (since October) and whoever renders have to
    # agree on the package.
    Trainer("3dgs-2024", "inria_2024", ("sets antialiasing", "imports SparseGaussianAdam",
                                        "unpacks 3 results and reads invdepthmap"),
            (TRAINING, RENDERING), results=3, may_import=("train.py", "render.py", "scene/gaussian_model.py")),
    Trainer("3dgs-2023", "inria", ("imports GaussianRasterizationSettings",), (TRAINING, RENDERING)),
)


def names() -> Tuple[str, ...]:
    """The names of the trainers."""
    return tuple(sorted(trainer.name for trainer in TRAINERS))
