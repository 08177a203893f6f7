"""Rows as groups of seeds: one group for each setting and scene, and what is averaged over seeds and scenes."""
from __future__ import annotations

import math
import re
import statistics
from typing import Callable, Dict, Iterable, List, NamedTuple, Optional, Sequence, Set, Tuple

from diff_smoe_rasterization.settings import BLEND_MODES

from ...options.config import LEARNED
from ..names import blend_of
from ..rows import ReportError, Row, at_once

PAPER_ITERATIONS, PAPER_STRATEGY = 30000, "3dgs"
MILLION = 1e6
TIMES = ("train_seconds", "wall_seconds", "fps")  # of cells that shared their machine these are not its own
FIELDS = ("psnr", "psnr_float", "psnr_edge", "ssim", "num_gaussians", "peak_gpu_mib", *TIMES)
SHARED, MACHINES_DIFFER = "shared", "machines differ"  # why there is no time
DASH = "–"
UNREADABLE = r"\w+Error: \[Errno \d+\] .*?'.*?'"  # an OSError that names a file
LPIPS = "lpips:"  # the figure's name goes on with its kind, such as lpips_alex


class Setting(NamedTuple):
    method: str
    name: str  # the method's label in the suite: it tells apart what the other fields do not
    variant: Optional[str]
    blend: str  # as `blend_of` has it: each gate of smoe is a blend of its own
    strategy: Optional[str]
    threshold: Optional[float]
    budget: Optional[int]
    iterations: Optional[int]
    end: Optional[str]

    @property
    def series(self) -> Setting:
        """The setting without what is varied along a curve."""
        return self._replace(threshold=None, budget=None if self.budget is None else -1, end=None)

    @property
    def pair(self) -> Setting:
        """The setting without the blend: what alpha and smoe are compared in."""
        return self._replace(blend="")

    @property
    def mode(self) -> str:
        return self.blend.partition(" ")[0]

    def label(self, blend: bool = True) -> str:
        """Such as "native, smoe, steady"; it says whether a checkout is unpatched or fused."""
        told = self.variant in (None, "native", "patched") or self.variant in self.name
        words = [self.name if told else f"{self.name}-{self.variant}"] + [self.blend] * blend
        words += [self.strategy] if self.strategy not in (None, PAPER_STRATEGY) else []
        words += ["fixed number"] if self.budget is not None else []
        words += [f"{self.iterations:,} iterations"] if self.iterations not in (None, PAPER_ITERATIONS) else []
        return ", ".join(words)

    def amount(self) -> str:
        """What is varied along a curve."""
        words = [] if self.budget is None else [f"{self.budget:,} Gaussians"]
        words += [] if self.threshold is None else [f"{self.threshold:g}"]
        return " at ".join(words) or DASH

    def order(self) -> Tuple:
        """A sort key: methods as one list, thresholds from sparse to dense, alpha before the gated modes."""
        mode = BLEND_MODES.index(self.mode) if self.mode in BLEND_MODES else len(BLEND_MODES)
        return (self.method != "native", self.method, self.name, self.variant or "", self.strategy or "",
                self.budget is not None, self.budget or 0, self.iterations or 0, self.end != "sparse",
                -(self.threshold or 0), mode, self.blend)


class Cell(NamedTuple):
    """A mean over seeds with its sample standard deviation; or a text in its place; printed: as the paper prints it."""

    value: Optional[float] = None
    spread: Optional[float] = None  # None: of fewer than two seeds
    text: str = ""
    printed: str = ""

    def shown(self, digits: int, signed: bool = False, plus_minus: str = " ± ") -> str:
        if self.printed or self.value is None:
            return self.printed or self.text or DASH
        value = round(self.value, digits) + 0.0  # no "-0.00"
        spread = "" if self.spread is None else f"{plus_minus}{self.spread:,.{digits}f}"
        return f"{value:{'+' if signed and value else ''},.{digits}f}{spread}"

    def unrounded(self) -> str:
        if self.printed or self.value is None:
            return self.printed or self.text
        return str(int(self.value)) if float(self.value).is_integer() else repr(self.value)


class Group:
    def __init__(self, setting: Setting, scene: str, rows: Sequence[Row]):
        self.setting, self.scene = setting, scene
        self.rows, self.failed = ([row for row in rows if row["ok"] is ok] for ok in (True, False))
        self.by_seed = {row["seed"]: row for row in self.rows}
        self.figures = {seed: figures_of(row) for seed, row in self.by_seed.items()}

    def dataset(self, datasets: Dict[str, Sequence[str]]) -> Optional[str]:
        """The one that the rows name, else the one that has a scene of this name."""
        named = next((dataset for dataset, scenes in datasets.items() if self.scene in scenes), None)
        return (self.rows + self.failed)[0].get("dataset", named)

    def measured(self, name: str) -> Cell:
        return over([self], name, lambda figures: figures[0])

    def measured_or_failed(self, names: Sequence[str]) -> List[Cell]:
        """The cells of several figures; if no seed has any, the place of PSNR says so."""
        failed = bool(self.failed and not self.rows)
        return [Cell(text="failed") if failed and name == "psnr" else self.measured(name) for name in names]

    def seeds(self) -> str:
        """How many seeds the figures are of, such as "3", or "2 of 3" if one failed."""
        return str(len(self.rows)) if not self.failed else f"{len(self.rows)} of {len(self.rows) + len(self.failed)}"


def figures_of(row: Row) -> Dict[str, float]:
    """The figures of a row that is ok, by name. Times of a cell that shared its machine are left out."""
    size = row.get("size_bytes") or {}
    millions = {"num_gaussians_m": row.get("num_gaussians"), "size_own_mb": size.get("own"),
                "size_common_mb": size.get("common")}
    found = {**{name: row.get(name) for name in FIELDS},
             **{name: None if value is None else value / MILLION for name, value in millions.items()},
             **{LPIPS + lpips["kind"]: lpips.get("value") for lpips in _lpips(row)}}
    if found["ssim"] is not None:  # json has no number for the PSNR of renderings that equal the ground truth
        found.update({name: math.inf for name in ("psnr", "psnr_float") if found[name] is None})
    if row.get("background_gate") == LEARNED:
        found["learned_gate"] = (row.get("protocol") or {}).get("background_gate")
    return {name: value for name, value in found.items() if value is not None and (name not in TIMES or is_alone(row))}


def is_alone(row: Row) -> bool:
    return at_once(row) == 1


def device_of(row: Row) -> Optional[str]:
    return (row.get("machine") or {}).get("device")


def lpips_figures(groups: Iterable[Group]) -> List[str]:
    """The names of the LPIPS figures that some row has, such as lpips:lpips_alex."""
    return sorted({name for group in groups for figures in group.figures.values() for name in figures
                   if name.startswith(LPIPS)})


def lpips_reasons(rows: Iterable[Row]) -> List[str]:
    """Why kinds of LPIPS were not measured; a file that could not be read is not named: it is of another machine."""
    return sorted({f"{lpips['kind']}: {re.sub(UNREADABLE, 'weights not at hand', lpips['reason'])}"
                   for row in rows for lpips in _lpips(row) if lpips.get("value") is None and lpips.get("reason")})


def _lpips(row: Row) -> List[Row]:
    return [lpips for lpips in row.get("lpips_all") or [row.get("lpips")] if lpips and lpips.get("kind")]


def grouped(rows: Iterable[Row], end_of: Callable[[Row], Optional[str]]) -> List[Group]:
    """Groups of seeds, in order; end_of says to which end of the paper's tables a row belongs. Raises ReportError."""
    found: Dict[Tuple[Setting, str], Dict[int, Row]] = {}
    for row in rows:
        setting = Setting(row["method"], row.get("label") or row["method"], row.get("variant"), blend_of(row),
                          row.get("strategy"), row.get("densify_grad_threshold"), row.get("budget"),
                          row.get("iterations"), end_of(row))
        twin = found.setdefault((setting, row["scene"]), {}).setdefault(row["seed"], row)
        if twin is not row:
            raise ReportError(f"cells {twin['cell']} and {row['cell']} have the same setting, scene and seed "
                              f"{row['seed']}; keep one, or give their methods different labels")
    groups = [Group(setting, scene, list(members.values())) for (setting, scene), members in found.items()]
    return sorted(groups, key=lambda group: (group.scene, group.setting.order()))


def safe_name(name: str) -> str:
    """A file name, a URL and an HTML id alike."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name)


def over(groups: Sequence[Group], name: str, combine: Callable[[List[float]], float],
         seeds: Optional[Set[int]] = None) -> Cell:
    """Mean and spread of combine([the figure of each group]), over the seeds for which all groups have it.

    What combine gives as NaN is left out. Times are of one machine, or there are none.
    """
    found = [{seed for seed, figures in group.figures.items() if name in figures} for group in groups]
    common = set.intersection(*found, *([] if seeds is None else [seeds]))
    if name in TIMES and not common and not all(is_alone(row) for group in groups for row in group.rows):
        return Cell(text=SHARED)
    if name in TIMES and len({device_of(group.by_seed[seed]) for group in groups for seed in common}) > 1:
        return Cell(text=MACHINES_DIFFER)
    values = [combine([group.figures[seed][name] for group in groups]) for seed in sorted(common)]
    values = [value for value in values if not math.isnan(value)]
    if not values or math.inf in values:
        return Cell(math.inf if values else None)
    return Cell(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None)


def difference(figures: Sequence[float]) -> float:
    first, second = figures
    return second - first if math.isfinite(first) and math.isfinite(second) else math.nan


def ratio(figures: Sequence[float]) -> float:
    first, second = figures
    return second / first if first else math.nan


def some(names: Sequence[str], most: int) -> str:
    return "; ".join([*names[:most], *([f"{len(names) - most} more"] if names[most:] else [])])
