"""Result rows: how they are read, refused where their protocols differ, and averaged over seeds and scenes."""
from __future__ import annotations

import json
import math
import os
import re
import statistics
from typing import Any, Callable, Dict, Iterable, Iterator, List, NamedTuple, Optional, Sequence, Set, Tuple

from ...settings import BLEND_MODES
from ...trainer.config import LEARNED
from ..errors import BenchError
from ..methods.names import blend_of
from ..results_folder import CELLS_FOLDER, ROW_NAME, ROWS_NAME

Row = Dict[str, Any]

NUMBER = (int, float)
GATE = (*NUMBER, str)  # of the background: a number, or LEARNED
NEEDED = {"cell": str, "suite": str, "ok": bool, "method": str, "blend_mode": str, "scene": str, "seed": int}
# What else is read of a row; each may be absent or null.
OPTIONAL = {**dict.fromkeys(("label", "variant", "schedule", "dataset", "end", "reason"), str),
            **dict.fromkeys(("budget", "iterations"), int),
            **dict.fromkeys(("densify_grad_threshold", "psnr", "psnr_float", "psnr_edge", "ssim", "num_gaussians",
                             "train_seconds", "wall_seconds", "fps", "peak_gpu_mib"), NUMBER),
            **dict.fromkeys(("size_bytes", "lpips", "protocol", "commit", "machine"), dict), "lpips_all": list,
            "background_gate": GATE}
PARTS = {"size_bytes": {"own": NUMBER, "common": NUMBER}, "lpips": {"kind": str, "value": NUMBER},
         "machine": {"device": str, "cells_per_gpu": int, "cells_at_once": int}}
LARGEST = 1e18  # of a number that is a figure
# What two rows of one scene must share to be comparable, where both say it.
RULES = ("split", "train_views", "test_views", "resolution", "image_size", "downscaler", "background",
         "principal_point", "sh_degree", "recipe", "scale_recipe")
RULE_PREFIXES = ("psnr", "ssim", "lpips", "edge", "fps", "size", "quantisation")
PAPER_ITERATIONS, PAPER_SCHEDULE = 30000, "3dgs"
MEGABYTE = 1e6
TIMES = ("train_seconds", "wall_seconds", "fps")  # of cells that shared their machine these are not its own
SHARED, MACHINES_DIFFER = "shared", "machines differ"  # why there is no time
LPIPS = "lpips:"  # the figure's name goes on with its kind, such as lpips_alex


class ReportError(BenchError):
    """Rows cannot be reported; the text says which and why."""


class Setting(NamedTuple):
    """What a cell varies, except the scene and the seed."""

    method: str
    name: str  # the method's label in the suite: it tells apart what the other fields do not
    variant: Optional[str]
    blend: str  # as `blend_of` has it: each gate of smoe is a blend of its own
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
        """The setting without the blend: what alpha and smoe are compared in."""
        return self._replace(blend="")

    @property
    def mode(self) -> str:
        """The blend mode, whatever the gate."""
        return self.blend.partition(" ")[0]

    @property
    def source(self) -> str:
        """The method's label, which says where a checkout is unpatched or fused."""
        told = self.variant in (None, "native", "patched") or self.variant in self.name
        return self.name if told else f"{self.name}-{self.variant}"

    def label(self, blend: bool = True) -> str:
        """Such as "native, smoe, steady"."""
        words = [self.source]
        if blend:
            words.append(self.blend)
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
    why: str = ""  # there is no mean


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

    def measured(self, name: str) -> Measured:
        """The figure's mean and spread over seeds."""
        return over([self], name, lambda figures: figures[0])

    def done(self) -> Set[int]:
        """The seeds that did not fail."""
        return {row["seed"] for row in self.rows}

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
        raise ReportError(f"{place}: not valid json, as a row of `dsmoe bench run` is ({error})") from error
    if not isinstance(row, dict):
        raise ReportError(f"{place}: expected one object, a row")
    check_row(row, place)
    return row


def check_row(row: Row, place: str) -> None:
    """Raises ReportError where a row lacks a field, or has one of another type than what reads it needs.

    place: where the row stands, in words.
    """
    missing = [name for name in NEEDED if name not in row]
    if missing:
        raise ReportError(f"{place}: the row lacks {', '.join(missing)}, which those of `dsmoe bench run` have")
    for name, value, kind in _fields(row):
        if (value is not None or name in NEEDED) and not _legal(name, value, kind):
            wanted = {int: "a whole number", NUMBER: "a finite number", GATE: f"a finite number or {LEARNED!r}"}.get(
                kind) or f"of type {kind.__name__}"
            raise ReportError(f"{place}: {name} is {value!r}; it must be {wanted}")


def _fields(row: Row) -> Iterator[Tuple[str, Any, Any]]:
    """(name, value, type) of all that is read of a row, each before its parts."""
    for name, kind in {**NEEDED, **OPTIONAL}.items():
        yield name, row.get(name), kind
        for part, part_kind in PARTS.get(name, {}).items():
            yield f"{name}.{part}", (row.get(name) or {}).get(part), part_kind
    for index, lpips in enumerate(row.get("lpips_all") or []):
        yield f"lpips_all[{index}]", lpips, dict
        for part, part_kind in PARTS["lpips"].items():
            yield f"lpips_all[{index}].{part}", (lpips or {}).get(part), part_kind


def _legal(name: str, value: Any, kind: Any) -> bool:
    if kind is GATE:
        return value == LEARNED or _legal(name, value, NUMBER)
    if not isinstance(value, kind) or isinstance(value, bool) != (kind is bool):
        return False
    if kind not in (int, NUMBER):
        return True
    return abs(value) < LARGEST or (value == math.inf and name.startswith("psnr"))  # NaN is not smaller either


def _refuse_mixed_protocols(rows: Iterable[Row]) -> None:
    first: Dict[Tuple[str, str, str], Tuple[Any, str]] = {}
    for row in rows:
        for name, value in _rules(row) if row["ok"] else ():
            known, cell = first.setdefault((row["suite"], row["scene"], name), (value, row["cell"]))
            if known != value:
                raise ReportError(f"suite {row['suite']}, scene {row['scene']}: cells of different protocols stand "
                                  f"in no common table: {name} is {known!r} in {cell} and {value!r} in {row['cell']}")


def _rules(row: Row) -> Iterator[Tuple[str, Any]]:
    """(name, value) of each rule that the row states; the entries of one that is a dict stand alone."""
    for name, value in (row.get("protocol") or {}).items():
        if name in RULES or name.startswith(RULE_PREFIXES):
            entries = {f"{name}.{key}": entry for key, entry in value.items()} if isinstance(value, dict) else {
                name: value}
            yield from ((key, entry) for key, entry in entries.items() if entry is not None)


def figure(row: Row, name: str) -> Optional[float]:
    """A figure of a row by its name: a field; size_own_mb, size_common_mb, num_gaussians_m; learned_gate;
    lpips:KIND.

    None where it was not measured, and for times of a cell that shared its machine.
    """
    if name in TIMES and shared(row):
        return None
    if name in ("psnr", "psnr_float") and row.get(name) is None and row["ok"] and row.get("ssim") is not None:
        return math.inf  # json has no number for it: renderings that equal the ground truth
    if name.startswith(LPIPS):
        return next((lpips.get("value") for lpips in _lpips(row) if lpips["kind"] == name[len(LPIPS):]), None)
    if name in ("size_own_mb", "size_common_mb"):
        size = (row.get("size_bytes") or {}).get(name[len("size_"):-len("_mb")])
        return None if size is None else size / MEGABYTE
    if name == "learned_gate":
        return (row.get("protocol") or {}).get("background_gate") if row.get("background_gate") == LEARNED else None
    if name == "num_gaussians_m":
        count = row.get("num_gaussians")
        return None if count is None else count / 1e6
    return row.get(name)


def at_once(row: Row) -> int:
    """How many cells may have been at work at once on the row's GPU or CPU."""
    machine = row.get("machine") or {}
    return max(machine.get("cells_per_gpu") or 1, machine.get("cells_at_once") or 1)


def shared(row: Row) -> bool:
    """Whether other cells may have been at work on the row's GPU or CPU."""
    return at_once(row) > 1


def device_of(row: Row) -> Optional[str]:
    """What the row was measured on, such as "NVIDIA H200"."""
    return (row.get("machine") or {}).get("device")


def lpips_figures(rows: Iterable[Row]) -> List[str]:
    """The names of the LPIPS figures that some row has, such as lpips:lpips_alex."""
    return [LPIPS + kind for kind in sorted({lpips["kind"] for row in rows for lpips in _lpips(row)
                                             if lpips.get("value") is not None})]


def lpips_reasons(rows: Iterable[Row]) -> List[str]:
    """Which kinds of LPIPS are missing, and why."""
    return sorted({f"{lpips['kind']}: {lpips['reason']}" for row in rows if row["ok"] for lpips in _lpips(row)
                   if lpips.get("value") is None and lpips.get("reason")})


def _lpips(row: Row) -> List[Row]:
    """What the row says of each kind of LPIPS; a suite may ask for none."""
    return [lpips for lpips in row.get("lpips_all") or [row.get("lpips")] if lpips and lpips.get("kind")]


def setting_of(row: Row, end_of: Callable[[Row], Optional[str]]) -> Setting:
    """The setting of a row; end_of says to which end of the paper's tables a row belongs."""
    return Setting(row["method"], row.get("label") or row["method"], row.get("variant"), blend_of(row),
                   row.get("schedule"), row.get("densify_grad_threshold"), row.get("budget"), row.get("iterations"),
                   end_of(row))


def grouped(rows: Iterable[Row], end_of: Callable[[Row], Optional[str]]) -> List[Group]:
    """Groups of seeds, in the order of scene, method, schedule, threshold (the largest first), blend."""
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
    mode = BLEND_MODES.index(setting.mode) if setting.mode in BLEND_MODES else len(BLEND_MODES)
    return (setting.method != "native", setting.method, setting.name, setting.variant or "", setting.schedule or "",
            setting.budget is not None, setting.budget or 0, setting.iterations or 0, setting.end != "sparse",
            -(setting.threshold or 0), mode, setting.blend)


def safe_name(name: str) -> str:
    """A name of a suite, scene or image that is a file name, a URL and an HTML id alike."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name)


def over(groups: Sequence[Group], name: str, combine: Callable[[List[float]], float],
         seeds: Optional[Set[int]] = None) -> Measured:
    """Mean and spread of combine([the figure of each group]) over the seeds that all groups have it of.

    seeds: no others. What combine gives as NaN is left out. Times are of one machine, or there are none.
    """
    found = [{row["seed"]: row for row in group.rows if figure(row, name) is not None} for group in groups]
    common = set.intersection(*map(set, found), *([] if seeds is None else [seeds]))
    if name in TIMES and not common and any(shared(row) for group in groups for row in group.rows):
        return Measured(why=SHARED)
    if name in TIMES and len({device_of(rows[seed]) for rows in found for seed in common}) > 1:
        return Measured(why=MACHINES_DIFFER)
    values = [combine([figure(rows[seed], name) for rows in found]) for seed in sorted(common)]
    values = [value for value in values if not math.isnan(value)]
    if not values or math.inf in values:
        return Measured(math.inf if values else None)
    return Measured(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None)


def difference(figures: Sequence[float]) -> float:
    """By how much the second is larger; NaN where one is infinite."""
    first, second = figures
    return second - first if math.isfinite(first) and math.isfinite(second) else math.nan


def ratio(figures: Sequence[float]) -> float:
    """The second over the first; NaN where that is 0."""
    first, second = figures
    return second / first if first else math.nan


def some(names: Sequence[str], most: int) -> str:
    """The first of the names, and how many more there are."""
    return "; ".join([*names[:most], *([f"{len(names) - most} more"] if names[most:] else [])])
