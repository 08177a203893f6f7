"""HAC++ (Chen et al. 2025): HAC's structure, with an entropy coder for the anchors' places."""
from ..rules import Trainer
from .hac import FLAVOUR, RULES

HAC_PLUS = Trainer(
    name="hac-plus",
    flavour=FLAVOUR,
    signs=("imports gpcc_utils", "calls visible_filter and imports encodings and imports lpips"),
    rules=RULES,
)
