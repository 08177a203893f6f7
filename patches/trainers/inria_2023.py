"""3D Gaussian Splatting (Kerbl et al. 2023), the code of 2023."""
from ..rules import PipeBlendMode, Trainer, shared_rules

FLAVOUR = "inria"

INRIA_2023 = Trainer(
    name="3dgs-2023",
    flavour=FLAVOUR,
    signs=("imports GaussianRasterizationSettings",),
    rules=shared_rules(FLAVOUR) + (
        PipeBlendMode("train.py", "training"),
        PipeBlendMode("render.py", "render_sets", pipe="pipeline"),
    ),
)
