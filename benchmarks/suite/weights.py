"""Files of LPIPS's weights, for machines without a network connection; what they are used for is in lpips.py."""
from __future__ import annotations

import os
from typing import Dict, Sequence

from ..errors import BenchError

# Files of weights, .npz: conv1.weight [outputs, inputs, h, w], conv1.bias, ..., lin0.weight, ..., lin4.weight.
VARIABLES = {"vgg": "DSMOE_LPIPS_VGG", "alex": "DSMOE_LPIPS_ALEX"}


def net_of(kind: str) -> str:
    """Which network a kind of LPIPS_KINDS is of: a key of VARIABLES."""
    return "alex" if kind == "lpips_alex" else "vgg"


def check_weights(kinds: Sequence[str]) -> None:
    """Raises BenchError where a variable names a file of weights that is wanted and not there."""
    for kind in kinds:
        variable = VARIABLES[net_of(kind)]
        if os.environ.get(variable) and not os.path.isfile(os.environ[variable]):
            raise BenchError(f"{variable}: {os.environ[variable]}: no such file, where the weights of {kind} must be; "
                             "name it, or unset the variable to have torchmetrics download them")


def files_of_weights() -> Dict[str, str]:
    """The variables that name files of weights, with absolute paths: cells run in another folder."""
    return {name: os.path.abspath(os.environ[name]) for name in VARIABLES.values() if os.environ.get(name)}
