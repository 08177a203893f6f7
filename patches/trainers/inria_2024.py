"""3D Gaussian Splatting, the code of 2024: depth, then antialiasing, exposure, then SparseGaussianAdam.

Whoever imports SparseGaussianAdam and whoever renders have to agree on the package, so all imports change together. The
import of its `_C` in utils/loss_utils.py stays: it is tried, and the losses do without it.
"""
from ..rules import ImportRasterizer, PipeBlendMode, Trainer, shared_rules

FLAVOUR = "inria_2024"

INRIA_2024 = Trainer(
    name="3dgs-2024",
    flavour=FLAVOUR,
    signs=("sets antialiasing", "imports SparseGaussianAdam", "unpacks 3 results and reads invdepthmap"),
    results=3,
    rules=shared_rules(FLAVOUR) + (
        ImportRasterizer("train.py", FLAVOUR, least=0),  # of SparseGaussianAdam, since October
        ImportRasterizer("render.py", FLAVOUR, least=0),
        ImportRasterizer("scene/gaussian_model.py", FLAVOUR, least=0),
        PipeBlendMode("train.py", "training"),
        PipeBlendMode("render.py", "render_sets", pipe="pipeline"),
    ),
)
