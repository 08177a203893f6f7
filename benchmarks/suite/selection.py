"""Which cells of a suite are run: those that --only leaves, less those of --rows; and the plan of a dry run."""
from __future__ import annotations

from typing import Any, Dict, List, Mapping, Sequence

from ..errors import BenchError
from .expansion import AXIS_OF
from .rows import Row, read_rows

SELECTORS = ("method", "scene", *AXIS_OF.values(), "headline")


def earlier_rows(path: str, cells: List[Dict[str, Any]]) -> Dict[str, Row]:
    """Those of a file, or of a folder of results, that are of these cells, by name. Raises BenchError without any."""
    rows, names = read_rows(path), {cell["id"] for cell in cells}
    found = {row["cell"]: row for row in rows if row["cell"] in names}
    if not found:
        raise BenchError(f"--rows {path}: none of its {len(rows)} rows is of a cell of this suite")
    return found


def chosen(cells: List[Dict[str, Any]], only: Sequence[str]) -> List[Dict[str, Any]]:
    """The cells for which every "field=value" holds; several values of one field may be given. Raises BenchError."""
    wanted: Dict[str, List[str]] = {}
    for text in only:
        field, equals, value = text.partition("=")
        if not equals or field not in SELECTORS:
            raise BenchError(f"--only {text}: must be FIELD=VALUE with a field of {', '.join(SELECTORS)}")
        there = [_said(cell, field) for cell in cells]
        if not any(_same(entry, value) for entry in there):
            raise BenchError(f"--only {field}={value}: no cell of the suite is so; its cells have "
                             + ", ".join(dict.fromkeys(map(str, there))))
        wanted.setdefault(field, []).append(value)
    found = [cell for cell in cells
             if all(any(_same(_said(cell, field), value) for value in values) for field, values in wanted.items())]
    if not found:
        raise BenchError(f"--only {' '.join(only)}: no cell of the suite is so")
    return found


def _said(cell: Dict[str, Any], field: str) -> Any:
    return {"method": cell["method"]["label"], "scene": cell["scene"]["name"],
            "budget": cell.get("budget", 0)}.get(field, cell.get(field))


def _same(value: Any, text: str) -> bool:
    try:
        return value == float(text) if isinstance(value, float) else str(value).lower() == text.lower()
    except ValueError:
        return False


def plan(cells: List[Dict[str, Any]], done: Mapping[str, Row], absent: Sequence[str]) -> str:
    """What --dry-run prints: a line for each cell, what is not there yet, and how many cells are how far."""
    states = ["to do" if cell["id"] not in done else "done" if done[cell["id"]]["ok"] else "failed" for cell in cells]
    counts = ", ".join(f"{states.count(state)} {state}" for state in ("done", "to do", "failed"))
    return "\n".join([*(f"{state}  {cell['id']}" for state, cell in zip(states, cells)), *absent, counts])
