"""What `dsmoe bench report` writes of a folder of results: tables, figures, survey rows and a page.

rows.py reads rows and averages them; layouts.py says which tables there are and tables.py writes them; curves.py draws;
sliders.py collects images; page.py and page.html make the page; survey.py writes rows for the compression survey.
paper.json holds the paper's printed figures.
"""
from __future__ import annotations

import os
import shutil
from typing import Any, Callable, Dict, List, Sequence

from ..results_folder import CELLS_FOLDER
from .rows import ReportError, Row, grouped, read_rows, safe_name, shared_gpu

__all__ = ["ReportError", "report"]

FOLDERS = ("tables", "figures", "images", "survey")
TABLE_FORMS = {"md": "to_markdown", "csv": "to_csv", "tex": "to_latex"}
NOT_PROTOCOL = ("seed", "schedule", "densify_grad_threshold", "init_points", "versions", "iterations",
                "continued", "arguments")  # of one cell, or said otherwise


def report(results: str, output: str) -> str:
    """Writes the report of RESULTS (a folder, or one .jsonl of rows) into the folder OUTPUT.

    OUTPUT/index.html, report.md, tables/, figures/, images/, survey/; an earlier report there is replaced. Returns the
    page's path. Raises ReportError where there are no rows, where a row is damaged, where rows cannot be compared or
    where OUTPUT/index.html is someone else's, and ImportError where a library is missing.
    """
    try:
        import jinja2  # noqa: F401
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError(f"a report needs {error.name}; type: pip install '.[bench]' in the source folder") from error
    from . import tables
    from .curves import draw_all
    from .layouts import commits, end_of, read_paper, tables_of
    from .page import Section, write_page
    from .sliders import collect
    from .survey import write_survey

    rows, paper = read_rows(results), read_paper()
    _clear(output)
    sections = []
    for suite in sorted({row["suite"] for row in rows}):
        members = [row for row in rows if row["suite"] == suite]
        made = tables_of(suite, members, paper)
        for form, writer in TABLE_FORMS.items():
            for table in made:
                _write(os.path.join(output, "tables", f"{table.name}.{form}"), getattr(tables, writer)(table))
        pictures = draw_all(suite, grouped(members, end_of), os.path.join(output, "figures"))
        scenes = collect(results, suite, members, output)
        write_survey(members, paper["datasets"], os.path.join(output, "survey", suite))
        sections.append(Section(suite, safe_name(suite), _counts(members), made, pictures, scenes,
                                _no_images(results, members), _protocols(members)))
    _write(os.path.join(output, "report.md"), _markdown(sections, tables.to_markdown))
    return write_page(output, sections, commits(rows))


def _clear(output: str) -> None:
    """Removes an earlier report, so that no figure of it stands among the new ones."""
    from .page import GENERATOR, PAGE_NAME

    page = os.path.join(output, PAGE_NAME)
    if os.path.isfile(page):
        with open(page, encoding="utf-8", errors="replace") as file:
            if f'content="{GENERATOR}"' not in file.read():
                raise ReportError(f"{page} is no report; name another folder")
        for folder in FOLDERS:
            shutil.rmtree(os.path.join(output, folder), ignore_errors=True)
    os.makedirs(output, exist_ok=True)


def _markdown(sections: Sequence[Any], to_markdown: Callable[[Any], str]) -> str:
    """All tables and figures as one page for code hosts."""
    parts = ["# Benchmark report\n"]
    for section in sections:
        parts.append(f"## {section.suite}\n\n{section.counts}.\n")
        parts += [to_markdown(table) for table in section.tables]
        parts += [f"![{picture.alt}](figures/{picture.name}.png)\n" for picture in section.pictures]
    return "\n".join(parts)


def _write(path: str, text: str) -> None:
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)


def _counts(rows: Sequence[Row]) -> str:
    failed = sum(not row["ok"] for row in rows)
    scenes = len({row["scene"] for row in rows})
    seeds = len({row["seed"] for row in rows})
    text = f"{len(rows)} cells on {scenes} {'scene' if scenes == 1 else 'scenes'}, {seeds} " \
           f"{'seed' if seeds == 1 else 'seeds'}"
    return text + (f"; {failed} failed" if failed else "; none failed")


def _no_images(results: str, rows: Sequence[Row]) -> str:
    """Why there would be none."""
    here = any(os.path.isdir(os.path.join(results, CELLS_FOLDER, row["cell"])) for row in rows)
    return "No images: the suite asked for none." if here else "No images: rows of another folder."


def _protocols(rows: Sequence[Row]) -> List[Dict[str, Any]]:
    """Of every scene: what its rows say of their protocol, once."""
    found: Dict[str, Dict[str, Any]] = {}
    measured = [row for row in rows if row["ok"]]
    for row in measured:
        said = {name: value for name, value in (row.get("protocol") or {}).items() if name not in NOT_PROTOCOL}
        said.update(iterations=row.get("iterations"), schedules=row.get("schedule") or "the method's own")
        for name, value in said.items():
            values = found.setdefault(row["scene"], {}).setdefault(name.replace("_", " "), [])
            if value is not None and _plain(name, value) not in values:
                values.append(_plain(name, value))
    for scene, rules in found.items():
        shared = [row for row in measured if row["scene"] == scene and shared_gpu(row)]
        if shared:
            cells = sum(row["scene"] == scene for row in measured)
            rules["cells that shared a GPU"] = [f"{len(shared)} of {cells}, up to "
                                                f"{max(row['machine']['cells_per_gpu'] for row in shared)} at once"]
    return [{"scene": scene, "rules": {name: "; ".join(values) for name, values in sorted(rules.items())}}
            for scene, rules in sorted(found.items())]


def _plain(name: str, value: Any) -> str:
    if name == "image_size":
        return "×".join(map(str, value))
    return "; ".join(f"{key}: {entry}" for key, entry in value.items()) if isinstance(value, dict) else str(value)
