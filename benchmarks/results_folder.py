"""Where rows lie in RESULTS, the folder of a benchmark: engine.py and cell.py write them, report/ reads them."""
from __future__ import annotations

ROWS_NAME = "rows.jsonl"  # all rows, one a line
CELLS_FOLDER = "cells"  # a folder for each cell, by its name
ROW_NAME = "row.json"  # in it
