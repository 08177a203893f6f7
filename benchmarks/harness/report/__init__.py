"""What `dsmoe bench report` writes of a folder of results: tables, figures, images and a page.

groups.py averages rows; layouts.py says which tables there are; table.* and page.* are their texts. paper.json holds
the paper's printed figures.
"""
from __future__ import annotations

import base64
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any, Dict, List, Sequence

import jinja2
from matplotlib import colormaps
from matplotlib.colors import to_hex

from ...system.output_folder import Record, make_folder, own_record, write_record
from ..names import CELLS_FOLDER, ROWS_NAME, SUITE_NAME, read_json
from ..rows import ReportError, Row, at_once, of_one_protocol, packed, read_rows
from .curves import draw_all
from .groups import grouped, is_alone, safe_name, some
from .images import ERROR_COLORS, ERROR_FULL_SCALE, collect
from .layouts import commits, end_of, tables_of
from .tables import to_text

__all__ = ["ReportError", "report"]

PAGE_NAME = "index.html"
COMMAND = "dsmoe bench report"
MOST_ABSENT = 3  # cells without a row that are named
NOT_PROTOCOL = ("seed", "strategy", "densify_grad_threshold", "init_points", "versions", "iterations",
                "continued", "arguments", "background_gate", "budget")  # of one cell, or said otherwise


def report(results: str, output: str) -> str:
    """Writes the report of RESULTS (a folder, or one .jsonl of rows) into the folder OUTPUT; returns the page's path.

    An earlier report there is replaced once the new one is made. Raises ReportError if there are no rows, if a
    row is damaged or if rows cannot be compared, TrainerError if OUTPUT cannot be written or has something else.
    """
    rows = read_rows(results)
    make_folder(output)
    earlier = own_record(output, COMMAND).files
    with tempfile.TemporaryDirectory() as made:
        sections = [_section(results, suite, [row for row in rows if row["suite"] == suite], made)
                    for suite in sorted({row["suite"] for row in rows})]
        _write(made, "report.md", _markdown(sections))
        _write(made, ROWS_NAME, packed(rows))
        _write(made, PAGE_NAME, _page(sections, commits(rows)))
        files = [path.relative_to(made).as_posix() for path in sorted(Path(made).rglob("*")) if path.is_file()]
        write_record(output, COMMAND, Record(results, files), earlier)
        shutil.copytree(made, output, dirs_exist_ok=True)
    return os.path.join(output, PAGE_NAME)


def _section(results: str, suite: str, rows: Sequence[Row], output: str) -> Dict[str, Any]:
    """What the page shows of one suite; its tables, figures and images are written."""
    absent = _absent(results, suite, rows)
    rows, left_out = of_one_protocol(rows)
    tables = tables_of(suite, rows)
    for table in tables:
        for form in ("md", "csv", "tex"):
            _write(output, os.path.join("tables", f"{table.name}.{form}"), to_text(table, form))
    pictures = draw_all(suite, grouped(rows, end_of), os.path.join(output, "figures"))
    images = collect(results, suite, rows, output)
    here = any(os.path.isdir(os.path.join(results, CELLS_FOLDER, row["cell"])) for row in rows)
    no_images = "No images: the suite asked for none." if here else "No images: rows of another folder."
    numbers = [_number(len({row[of] for row in rows}), of) for of in ("cell", "scene", "seed")]
    counts = "{} on {}, {}; {} failed".format(*numbers, sum(not row["ok"] for row in rows) or "none") + absent
    return {"suite": suite, "id": safe_name(suite), "counts": "; ".join([counts, *left_out]), "tables": tables,
            "pictures": pictures, "images": images, "no_images": no_images, "protocols": _protocols(rows)}


def _page(sections: Sequence[Dict[str, Any]], measured_with: Sequence[str]) -> str:
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True,
                                     trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
                                     undefined=jinja2.StrictUndefined)
    environment.filters["data_url"] = lambda path: (
        "data:image/svg+xml;base64," + base64.b64encode(Path(path).read_bytes()).decode("ascii"))
    scale = ", ".join(to_hex(colormaps[ERROR_COLORS](step / 8)) for step in range(9))
    return environment.get_template("page.html").render(
        generator=COMMAND, sections=sections, commits=measured_with, error_scale=scale,
        error_full=f"{ERROR_FULL_SCALE:g}")


def _markdown(sections: Sequence[Dict[str, Any]]) -> str:
    parts = ["# Benchmark report\n"]
    for section in sections:
        parts.append(f"## {section['suite']}\n\n{section['counts']}.\n")
        parts += [to_text(table, "md") for table in section["tables"]]
        parts += [f"![{picture.alt}](figures/{picture.name}.png)\n" for picture in section["pictures"]]
    return "\n".join(parts)


def _write(folder: str, name: str, text: str) -> None:
    path = Path(folder, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _number(count: int, of: str) -> str:
    return f"{count} {of}" if count == 1 else f"{count} {of}s"


def _absent(results: str, suite: str, rows: Sequence[Row]) -> str:
    try:
        said = read_json(Path(results, SUITE_NAME))
        cells = said["cells"] if said["name"] == suite else []
        absent = sorted(set(cells) - {row["cell"] for row in rows})
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    if not absent:
        return ""
    has = "has" if len(absent) == 1 else "have"
    return f"; {len(absent)} of {_number(len(cells), 'cell')} {has} no row yet: {some(absent, MOST_ABSENT)}"


def _protocols(rows: Sequence[Row]) -> List[Dict[str, Any]]:
    measured = [row for row in rows if row["ok"]]
    found = []
    for scene in sorted({row["scene"] for row in measured}):
        here = [row for row in measured if row["scene"] == scene]
        rules: Dict[str, Dict[str, None]] = {}  # of each the values, as a set in order
        for row in here:
            said = {name: value for name, value in (row.get("protocol") or {}).items() if name not in NOT_PROTOCOL}
            said.update(iterations=row.get("iterations"), strategies=row.get("strategy") or "the method's own")
            for name, value in said.items():
                values = rules.setdefault(name.replace("_", " "), {})
                values.update({} if value is None else {_plain(name, value): None})
        beside = [at_once(row) for row in here if not is_alone(row)]
        if beside:
            words = f"{len(beside)} of {len(here)}, up to {max(beside)} at once"
            rules["cells that shared their GPU or CPU"] = {words: None}
        found.append({"scene": scene, "rules": {name: "; ".join(values) for name, values in sorted(rules.items())}})
    return found


def _plain(name: str, value: Any) -> str:
    if name == "image_size" and isinstance(value, list):
        return "×".join(map(str, value))
    return "; ".join(f"{key}: {entry}" for key, entry in value.items()) if isinstance(value, dict) else str(value)
