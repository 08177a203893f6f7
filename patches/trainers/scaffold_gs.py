"""Scaffold-GS (Lu et al. 2024). Like HAC, which is made of it, it renders in train.py; it has a render.py too."""
from ..rules import PipeBlendMode, Trainer
from .hac import FLAVOUR, RULES

SCAFFOLD_GS = Trainer(
    name="scaffold-gs",
    flavour=FLAVOUR,
    signs=("calls visible_filter",),
    rules=RULES + (PipeBlendMode("render.py", "render_sets", pipe="pipeline"),),
)
