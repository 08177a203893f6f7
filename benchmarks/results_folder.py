"""What lies in RESULTS, the folder of a benchmark: engine.py and cell.py write it, report/ reads the rows.

The Snakefile, which Snakemake reads as a file of its own, repeats the names.
"""
from __future__ import annotations

ROWS_NAME = "rows.jsonl"  # all rows, one a line
CELLS_FOLDER = "cells"  # a folder for each cell, by its name
CELL_NAME = "cell.json"  # in it: what is trained on what
ROW_NAME = "row.json"  # in it too: what came out
SUITE_NAME = "suite.json"  # which cells there are, and their protocol
LOCK_NAME = ".lock"  # held by the one run that is at work
