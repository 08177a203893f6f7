"""HAC (Chen et al. 2024), on Scaffold-GS. train.py trains, encodes, decodes, renders and measures in one process."""
from ..rules import PipeBlendMode, Trainer, shared_rules

FLAVOUR = "scaffold"
RULES = shared_rules(FLAVOUR, settings_calls=2) + (  # render and prefilter_voxel: which radii are 0 depends on the mode
    PipeBlendMode("train.py", "training"),
    PipeBlendMode("train.py", "render_sets", pipe="pipeline"),
)

HAC = Trainer(name="hac", flavour=FLAVOUR, signs=("calls visible_filter and imports encodings",), rules=RULES)
