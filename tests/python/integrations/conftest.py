"""Makes the top-level folder `integrations` importable as it is once installed, also where nothing is installed."""
from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import diff_smoe_rasterization

ROOT = Path(__file__).resolve().parents[3]
NAME = "diff_smoe_rasterization.integrations"

if Path(diff_smoe_rasterization.__file__).parent == ROOT / "diff_smoe_rasterization":
    folder = ROOT / "integrations"
    spec = importlib.util.spec_from_file_location(NAME, folder / "__init__.py",
                                                  submodule_search_locations=[str(folder)])
    package = sys.modules[NAME] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(package)
    diff_smoe_rasterization.integrations = package
