"""What `dsmoe bench report` writes of a folder of results: tables, figures, survey rows and a page.

rows.py reads rows and averages them; layouts.py says which tables there are and tables.py writes them; curves.py draws;
sliders.py collects images; page.py and page.html make the page; survey.py writes rows for the compression survey.
paper.json holds the paper's printed figures.
"""
from __future__ import annotations

import json
import os
import shutil
import tempfile
from typing import Any, Callable, Dict, List, Sequence

from ...trainer.output_folder import make_folder
from ..results_folder import CELLS_FOLDER, SUITE_NAME
from .rows import ReportError, Row, at_once, grouped, read_rows, safe_name, shared, some

__all__ = ["ReportError", "report"]

PARTS = ("tables", "figures", "images", "survey", "report.md")  # of a report, beside its page
MOST_ABSENT = 3  # cells without a row that are named
TABLE_FORMS = {"md": "to_markdown", "csv": "to_csv", "tex": "to_latex"}
NOT_PROTOCOL = ("seed", "schedule", "densify_grad_threshold", "init_points", "versions", "iterations",
                "continued", "arguments", "background_gate")  # of one cell, or said otherwise


def report(results: str, output: str) -> str:
    """Writes the report of RESULTS (a folder, or one .jsonl of rows) into the folder OUTPUT.

    OUTPUT/index.html, report.md, tables/, figures/, images/, survey/; an earlier report there is replaced once the new
    one is whole. Returns the page's path. Raises ReportError where there are no rows, where a row is damaged, where
    rows cannot be compared or where OUTPUT has such files of someone else, TrainerError where nothing can be written
    there, and ImportError where a library is missing.
    """
    try:
        import jinja2  # noqa: F401
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError(f"a report needs {error.name}; type: pip install '.[bench]' in the source folder") from error
    from .page import PAGE_NAME

    rows = read_rows(results)
    _refuse_files_of_others(output)
    make_folder(output)
    with tempfile.TemporaryDirectory(prefix=".report-", dir=output) as made:
        _make(results, rows, made)
        for name in (PAGE_NAME, *PARTS):  # the page first: it says that the others are a report's
            _replace(os.path.join(made, name), os.path.join(output, name))
    return os.path.join(output, PAGE_NAME)


def _make(results: str, rows: Sequence[Row], output: str) -> None:
    """Writes a report into an empty folder."""
    from . import tables
    from .curves import draw_all
    from .layouts import commits, end_of, read_paper, tables_of
    from .page import Section, write_page
    from .sliders import collect
    from .survey import write_survey

    paper, sections = read_paper(), []
    for suite in sorted({row["suite"] for row in rows}):
        members = [row for row in rows if row["suite"] == suite]
        made = tables_of(suite, members, paper)
        for form, writer in TABLE_FORMS.items():
            for table in made:
                _write(os.path.join(output, "tables", f"{table.name}.{form}"), getattr(tables, writer)(table))
        pictures = draw_all(suite, grouped(members, end_of), os.path.join(output, "figures"))
        scenes = collect(results, suite, members, output)
        write_survey(members, paper["datasets"], os.path.join(output, "survey", safe_name(suite)))
        counts = _counts(members) + _absent(results, suite, members)
        sections.append(Section(suite, safe_name(suite), counts, made, pictures, scenes,
                                _no_images(results, members), _protocols(members)))
    _write(os.path.join(output, "report.md"), _markdown(sections, tables.to_markdown))
    write_page(output, sections, commits(rows))


def _refuse_files_of_others(output: str) -> None:
    from .page import GENERATOR, PAGE_NAME

    page = os.path.join(output, PAGE_NAME)
    if os.path.isfile(page):
        with open(page, encoding="utf-8", errors="replace") as file:
            if f'content="{GENERATOR}"' not in file.read():
                raise ReportError(f"{page} is no report; name another folder")
        return
    for name in PARTS:
        if os.path.exists(os.path.join(output, name)):
            raise ReportError(f"{os.path.join(output, name)} is of no report; name another folder")


def _replace(new: str, old: str) -> None:
    """Puts a file or folder in the place of an earlier one; where there is no new one, the place is empty then."""
    if os.path.isdir(old) and not os.path.islink(old):
        shutil.rmtree(old)
    elif os.path.islink(old) or (os.path.lexists(old) and not os.path.exists(new)):
        os.remove(old)
    if os.path.exists(new):
        os.replace(new, old)


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
    text = ", ".join([f"{_number(len(rows), 'cell')} on {_number(scenes, 'scene')}", _number(seeds, "seed")])
    return text + (f"; {failed} failed" if failed else "; none failed")


def _number(count: int, of: str) -> str:
    return f"{count} {of}" if count == 1 else f"{count} {of}s"


def _absent(results: str, suite: str, rows: Sequence[Row]) -> str:
    """Which cells of the suite have no row yet, where RESULTS is a folder that lists its cells."""
    try:
        with open(os.path.join(results, SUITE_NAME), encoding="utf-8") as file:
            said = json.load(file)
        cells = said["cells"] if said["name"] == suite else []
        absent = sorted(set(cells) - {row["cell"] for row in rows})
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    if not absent:
        return ""
    return f"; {len(absent)} of {_number(len(cells), 'cell')} {'has' if len(absent) == 1 else 'have'} no row yet: " \
           f"{some(absent, MOST_ABSENT)}"


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
        beside = [row for row in measured if row["scene"] == scene and shared(row)]
        if beside:
            cells = sum(row["scene"] == scene for row in measured)
            rules["cells that shared their GPU or CPU"] = [f"{len(beside)} of {cells}, up to "
                                                           f"{max(map(at_once, beside))} at once"]
    return [{"scene": scene, "rules": {name: "; ".join(values) for name, values in sorted(rules.items())}}
            for scene, rules in sorted(found.items())]


def _plain(name: str, value: Any) -> str:
    if name == "image_size" and isinstance(value, list):
        return "×".join(map(str, value))
    return "; ".join(f"{key}: {entry}" for key, entry in value.items()) if isinstance(value, dict) else str(value)
