"""Taming 3DGS (Mallick et al. 2024). Its scoring renders through the pipeline that `training` was given."""
from ..rules import GR, PipeBlendMode, Trainer, shared_rules

FLAVOUR = "taming"

TAMING = Trainer(
    name="taming",
    flavour=FLAVOUR,
    signs=("sets pixel_weights",),
    results=13,
    rules=shared_rules(FLAVOUR, imports=(GR, "scene/gaussian_model.py")) + (
        PipeBlendMode("train.py", "training"),
        PipeBlendMode("render.py", "render_sets", pipe="pipeline"),
    ),
)
