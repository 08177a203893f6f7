"""Rows in the table format of the 3DGS compression survey (w-m/3dgs-compression-survey): one CSV for each scene."""
from __future__ import annotations

import csv
import os
from typing import Dict, List, Optional, Sequence

from ..rows import Row
from .groups import PAPER_SCHEDULE, Group, grouped, safe_name
from .layouts import end_of

HEADER = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")
LPIPS_FIGURE = "lpips:lpips_vgg_inria"  # the survey's tables hold 3DGS's own LPIPS, and no other may stand there
FOLDERS = {"Deep Blending": "DeepBlending", "Tanks and Temples": "TanksAndTemples", "Mip-NeRF 360": "MipNeRF360",
           "NeRF synthetic": "SyntheticNeRF"}
SYNTHETIC = {"NeRF synthetic": ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")}
OTHER = "other"  # scenes of no data set of the survey


def folder_of(group: Group, datasets: Dict[str, Sequence[str]]) -> str:
    """The survey's folder for a scene."""
    return FOLDERS.get(group.dataset({**datasets, **SYNTHETIC}) or "", OTHER)


def submethod(group: Group) -> str:
    """The survey shows rows with a submethod in its table, others in its plots only; it appends the name to ours."""
    words = [group.setting.source, group.setting.blend.replace(" ", "-")]
    if group.setting.schedule not in (None, PAPER_SCHEDULE):
        words.append(group.setting.schedule)
    if group.setting.budget is not None:
        words.append(f"n{group.setting.budget}")
    elif group.setting.threshold is not None:
        words.append(f"t{group.setting.threshold:g}")
    return "-" + "-".join(words)


def survey_row(group: Group) -> List[str]:
    """A line of the survey's table: means over seeds, unrounded; empty where nothing was measured."""
    size = group.measured("size_own_mb").value
    count = group.measured("num_gaussians").value
    return [submethod(group), *(_text(group.measured(name).value) for name in ("psnr", "ssim", LPIPS_FIGURE)),
            "" if size is None else str(round(size * 1e6)), "" if count is None else str(round(count))]


def write_survey(rows: Sequence[Row], datasets: Dict[str, Sequence[str]], folder: str) -> List[str]:
    """Writes FOLDER/DATASET/SCENE.csv for every scene; returns the paths. Cells that failed have no line there."""
    by_path: Dict[str, List[List[str]]] = {}
    for group in grouped(rows, end_of):
        if group.rows:
            path = os.path.join(folder, folder_of(group, datasets), f"{safe_name(group.scene)}.csv")
            by_path.setdefault(path, []).append(survey_row(group))
    for path, lines in by_path.items():
        os.makedirs(os.path.dirname(path), exist_ok=True)
        with open(path, "w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEADER, *lines])
    return sorted(by_path)


def _text(value: Optional[float]) -> str:
    return "" if value is None else repr(value)
