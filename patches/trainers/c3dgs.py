"""Compressed 3DGS (Niedermayr et al. 2024). It trains no model: `run_vq` compresses one and finetunes what is left.

The model's own cfg_args brings the blend mode. Finetuning writes the cfg_args of the result, with the mode in use.
"""
from ..rules import PipeBlendMode, Trainer, shared_rules

FLAVOUR = "c3dgs"

C3DGS = Trainer(
    name="c3dgs",
    flavour=FLAVOUR,
    signs=("imports GaussianRasterizerIndexed", "sets clamp_color"),
    rules=shared_rules(FLAVOUR) + (
        PipeBlendMode("compress.py", "run_vq", dataset="model_params", pipe="pipeline_params"),
        PipeBlendMode("render.py", "render_sets", pipe="pipeline"),
    ),
)
