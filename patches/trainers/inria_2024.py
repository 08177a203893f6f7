"""3D Gaussian Splatting, the code of 2024: antialiasing, exposure, depth, SparseGaussianAdam.

Whoever imports SparseGaussianAdam and whoever renders have to agree on the package, so all imports change together. The
import of its `_C` in utils/loss_utils.py stays: it is tried, and the losses do without it.
"""
from ..rules import GR, PipeBlendMode, Trainer, shared_rules

FLAVOUR = "inria_2024"

INRIA_2024 = Trainer(
    name="3dgs-2024",
    flavour=FLAVOUR,
    signs=("sets antialiasing", "imports SparseGaussianAdam"),
    rules=shared_rules(FLAVOUR, imports=(GR, "train.py", "render.py", "scene/gaussian_model.py")) + (
        PipeBlendMode("train.py", "training"),
        PipeBlendMode("render.py", "render_sets", pipe="pipeline"),
    ),
)
