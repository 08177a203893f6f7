"""What lies in RESULTS, the folder of a benchmark: engine.py and cell.py write it, report/ reads the rows.

The Snakefile, which Snakemake reads as a file of its own, repeats the names.
"""
from __future__ import annotations

import json
import os
from types import MappingProxyType
from typing import Any, Dict, Mapping, Optional

from .errors import BenchError

ROWS_NAME = "rows.jsonl"  # all rows, one a line
CELLS_FOLDER = "cells"  # a folder for each cell, by its name
CELL_NAME = "cell.json"  # in it: what is trained on what
ROW_NAME = "row.json"  # in it too: what came out
SUITE_NAME = "suite.json"  # its name, its protocol, and the names of all its cells, run or not


def read_object(path: str, needed: Mapping[str, type] = MappingProxyType({})) -> Optional[Dict[str, Any]]:
    """The object of a .json file; None where there is no file. Raises BenchError where it is damaged.

    needed: fields that it must have, and of which types.
    """
    if not os.path.isfile(path):
        return None
    try:
        with open(path, encoding="utf-8") as file:
            found = json.load(file)
        if not isinstance(found, dict):
            raise ValueError("it is no object")
        lacking = [field for field in needed if field not in found]
        if lacking:
            raise ValueError(f"it lacks {', '.join(lacking)}")
        for field, kind in needed.items():
            if not isinstance(found[field], kind):
                raise ValueError(f"{field} is {found[field]!r}; it must be of type {kind.__name__}")
    except ValueError as error:
        raise BenchError(f"{path}: not valid json, or not what it must be ({error}); remove it to have it made "
                         "anew") from error
    return found
