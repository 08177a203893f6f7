"""Result rows: how they are read, refused where their protocols differ, and averaged over seeds and scenes."""
from __future__ import annotations

import json
import os
import re
import statistics
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Sequence, Tuple

from ..errors import BenchError
from ..results_folder import CELLS_FOLDER, ROW_NAME, ROWS_NAME

Row = Dict[str, Any]

NEEDED = {"cell": str, "suite": str, "ok": bool, "method": str, "blend_mode": str, "scene": str, "seed": int}
# What two rows of one scene must share to be comparable, where both say it.
RULES = ("split", "resolution", "image_size", "downscaler", "background", "principal_point")
RULE_PREFIXES = ("psnr", "ssim", "lpips", "edge", "fps", "size", "quantisation")
PAPER_ITERATIONS, PAPER_SCHEDULE = 30000, "3dgs"
MEGABYTE = 1e6
TIMES = ("train_seconds", "wall_seconds", "fps")  # of cells that shared their GPU these are not the GPU's own
LPIPS = "lpips:"  # the figure's name goes on with its kind, such as lpips_alex


class ReportError(BenchError):
    """Rows cannot be reported; the text says which and why."""


class Setting(NamedTuple):
    """What a cell varies, except the scene and the seed."""

    method: str
    name: str  # the method's label in the suite: it tells apart what the other fields do not
    variant: Optional[str]
    blend_mode: str
    schedule: Optional[str]
    threshold: Optional[float]
    budget: Optional[int]
    iterations: Optional[int]
    end: Optional[str]

    @property
    def series(self) -> "Setting":
        """The setting without what is varied along a curve."""
        return self._replace(threshold=None, budget=None if self.budget is None else -1, end=None)

    @property
    def pair(self) -> "Setting":
        """The setting without the blend mode: what alpha and smoe are compared in."""
        return self._replace(blend_mode="")

    @property
    def source(self) -> str:
        """The method's label, which says where a checkout is unpatched."""
        told = self.variant != "unpatched" or "unpatched" in self.name
        return self.name if told else f"{self.name}-unpatched"

    def label(self, blend_mode: bool = True) -> str:
        """Such as "native, smoe, steady"."""
        words = [self.source]
        if blend_mode:
            words.append(self.blend_mode)
        if self.schedule not in (None, PAPER_SCHEDULE):
            words.append(self.schedule)
        if self.budget is not None:
            words.append("fixed number")
        if self.iterations not in (None, PAPER_ITERATIONS):
            words.append(f"{self.iterations:,} iterations")
        return ", ".join(words)

    def amount(self) -> str:
        """What is varied along a curve, such as "0.005"."""
        if self.budget is not None:
            return f"{self.budget:,} Gaussians"
        return "–" if self.threshold is None else f"{self.threshold:g}"


class Measured(NamedTuple):
    """A mean over seeds with its sample standard deviation; None: not measured, or fewer than two seeds."""

    mean: Optional[float] = None
    spread: Optional[float] = None


class Group:
    """The cells of one setting on one scene: one row for each seed."""

    def __init__(self, setting: Setting, scene: str, rows: Sequence[Row]):
        self.setting, self.scene = setting, scene
        self.rows = [row for row in rows if row["ok"]]
        self.failed = [row for row in rows if not row["ok"]]

    def dataset(self, datasets: Dict[str, Sequence[str]]) -> Optional[str]:
        """The data set that the scene is of: as its rows say, else the one that has a scene of this name."""
        row = (self.rows + self.failed)[0]
        if "dataset" in row:
            return row["dataset"]
        return next((dataset for dataset, scenes in datasets.items() if self.scene in scenes), None)

    def by_seed(self, name: str) -> Dict[int, float]:
        """{seed: figure} of the seeds that have it."""
        figures = {row["seed"]: figure(row, name) for row in self.rows}
        return {seed: value for seed, value in figures.items() if value is not None}

    def measured(self, name: str) -> Measured:
        """The figure's mean and spread over seeds."""
        return measured(self.by_seed(name).values())

    def shared(self, name: str) -> bool:
        """Whether the figure is left out because every cell shared its GPU."""
        return name in TIMES and bool(self.rows) and all(map(shared_gpu, self.rows))

    def seeds(self) -> str:
        """How many seeds the figures are of, such as "3", or "2 of 3" where one failed."""
        return str(len(self.rows)) if not self.failed else f"{len(self.rows)} of {len(self.rows) + len(self.failed)}"


def read_rows(results: str) -> List[Row]:
    """The rows of a results folder (cells/*/row.json and rows.jsonl) or of one .jsonl file, sorted by cell.

    A cell's own row.json wins over rows.jsonl, and there the last line of a cell. Raises ReportError where there are
    none, where one is damaged, or where a suite mixes protocols.
    """
    rows: Dict[str, Row] = {}
    listed = results if os.path.isfile(results) else os.path.join(results, ROWS_NAME)
    if os.path.isfile(listed):
        for number, line in enumerate(_text(listed).split("\n"), 1):
            if line.strip():
                row = _parsed(line, f"{listed}, line {number}")
                rows[row["cell"]] = row
    cells = os.path.join(results, CELLS_FOLDER)
    for cell in sorted(os.listdir(cells)) if os.path.isdir(cells) else []:
        path = os.path.join(cells, cell, ROW_NAME)
        if os.path.isfile(path):
            row = _parsed(_text(path), path)
            rows[row["cell"]] = row
    if not rows:
        raise ReportError(f"{results}: no rows: neither {CELLS_FOLDER}/*/{ROW_NAME} nor {ROWS_NAME}")
    found = [rows[cell] for cell in sorted(rows)]
    _refuse_mixed_protocols(found)
    return found


def _text(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except UnicodeDecodeError as error:
        raise ReportError(f"{path}: not text in UTF-8 ({error})") from error


def _parsed(text: str, place: str) -> Row:
    try:
        row = json.loads(text)
    except ValueError as error:
        raise ReportError(f"{place}: not valid json ({error})") from error
    if not isinstance(row, dict):
        raise ReportError(f"{place}: expected one object, a row")
    missing = [name for name in NEEDED if name not in row]
    if missing:
        raise ReportError(f"{place}: the row lacks {', '.join(missing)}")
    for name, kind in NEEDED.items():
        if not isinstance(row[name], kind):
            raise ReportError(f"{place}: {name} is {row[name]!r}; it must be of type {kind.__name__}")
    return row


def _refuse_mixed_protocols(rows: Iterable[Row]) -> None:
    first: Dict[Tuple[str, str, str], Tuple[Any, str]] = {}
    for row in rows:
        for name, value in (row.get("protocol") or {}).items():
            if row["ok"] and (name in RULES or name.startswith(RULE_PREFIXES)):
                known, cell = first.setdefault((row["suite"], row["scene"], name), (value, row["cell"]))
                if known != value:
                    raise ReportError(f"suite {row['suite']}, scene {row['scene']}: cells of different protocols stand "
                                      f"in no common table: {name} is {known!r} in {cell} and {value!r} in "
                                      f"{row['cell']}")


def figure(row: Row, name: str) -> Optional[float]:
    """A figure of a row by its name: a field; size_own_mb, size_common_mb, num_gaussians_m; lpips:KIND.

    None where it was not measured, and for times of a cell that shared its GPU.
    """
    if name in TIMES and shared_gpu(row):
        return None
    if name.startswith(LPIPS):
        return next((lpips["value"] for lpips in _lpips(row) if lpips["kind"] == name[len(LPIPS):]), None)
    if name in ("size_own_mb", "size_common_mb"):
        size = (row.get("size_bytes") or {}).get(name[len("size_"):-len("_mb")])
        return None if size is None else size / MEGABYTE
    if name == "num_gaussians_m":
        count = row.get("num_gaussians")
        return None if count is None else count / 1e6
    return row.get(name)


def shared_gpu(row: Row) -> bool:
    """Whether other cells may have been at work on the row's GPU."""
    machine = row.get("machine")
    return isinstance(machine, dict) and (machine.get("cells_per_gpu") or 1) > 1


def lpips_figures(rows: Iterable[Row]) -> List[str]:
    """The names of the LPIPS figures that some row has, such as lpips:lpips_alex."""
    return [LPIPS + kind for kind in sorted({lpips["kind"] for row in rows for lpips in _lpips(row)
                                             if lpips["value"] is not None})]


def lpips_reasons(rows: Iterable[Row]) -> List[str]:
    """Which kinds of LPIPS are missing, and why."""
    return sorted({f"{lpips['kind']}: {lpips['reason']}" for row in rows if row["ok"] for lpips in _lpips(row)
                   if lpips["value"] is None and lpips.get("reason")})


def _lpips(row: Row) -> List[Row]:
    return row.get("lpips_all") or ([row["lpips"]] if row.get("lpips") else [])


def setting_of(row: Row, end_of: Callable[[Row], Optional[str]]) -> Setting:
    """The setting of a row; end_of says to which end of the paper's tables a row belongs."""
    return Setting(row["method"], row.get("label") or row["method"], row.get("variant"), row["blend_mode"],
                   row.get("schedule"), row.get("densify_grad_threshold"), row.get("budget"), row.get("iterations"),
                   end_of(row))


def grouped(rows: Iterable[Row], end_of: Callable[[Row], Optional[str]]) -> List[Group]:
    """Groups of seeds, in the order of scene, method, schedule, threshold (the largest first), blend mode."""
    found: Dict[Tuple[Setting, str], List[Row]] = {}
    for row in rows:
        members = found.setdefault((setting_of(row, end_of), row["scene"]), [])
        twin = next((member for member in members if member["seed"] == row["seed"]), None)
        if twin is not None:
            raise ReportError(f"cells {twin['cell']} and {row['cell']} have the same setting, scene and seed "
                              f"{row['seed']}; keep one, or give their methods different labels")
        members.append(row)
    groups = [Group(setting, scene, members) for (setting, scene), members in found.items()]
    return sorted(groups, key=lambda group: (group.scene, order(group.setting)))


def order(setting: Setting) -> Tuple:
    """A sort key: methods as one list, thresholds from sparse to dense, alpha before the gated modes."""
    modes = ("alpha", "smoe", "smoe_tn", "smoe_std")
    mode = modes.index(setting.blend_mode) if setting.blend_mode in modes else len(modes)
    return (setting.method != "native", setting.method, setting.name, setting.variant or "", setting.schedule or "",
            setting.budget is not None, setting.budget or 0, setting.iterations or 0, setting.end != "sparse",
            -(setting.threshold or 0), mode, setting.blend_mode)


def safe_name(name: str) -> str:
    """A name of a suite, scene or image that is a file name, a URL and an HTML id alike."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name)


def measured(values: Iterable[float]) -> Measured:
    """Mean and sample standard deviation."""
    values = list(values)
    if not values:
        return Measured()
    return Measured(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None)


def over_scenes(groups: Sequence[Group], name: str) -> Measured:
    """The mean over scenes of the means over seeds; None where a scene lacks the figure.

    The spread is that of the averages over scenes, over the seeds that all scenes have.
    """
    by_scene = [group.by_seed(name) for group in groups]
    if not by_scene or not all(by_scene):
        return Measured()
    mean = statistics.fmean(statistics.fmean(figures.values()) for figures in by_scene)
    common = set.intersection(*(set(figures) for figures in by_scene))
    averages = [statistics.fmean(figures[seed] for figures in by_scene) for seed in sorted(common)]
    return Measured(mean, statistics.stdev(averages) if len(averages) > 1 else None)


def paired(one: Group, other: Group, name: str, combine: Callable[[float, float], float]) -> Measured:
    """combine(other, one) for each seed that both have, averaged."""
    first, second = one.by_seed(name), other.by_seed(name)
    return measured(combine(second[seed], first[seed]) for seed in sorted(set(first) & set(second)))
