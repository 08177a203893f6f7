"""Which trainers there are: one short file each. A checkout is the first of TRAINERS one of whose signs it shows."""
from __future__ import annotations

from .c3dgs import C3DGS
from .hac import HAC
from .hac_plus import HAC_PLUS
from .inria_2023 import INRIA_2023
from .inria_2024 import INRIA_2024
from .scaffold_gs import SCAFFOLD_GS
from .taming import TAMING

TRAINERS = (HAC_PLUS, HAC, SCAFFOLD_GS, C3DGS, TAMING, INRIA_2024, INRIA_2023)
