"""Rows, and how they are read from the folder RESULTS: engine.py and cell.py write them, the report reads them."""
from __future__ import annotations

import json
import math
import os
from typing import Any, Dict, List, Optional, Sequence, Tuple, Type

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, create_model
from typing_extensions import Annotated

from ..options.config import LEARNED
from .errors import BenchError
from .names import CELLS_FOLDER, ROW_NAME, ROWS_NAME
from .schema import first_mistake, must

Row = Dict[str, Any]

LARGEST = 1e18  # of a number that is a figure
FINITE = "it must be a finite number"
Number = Annotated[float, must(lambda value: abs(value) < LARGEST, FINITE)]  # NaN is not smaller either
Decibels = Annotated[float, must(lambda value: abs(value) < LARGEST or value == math.inf, FINITE)]
Gate = Annotated[Any, must(lambda value: value in (None, LEARNED) or (
    type(value) in (int, float) and abs(value) < LARGEST), f"{FINITE} or {LEARNED!r}")]
# What two rows of one scene must share to be comparable, if both say it.
RULES = ("split", "train_views", "test_views", "resolution", "image_size", "downscaler", "background",
         "principal_point", "sh_degree", "recipe", "scale_recipe")
RULE_PREFIXES = ("psnr", "ssim", "lpips", "edge", "fps", "size", "quantisation")
SHARED = "shared"  # of a line of rows: what the lines below it have, unless they say otherwise
UNREPORTED = ("per_view", "history")  # no report reads these fields, which are most of a row


class ReportError(BenchError):
    """Rows cannot be reported; the text says which and why."""


class Part(BaseModel):  # of an object that may have other fields too
    model_config = ConfigDict(strict=True)


def _may_be(kind: Any, *names: str) -> Dict[str, Any]:
    return dict.fromkeys(names, (Optional[kind], None))


Lpips = create_model("Lpips", __base__=Part, **_may_be(str, "kind"), **_may_be(Number, "value"))
Size = create_model("Size", __base__=Part, **_may_be(Number, "own", "common"))
Machine = create_model("Machine", __base__=Part, **_may_be(str, "device"),
                       **_may_be(int, "cells_per_gpu", "cells_at_once"))
RowFile = create_model(
    "RowFile", __base__=Part, cell=(str, ...), suite=(str, ...), ok=(bool, ...), method=(str, ...),
    blend_mode=(str, ...), scene=(str, ...), seed=(int, ...),
    **_may_be(str, "label", "variant", "strategy", "dataset", "end", "reason"), **_may_be(int, "budget", "iterations"),
    **_may_be(Gate, "background_gate"), **_may_be(Decibels, "psnr", "psnr_float", "psnr_edge"),
    **_may_be(Number, "densify_grad_threshold", "faint_below", "ssim", "num_gaussians", "train_seconds", "wall_seconds",
              "fps", "peak_gpu_mib"),
    **_may_be(Dict[str, Any], "protocol", "commit"), **_may_be(Size, "size_bytes"), **_may_be(Machine, "machine"),
    **_may_be(Lpips, "lpips"), **_may_be(List[Optional[Lpips]], "lpips_all"))
CellRow = create_model(  # of `dsmoe bench run`: it says all that its cell's name says
    "CellRow", __base__=RowFile, label=(str, ...), variant=(str, ...), strategy=(Optional[str], ...),
    densify_grad_threshold=(Number, ...), iterations=(int, ...))
CellFile = create_model("CellFile", __base__=Part, suite=(str, ...),
                        **dict.fromkeys(("protocol", "scene", "method"), (Dict[str, Any], ...)))


def read_object(path: str, model: Type[Any] = dict) -> Optional[Dict[str, Any]]:
    """The object of a .json file; None if there is no file. Raises BenchError if it is damaged."""
    if not os.path.isfile(path):
        return None
    try:
        return checked(_text(path), path, model)
    except BenchError as error:
        raise BenchError(f"{error}; remove it to have it made anew") from error


def checked(text: str, place: str, model: Type[Any] = RowFile) -> Row:
    """Parses a json object and checks the types of the fields that are read. Raises ReportError, which names the
    place of the text."""
    return _typed(_object(text, place), place, model)


def _object(text: str, place: str) -> Dict[str, Any]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ReportError(f"{place}: not valid json, as `dsmoe bench run` writes it ({error})") from error
    if not isinstance(found, dict):
        raise ReportError(f"{place}: expected one object, as `dsmoe bench run` writes it")
    return found


def _typed(found: Dict[str, Any], place: str, model: Type[Any] = RowFile) -> Row:
    try:
        TypeAdapter(model).validate_python(found)
    except ValidationError as error:
        lacking = [str(one["loc"][0]) for one in error.errors() if one["type"] == "missing"]
        if lacking:
            raise ReportError(f"{place}: the row lacks {', '.join(lacking)}, which those of `dsmoe bench run` "
                              "have") from error
        raise ReportError("{}: {} {}".format(place, *first_mistake(error))) from error
    return found


def read_rows(results: str) -> List[Row]:
    """The rows of RESULTS or of one .jsonl file, sorted by cell. Raises ReportError.

    A cell's own row.json wins over rows.jsonl, and there the last line of a cell.
    """
    listed = results if os.path.isfile(results) else os.path.join(results, ROWS_NAME)
    found = _listed(_text(listed), listed) if os.path.isfile(listed) else []
    paths = (os.path.join(results, CELLS_FOLDER, name, ROW_NAME) for name in cell_folders(results))
    found += [checked(_text(path), path) for path in paths if os.path.isfile(path)]
    if not found:
        raise ReportError(f"{results}: no rows: neither {CELLS_FOLDER}/*/{ROW_NAME} nor {ROWS_NAME}")
    rows = {row["cell"]: row for row in found}
    return [rows[name] for name in sorted(rows)]


def _listed(text: str, path: str) -> List[Row]:
    found: List[Row] = []
    shared: Row = {}
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            place = f"{path}, line {number}"
            entry = _object(line, place)
            if isinstance(entry.get(SHARED), dict):
                shared = entry[SHARED]
            else:
                found.append(_typed(_merged(shared, entry), place))
    return found


def _merged(shared: Row, row: Row) -> Row:
    both = {name: _merged(shared[name], value) if isinstance(value, dict) and isinstance(shared.get(name), dict)
            else value for name, value in row.items()}
    return {**shared, **both}


def packed(rows: Sequence[Row]) -> str:
    """A .jsonl to keep: what rows share stands once, in a line ahead of them, and UNREPORTED is left out."""
    kept = [{name: value for name, value in row.items() if name not in UNREPORTED} for row in rows]
    shared = _common(kept)
    lines = [{SHARED: shared}, *(_without(shared, row) for row in kept)]
    return "".join(json.dumps(line, ensure_ascii=False, separators=(",", ":")) + "\n" for line in lines)


def _common(objects: Sequence[Row]) -> Row:
    """The most common value of each field that all objects have; nested objects are treated the same way."""
    found: Row = {}
    for name in (name for name in objects[0] if all(name in entry for entry in objects)):
        values = [entry[name] for entry in objects]
        if all(isinstance(value, dict) for value in values):
            found[name] = _common(values)
        else:
            texts = [json.dumps(value) for value in values]
            found[name] = json.loads(max(texts, key=texts.count))
    return found


def _without(shared: Row, row: Row) -> Row:
    found: Row = {}
    for name, value in row.items():
        if name not in shared:
            found[name] = value
        elif isinstance(value, dict) and isinstance(shared[name], dict):
            own = _without(shared[name], value)
            found.update({name: own} if own else {})
        elif json.dumps(value) != json.dumps(shared[name]):
            found[name] = value
    return found


def at_once(row: Row) -> int:
    machine = row.get("machine") or {}
    return max(machine.get("cells_per_gpu") or 1, machine.get("cells_at_once") or 1)


def cell_folders(results: str) -> List[str]:
    folder = os.path.join(results, CELLS_FOLDER)
    return sorted(os.listdir(folder)) if os.path.isdir(folder) else []


def _text(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except UnicodeDecodeError as error:
        raise ReportError(f"{path}: not text in UTF-8 ({error})") from error


def of_one_protocol(rows: Sequence[Row]) -> Tuple[List[Row], List[str]]:
    """The rows that can stand in common tables, and in words which cannot: of each scene, those of a rarer protocol."""
    left_out: Dict[str, List[str]] = {}  # why, and the cells
    for place in sorted({(row["suite"], row["scene"]) for row in rows}):
        said = {row["cell"]: _rules(row) for row in rows if row["ok"] and (row["suite"], row["scene"]) == place}
        for name in sorted({name for rules in said.values() for name in rules}):
            cells: Dict[str, List[str]] = {}  # by what they say of the rule
            for cell, rules in said.items():
                if name in rules:
                    cells.setdefault(repr(rules[name]), []).append(cell)
            (most, first), *others = sorted(cells.items(), key=lambda item: -len(item[1])) or [("", [])]
            for value, rare in others:
                if len(rare) == len(first):
                    raise ReportError(f"suite {place[0]}, scene {place[1]}: cells of different protocols stand in no "
                                      f"common table: {name} is {most} in {first[0]} and {value} in {rare[0]}")
                left_out[f"{name} is {value} in them and {most} in {len(first)} others of {place[1]}"] = rare
                said = {cell: rules for cell, rules in said.items() if cell not in rare}
    gone = {cell for cells in left_out.values() for cell in cells}
    return ([row for row in rows if row["cell"] not in gone],
            [f"left out, since {why}: {', '.join(cells)}" for why, cells in left_out.items()])


def _rules(row: Row) -> Dict[str, Any]:
    """The rules that the row states, by name. The recipe of `importance`, which has other rates, is one of its own."""
    found: Dict[str, Any] = {}
    for name, value in (row.get("protocol") or {}).items():
        if name in RULES or name.startswith(RULE_PREFIXES):
            name = "recipe of importance" if (name, row.get("strategy")) == ("recipe", "importance") else name
            found.update({f"{name}.{key}": entry for key, entry in value.items()} if isinstance(value, dict)
                         else {name: value})
    return {name: value for name, value in found.items() if value is not None}
