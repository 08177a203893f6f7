"""Runs a suite with Snakemake: which cells are still to be done, how many at once, on which GPUs or in which queue.

What is done is what has a row, so that a run that was killed continues where it was. RESULTS/rows.jsonl is the
concatenation of the rows.
"""
from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, Dict, Iterator, List, Mapping, Optional, Sequence

from .. import patches
from ..trainer.files import write_json_atomically, write_text_atomically
from ..trainer.synthetic import write_synthetic_scene
from .cell import ROW_NAME, identity
from .errors import BenchError
from .methods.names import CHECKOUTS, NATIVE
from .protocol import COMMIT_VARIABLE, ROOT, commit_of, project_commit
from .report.rows import read_rows
from .suite import Suite, find_suite, load_suite, missing

SNAKEFILE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "Snakefile")
SUITE_NAME, ROWS_NAME = "suite.json", "rows.jsonl"
SAID_BY_THE_ID = ("method", "variant", "blend_mode", "schedule", "densify_grad_threshold", "scene", "seed",
                  "iterations")  # fields of a row
NOT_COPIED = shutil.ignore_patterns(".git", "__pycache__", "output", "outputs", "build")


def run_suite(name: str, results: Optional[str] = None, jobs: Optional[int] = None,
              slurm: Optional[Sequence[str]] = None, retry_failed: bool = False, dry_run: bool = False,
              only: Sequence[str] = (), per_gpu: int = 1, rows: Optional[str] = None) -> List[Dict[str, Any]]:
    """Runs what is not done of a suite; returns the rows of its cells, failed ones included.

    name: a file or a shipped suite. results: by default bench_results/NAME. jobs: cells at once, by default per_gpu
    on each GPU, or one on the CPU. slurm: None, or Snakemake's default resources ("slurm_partition=gpu"). only:
    "field=value" of cells that are run. per_gpu: cells that one GPU is given at once; beyond 1 their times are not the
    GPU's own, and rows say so. rows: a file of rows, or a folder of results, whose cells are not run again, failed ones
    neither unless retry_failed. Raises BenchError.
    """
    suite = load_suite(find_suite(name))
    check_sharing(suite, jobs, slurm, per_gpu)
    cells = chosen(suite.cells, only)
    results = os.path.abspath(results or os.path.join("bench_results", suite.name))
    found = earlier_rows(rows, suite.cells) if rows else {}
    earlier = {name: row for name, row in found.items() if row["ok"] or not retry_failed}
    if rows:
        taken = [cell for cell in cells if cell["id"] in earlier and not is_done(results, cell, retry_failed)]
        print(f"{len(taken)} of {len(cells)} cells taken from {rows}")
    if dry_run:
        for cell in cells:
            done = cell["id"] in earlier or is_done(results, cell, retry_failed)
            print(f"{'done' if done else 'to do'}  {cell['id']}")
        return []
    if importlib.util.find_spec("snakemake") is None:
        raise BenchError(missing("snakemake", ImportError("needs Python 3.11 or later")))
    words = command(suite, cells, results, jobs, slurm, per_gpu)
    os.makedirs(results, exist_ok=True)
    with only_one(results):
        write_cells(suite, cells, results, retry_failed, earlier)
        status = subprocess.call(words, env=environment())
        measured = collect(results)
    here = [measured[cell["id"]] for cell in cells if cell["id"] in measured]
    lacking = len(cells) - len(here)
    if status != 0 or lacking:
        raise BenchError(f"snakemake ended with status {status}; {lacking} of {len(cells)} cells have no row yet. The "
                         f"same command continues; {os.path.join(results, '.snakemake', 'log')} says what happened")
    return here


def earlier_rows(path: str, cells: List[Dict[str, Any]]) -> Dict[str, Dict[str, Any]]:
    """The rows of a file, or of a folder of results, that are of these cells, by the cells' names.

    Raises BenchError where none is, or where a row says something else of its cell than the cell does.
    """
    rows = {row["cell"]: row for row in read_rows(path)}
    found = [cell for cell in cells if cell["id"] in rows]
    if not found:
        raise BenchError(f"--rows {path}: none of its {len(rows)} rows is of a cell of this suite")
    for cell in found:
        row, expected = rows[cell["id"]], identity(cell)
        for field in SAID_BY_THE_ID:
            if row.get(field) != expected[field]:
                raise BenchError(f"--rows {path}: the row of cell {cell['id']}: {field} is {row.get(field)!r}; it must "
                                 f"be {expected[field]!r}, as the suite has it")
    return {cell["id"]: rows[cell["id"]] for cell in found}


def chosen(cells: List[Dict[str, Any]], only: Sequence[str]) -> List[Dict[str, Any]]:
    """The cells for which every "field=value" holds; several values of one field may be given. Raises BenchError."""
    wanted: Dict[str, List[str]] = {}
    for text in only:
        field, equals, value = text.partition("=")
        if not equals or field not in SELECTORS:
            raise BenchError(f"--only {text}: must be FIELD=VALUE with a field of {', '.join(SELECTORS)}")
        wanted.setdefault(field, []).append(value)
    found = [cell for cell in cells
             if all(any(_same(SELECTORS[field](cell), value) for value in values) for field, values in wanted.items())]
    if not found:
        raise BenchError(f"--only {' '.join(only)}: no cell of the suite is so")
    return found


SELECTORS = {"method": lambda cell: cell["method"]["label"], "scene": lambda cell: cell["scene"]["name"],
             "blend_mode": lambda cell: cell["blend_mode"], "schedule": lambda cell: cell["schedule"],
             "densify_grad_threshold": lambda cell: cell["densify_grad_threshold"], "seed": lambda cell: cell["seed"],
             "headline": lambda cell: cell["headline"]}


def _same(value: Any, text: str) -> bool:
    if isinstance(value, float):
        try:
            return value == float(text)
        except ValueError:
            return False
    return str(value).lower() == text.lower()


@contextmanager
def only_one(results: str) -> Iterator[None]:
    """Keeps a second run away from the same results. The lock ends with the process, however that ends."""
    import fcntl

    with open(os.path.join(results, ".lock"), "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise BenchError(f"{results}: another run is at work there") from error
        yield


def write_cells(suite: Suite, cells: List[Dict[str, Any]], results: str, retry_failed: bool,
                earlier: Mapping[str, Dict[str, Any]] = MappingProxyType({})) -> None:
    """Writes RESULTS/suite.json and each cell's file, with scenes made and checkouts patched. Raises BenchError.

    earlier: rows by their cell's name, for cells that have none here.
    """
    path = os.path.join(results, SUITE_NAME)
    here = read_json(path)
    if here is not None and (here["name"], here["protocol"]) != (suite.name, suite.protocol):
        raise BenchError(f"{results}: holds rows of the suite {here['name']!r} under another protocol; figures of "
                         "two protocols are not put together: choose another folder")
    scenes: Dict[str, Dict[str, Any]] = {}
    methods: Dict[str, Dict[str, Any]] = {}
    for cell in cells:  # what no chosen cell needs is not prepared
        scene, method = cell["scene"]["name"], cell["method"]["label"]
        if scene not in scenes:
            scenes[scene] = made_scene(cell["scene"], results)
        if method not in methods:
            methods[method] = prepared_method(cell["method"], results)
        folder = os.path.join(results, "cells", cell["id"])
        cell = dict(cell, scene=scenes[scene], method=methods[method])
        file, row = os.path.join(folder, "cell.json"), os.path.join(folder, ROW_NAME)
        if read_json(file) != cell:
            write_json_atomically(file, cell)
        if cell["id"] in earlier and not is_done(results, cell, retry_failed):
            write_json_atomically(row, {**earlier[cell["id"]], **identity(cell)})  # another suite may have had the cell
        if is_done(results, cell, retry_failed):
            os.utime(row)  # a path that has changed changes no figure: the row stays newer than its cell's file
        elif os.path.isfile(row):
            os.remove(row)
    write_json_atomically(path, {"name": suite.name, "protocol": suite.protocol, "cells": [c["id"] for c in cells]})


def is_done(results: str, cell: Dict[str, Any], retry_failed: bool) -> bool:
    """Whether a cell has a row; with retry_failed, one with figures."""
    row = read_json(os.path.join(results, "cells", cell["id"], ROW_NAME))
    return row is not None and (row["ok"] or not retry_failed)


def made_scene(scene: Dict[str, Any], results: str) -> Dict[str, Any]:
    """The scene with its path; a synthetic one is made where it is not there yet."""
    if scene["path"] is not None:
        return scene
    folder = os.path.join(results, "scenes", scene["name"])
    if not os.path.isfile(os.path.join(folder, "sparse", "0", "cameras.txt")):
        write_synthetic_scene(folder, **scene["synthetic"])
    return dict(scene, path=folder)


def prepared_method(method: Dict[str, Any], results: str) -> Dict[str, Any]:
    """The method with its checkouts as they are run: patched ones are copies in RESULTS/checkouts.

    Where a checkout cannot be used, `refused` says why: that is what its cells' rows will say.
    """
    if method["name"] == NATIVE:
        return method
    try:
        paths = {key: prepared_checkout(method, key, results) for key in ("path", "base") if key in method}
    except (patches.PatchError, BenchError, OSError) as error:
        return {**method, "refused": " ".join(str(error).split())}
    return {**method, **paths, "commit": commit_of(method["path"]) or method.get("commit")}


def prepared_checkout(method: Dict[str, Any], key: str, results: str) -> str:
    """The folder of a checkout as it is run. Raises BenchError or PatchError."""
    path = method[key]
    if not os.path.isdir(path):
        raise BenchError(f"{path}: no such folder; {method['label']} is a checkout there")
    if not CHECKOUTS[method["name"]]:
        return path
    verdict = patches.check(path)
    if method["variant"] == "unpatched" and verdict != "patchable":
        raise BenchError(f"{path} is {verdict}, and the suite says it is an unpatched checkout (`dsmoe patch revert` "
                         "takes a patch back)")
    if method["variant"] == "unpatched" or verdict == "patched":
        return path
    return patched_copy(path, os.path.join(results, "checkouts", f"{method['label']}-{key}"))


def patched_copy(path: str, folder: str) -> str:
    """A patched copy of a checkout, which itself stays as it is; made once. Raises PatchError."""
    if os.path.isdir(folder):
        patches.apply(folder, modernise=True)  # what an interruption left is finished; else nothing is written
        return folder
    part = folder + ".part"
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(path, part, ignore=NOT_COPIED)
    patches.apply(part, modernise=True)
    os.rename(part, folder)
    return folder


def check_sharing(suite: Suite, jobs: Optional[int], slurm: Optional[Sequence[str]], per_gpu: int) -> None:
    """Raises BenchError where --jobs, --slurm and --per-gpu are out of range or do not go together."""
    if jobs is not None and jobs < 1:
        raise BenchError(f"--jobs is {jobs}; it must be at least 1")
    if per_gpu < 1:
        raise BenchError(f"--per-gpu is {per_gpu}; it must be at least 1")
    if per_gpu > 1 and (suite.protocol["device"] != "cuda" or slurm is not None):
        raise BenchError(f"--per-gpu is {per_gpu}; it is for protocol.device cuda, without --slurm")


def command(suite: Suite, cells: List[Dict[str, Any]], results: str, jobs: Optional[int],
            slurm: Optional[Sequence[str]], per_gpu: int = 1) -> List[str]:
    """Snakemake's command line. Raises BenchError."""
    on_gpu = suite.protocol["device"] == "cuda"
    gpus = visible_gpus() if on_gpu and slurm is None else []
    if on_gpu and slurm is None and not gpus:
        raise BenchError("protocol.device is cuda, and torch finds no CUDA device on this machine")
    at_once = jobs or (len(cells) if slurm is not None else max(1, per_gpu * len(gpus)))
    if gpus:
        per_gpu = min(per_gpu, -(-at_once // len(gpus)))  # cells spread over the GPUs first: no more of them share one
    words = [sys.executable, "-m", "snakemake", "all", "--snakefile", SNAKEFILE, "--directory", results, "--nolock",
             "--quiet", "host", "reason", "rules", "--keep-going", "--rerun-incomplete",
             "--rerun-triggers", "mtime", "--scheduler", "greedy",
             "--config", f"cells={json.dumps([cell['id'] for cell in cells])}", f"python={sys.executable}",
             f"device={suite.protocol['device']}", f"per_gpu={per_gpu}",
             f"gpus={json.dumps(gpus)}"]  # a list: Snakemake takes a bare 0 for a number
    if slurm is not None:
        if importlib.util.find_spec("snakemake_executor_plugin_slurm") is None:
            raise BenchError("--slurm needs Snakemake's plugin: pip install snakemake-executor-plugin-slurm")
        words += ["--executor", "slurm", "--jobs", str(at_once)]
        words += ["--default-resources", *slurm] if slurm else []
    else:
        words += ["--cores", str(at_once)] + (["--resources", f"gpu={per_gpu * len(gpus)}"] if on_gpu else [])
    headline = [f"cells/{cell['id']}/{ROW_NAME}" for cell in cells if cell["headline"]]
    return words + (["--prioritize", *headline] if headline else [])


def visible_gpus() -> List[str]:
    """The names of the GPUs that a cell may be given, as CUDA_VISIBLE_DEVICES takes them."""
    import torch

    count = torch.cuda.device_count()
    named = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return named[:count] if named else [str(index) for index in range(count)]


def environment() -> Dict[str, str]:
    """Of Snakemake and its cells: this package is found from any folder, and its commit is known."""
    path = [ROOT if os.path.isfile(os.path.join(ROOT, "sources.txt")) else os.path.dirname(ROOT)]
    path += [os.path.abspath(item) for item in os.environ.get("PYTHONPATH", "").split(os.pathsep) if item]
    commit = project_commit()
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path), **({COMMIT_VARIABLE: commit} if commit else {})}


def collect(results: str) -> Dict[str, Dict[str, Any]]:
    """Every row in RESULTS/cells by its cell's name; writes RESULTS/rows.jsonl."""
    folder = os.path.join(results, "cells")
    rows = {}
    for name in sorted(os.listdir(folder)):
        row = read_json(os.path.join(folder, name, ROW_NAME))
        if row is not None:
            rows[name] = row
    lines = [json.dumps(row, sort_keys=False) for row in rows.values()]
    write_text_atomically(os.path.join(results, ROWS_NAME), "".join(line + "\n" for line in lines))
    return rows


def read_json(path: str) -> Any:
    """What a file says; None where it is absent. Raises BenchError where it is damaged."""
    if not os.path.isfile(path):
        return None
    try:
        with open(path, encoding="utf-8") as file:
            return json.load(file)
    except ValueError as error:
        raise BenchError(f"{path}: not valid json ({error}); remove it to have it made anew") from error


def rows_table(rows: List[Dict[str, Any]]) -> str:
    """A line for each row: what a terminal shows at the end."""
    lines = []
    for row in rows:
        name = f"{row['label']}  {row['scene']}  {row['blend_mode']}  {row['densify_grad_threshold']:g}  s{row['seed']}"
        at_once = row["machine"].get("cells_per_gpu") or 1
        if row["ok"]:
            lines.append(f"{name}:  {_shown(row['psnr'], '.2f')} dB  SSIM {_shown(row['ssim'], '.4f')}  "
                         f"{row['num_gaussians']:,} Gaussians  {_shown(row['train_seconds'], '.1f')} s  "
                         f"{_shown(row['fps'], '.1f')} FPS" + (f" ({at_once} cells on a GPU)" if at_once > 1 else ""))
        else:
            lines.append(f"{name}:  FAILED: {row['reason']}")
    return "\n".join(lines)


def _shown(value: Optional[float], form: str) -> str:
    return "-" if value is None else format(value, form)
