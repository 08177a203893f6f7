"""The trainers that can be patched, as a table: names and structure, no line of their code.

A checkout is recognised as the first entry of TRAINERS whose rasterizer it calls and whose signs it shows. facts.py
says what signs are; integrations/contracts.py is the table of rasterizers.
"""
from __future__ import annotations

from typing import NamedTuple, Tuple

from diff_smoe_rasterization.integrations.contracts import RASTERIZER as RASTERIZER

INTEGRATIONS = "diff_smoe_rasterization.integrations"
PATCHES = "dsmoe.patches"
RUNTIME = f"{PATCHES}.runtime"
GR, ARGUMENTS = "gaussian_renderer/__init__.py", "arguments/__init__.py"


class Entry(NamedTuple):
    """A function that is given both groups of options, and from which everything that renders is called."""

    file: str  # relative to the checkout
    function: str
    dataset: str = "dataset"  # the names of its parameters
    pipe: str = "pipe"
    blend: str = "blend_of"  # what of runtime.py says how it blends

    @property
    def renders(self) -> bool:
        """Whether it renders a trained model."""
        return self.blend.startswith("saved_")


class Trainer(NamedTuple):
    """A trainer that can be patched."""

    name: str  # as in --trainer
    flavour: str  # the rasterizer that it calls: an entry of contracts.py
    entries: Tuple[Entry, ...]  # none: `dsmoe run` knows it, and no patch does
    signs: Tuple[str, ...] = ()  # it shows all of these
    default: str = "default_blend"  # what of runtime.py gives the options' defaults


def rendering(file: str, blend: str = "saved_blend_of") -> Entry:
    return Entry(file, "render_sets", pipe="pipeline", blend=blend)


OF_AUTHORS = "3d-smoe"
TRAINING = Entry("train.py", "training")
USUAL = (TRAINING, rendering("render.py"))
IN_ONE_FILE = (TRAINING, rendering("train.py"))

TRAINERS = (
    # HAC (Chen et al. 2024) and HAC++ (2025) on Scaffold-GS (Lu et al. 2024); Octree-GS (Ren et al. 2024) too.
    Trainer("hac-plus", "scaffold", IN_ONE_FILE, ("imports gpcc_utils",)),
    Trainer("hac", "scaffold", IN_ONE_FILE, ("imports encodings",)),
    Trainer("octree-gs", "scaffold", (*IN_ONE_FILE, rendering("render.py")), ("calls set_anchor_mask",)),
    Trainer("scaffold-gs", "scaffold", (*IN_ONE_FILE, rendering("render.py"))),
    # Compressed 3DGS (Niedermayr et al. 2024) trains no model: it compresses one, whose cfg_args brings the mode.
    Trainer("c3dgs", "c3dgs", (Entry("compress.py", "run_vq", "model_params", "pipeline_params", "saved_blend_of"),
                               rendering("render.py"))),
    # Taming 3DGS (Mallick et al. 2024) scores by renderings through the pipeline that `training` was given.
    Trainer("taming", "taming", USUAL),
    # 3DGS (Kerbl et al. 2023) of 2024 and of before, and those that call either's rasterizer. DashGaussian (Chen et al.
    # 2025) trains by train_dash.py, which has a `training` too.
    Trainer("dashgaussian", "inria_2024", USUAL, ("imports schedule_utils",)),
    Trainer("3dgs-2024", "inria_2024", USUAL),
    Trainer("instantsplat", "inria", USUAL, ("imports pose_utils",)),
    Trainer("gaussianpro", "inria", USUAL, ("calls depth_propagation",)),
    Trainer("compact-3dgs", "inria", USUAL, ("imports tinycudann",)),
    # 3D SMoE Splatting (Li et al. 2025) on 3DGS of 2023: smoe unless told otherwise, with tails in every pixel.
    Trainer(OF_AUTHORS, "inria", (TRAINING._replace(blend="smoe_of"), rendering("render.py", "saved_smoe_of")),
            ("calls load_init", "calls images_to_video"), "default_smoe"),
    Trainer("3dgs-2023", "inria", USUAL),
    # Rasterizers that return a depth too.
    Trainer("4dgaussians", "depth", USUAL, ("imports deformation",)),
    Trainer("3dgs-depth", "depth", USUAL),
    Trainer("3dgs-depth-alpha", "depth_alpha", USUAL),
)
TRAINER_NAMES = tuple(sorted({trainer.name for trainer in TRAINERS}))
