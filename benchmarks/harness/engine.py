"""Runs a suite with Snakemake. What is done is what has a row: a run that was killed continues where it was."""
from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
from functools import partial
from typing import IO, Any, Dict, List, Mapping, Optional, Sequence

from ..system.children import die_with_parent
from ..system.files import write_json_atomically, write_text_atomically
from ..system.output_folder import (
    Record,
    check_inside,
    make_folder,
    only_one,
    own_record,
    read_record,
    write_record,
)
from . import require
from .cell import identity
from .errors import BenchError
from .expansion import NOT_IN_THE_IDENTITY, Suite, find_suite, load_suite, refuse, said_of
from .names import (
    CELL_NAME,
    CELLS_FOLDER,
    NATIVE,
    ROW_NAME,
    ROWS_NAME,
    SELECTORS,
    SUITE_NAME,
    VARIABLES,
    blend_of,
    check_weights,
)
from .preparation import made_scene, prepared_method, what_is_missing, without_absent_checkouts
from .protocol import COMMIT_VARIABLE, ROOT, project_commit
from .rows import CellFile, CellRow, Row, at_once, cell_folders, read_object, read_rows

COMMAND = "dsmoe bench run"  # in its folders' records
SNAKEFILE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "Snakefile")


def run_suite(name: str, results: Optional[str] = None, jobs: Optional[int] = None,
              slurm: Optional[Sequence[str]] = None, retry_failed: bool = False, dry_run: bool = False,
              only: Sequence[str] = (), per_gpu: int = 1, rows: Optional[str] = None,
              device: Optional[str] = None, iterations: Optional[int] = None,
              scenes: Optional[str] = None) -> List[Row]:
    """Runs what is not done of a suite; returns the rows of its cells, failed ones included.

    name: a file or a shipped suite. results: by default bench_results/NAME. The others are the options of `dsmoe bench
    run`; slurm: None, or Snakemake's default resources. Raises BenchError. If nothing is to be done, neither a GPU
    nor Snakemake is needed.
    """
    methods = [text.partition("=")[2] for text in only if text.startswith("method=")]
    suite = load_suite(find_suite(name), device, iterations, scenes, methods)
    check_sharing(suite, jobs, slurm, per_gpu)
    check_weights(suite.protocol["lpips"])
    cells = chosen(suite.cells, only)
    results = os.path.abspath(results or os.path.join("bench_results", suite.name))
    earlier = earlier_rows(rows, suite.cells) if rows else {}
    check_folder(suite, results)
    check_own(results)
    done: Dict[str, Row] = {}
    for name in (cell["id"] for cell in cells):
        for row in (earlier.get(name), read_row(results, name)):  # the folder's own goes first
            if row and (row["ok"] or not retry_failed):
                done[name] = row
    if rows:
        print(f"{sum(row is earlier.get(name) for name, row in done.items())} of {len(cells)} cells taken from {rows}")
    to_do = [cell for cell in cells if cell["id"] not in done]
    cells, to_do, left_out = without_absent_checkouts(cells, to_do)
    absent = what_is_missing(to_do)
    if dry_run:
        print(plan(cells, done, [*left_out, *absent]))
    else:
        print(*left_out, sep="\n", end="\n" * bool(left_out))
    if absent:
        where = "listed above" if dry_run else "--dry-run names them"
        more = f" ({len(absent) - 1} more: {where})" if absent[1:] else ""
        raise BenchError(f"{absent[0]}, or leave it out with --only{more}")
    if dry_run:
        return []
    if to_do and slurm is None:
        from ..system.device import device_line  # it loads torch, which a suite does without

        print(device_line(suite.protocol["device"]), flush=True)
    words = command(suite, to_do, results, jobs, slurm, per_gpu) if to_do else None
    make_folder(results)
    with only_one(results) as lock:
        check_own(results)  # again: another command may have been at work there
        write_record(results, COMMAND, Record(suite.name, []), [])
        write_cells(suite, cells, results, done)
        try:
            status = run_snakemake(words, lock, is_queued=slurm is not None) if words else 0
        finally:
            measured = collect(results)
    here = [measured[cell["id"]] for cell in cells if cell["id"] in measured]
    lacking, log = len(cells) - len(here), os.path.join(results, ".snakemake", "log")
    refuse(status != 0 or lacking,
           f"snakemake ended with status {status}; {lacking} of {len(cells)} cells have no row yet. The same command "
           f"continues; {log if os.path.isdir(log) else 'what it printed'} says what happened")
    return here


def earlier_rows(path: str, cells: List[Dict[str, Any]]) -> Dict[str, Row]:
    """Those of a file, or of a folder of results, that are of these cells, by name. Raises BenchError without any."""
    rows, names = read_rows(path), {cell["id"] for cell in cells}
    found = {row["cell"]: row for row in rows if row["cell"] in names}
    refuse(not found, f"--rows {path}: none of its {len(rows)} rows is of a cell of this suite")
    return found


def chosen(cells: List[Dict[str, Any]], only: Sequence[str]) -> List[Dict[str, Any]]:
    """The cells for which every "field=value" holds; several values of one field may be given. Raises BenchError."""
    wanted: Dict[str, List[str]] = {}
    for text in only:
        field, equals, value = text.partition("=")
        refuse(not equals or field not in SELECTORS,
               f"--only {text}: must be FIELD=VALUE with a field of {', '.join(SELECTORS)}")
        there = dict.fromkeys(_said(cell, field) for cell in cells)
        refuse(not any(_same(entry, value) for entry in there),
               f"--only {field}={value}: no cell of the suite is so; its cells have {', '.join(map(str, there))}")
        wanted.setdefault(field, []).append(value)
    found = [cell for cell in cells
             if all(any(_same(_said(cell, field), value) for value in values) for field, values in wanted.items())]
    refuse(not found, f"--only {' '.join(only)}: no cell of the suite is so")
    return found


def _said(cell: Dict[str, Any], field: str) -> Any:
    return {"method": cell["method"]["label"], "scene": cell["scene"]["name"]}.get(field, said_of(cell, field))


def _same(value: Any, text: str) -> bool:
    try:
        return value == float(text) if isinstance(value, float) else str(value).lower() == text.lower()
    except ValueError:
        return False


def plan(cells: List[Dict[str, Any]], done: Mapping[str, Row], absent: Sequence[str]) -> str:
    states = ["to do" if cell["id"] not in done else "done" if done[cell["id"]]["ok"] else "failed" for cell in cells]
    counts = ", ".join(f"{states.count(state)} {state}" for state in ("done", "to do", "failed"))
    return "\n".join([*(f"{state}  {cell['id']}" for state, cell in zip(states, cells)), *absent, counts])


def check_folder(suite: Suite, results: str) -> None:
    """Raises BenchError if the folder has rows of another suite or of another protocol, or a damaged row."""
    def parts(cell: Mapping[str, Any]) -> Dict[str, Dict[str, Any]]:
        """What must stay as it is of a scene or a method that is there already; others may be added."""
        return {"": {"name": cell["suite"]}, "protocol.": cell["protocol"],
                f"scene {cell['scene'].get('name')}: ": cell["scene"],
                f"method {cell['method'].get('label')}: ": cell["method"]}

    refuse(os.path.exists(results) and not os.path.isdir(results),
           f"{results}: is a file; it must be a folder, or a name where there is nothing yet")
    here = {what: part for cell in suite.cells for what, part in parts(cell).items()}
    differ: List[str] = []
    for name in cell_folders(results):
        cell = read_object(os.path.join(results, CELLS_FOLDER, name, CELL_NAME), CellFile)
        if cell is None or read_row(results, name) is None:
            continue
        differ += [f"{what}{field} is {there.get(field)!r} there and {here[what].get(field)!r} here"
                   for what, there in parts(cell).items() if what in here
                   for field in sorted({*there, *here[what]} - {*NOT_IN_THE_IDENTITY, "refused"})
                   if there.get(field) != here[what].get(field)]
    refuse(differ, f"{results}: holds rows of another suite or of another protocol, which are not put together: "
                   f"{'; '.join(dict.fromkeys(differ))}. Choose another folder with -o")


def check_own(results: str) -> None:
    """Raises TrainerError if the folder has something in it, and no suite was run there."""
    cells = (os.path.join(results, CELLS_FOLDER, name, CELL_NAME) for name in cell_folders(results))
    if read_record(results, COMMAND) is None and not any(map(os.path.isfile, cells)):
        own_record(results, COMMAND)
    check_inside(results, [os.path.join(name, "a") for name in (CELLS_FOLDER, "scenes", "checkouts")])


def run_snakemake(words: List[str], lock: IO[str], is_queued: bool) -> int:
    """Runs Snakemake, which inherits the lock and shares it with its cells (cell.py, --hold); returns its status.

    However this process ends, Snakemake is killed: on a signal that it can catch it would wait for the cells that run
    here. Cells of a queue it must cancel (is_queued), so it gets one SIGINT. A second one, or a SIGHUP, would end it
    too early; in a session of its own it does not get the terminal's.
    """
    import fcntl

    end = signal.SIGINT if is_queued else signal.SIGKILL
    fcntl.flock(lock, fcntl.LOCK_SH)
    process = subprocess.Popen(words, env=environment(), pass_fds=[lock.fileno()], start_new_session=is_queued,
                               preexec_fn=partial(die_with_parent, end))
    handler = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        return process.wait()
    except BaseException:
        process.send_signal(end)
        process.wait()
        raise
    finally:
        signal.signal(signal.SIGTERM, handler)


def write_cells(suite: Suite, cells: List[Dict[str, Any]], results: str, done: Mapping[str, Row]) -> None:
    """Writes RESULTS/suite.json, each cell's file, with scenes made and checkouts patched, and rows of elsewhere."""
    scenes: Dict[str, Dict[str, Any]] = {}  # as they are run
    methods: Dict[str, Dict[str, Any]] = {}
    for cell in cells:
        folder = os.path.join(results, CELLS_FOLDER, cell["id"])
        file, row = os.path.join(folder, CELL_NAME), os.path.join(folder, ROW_NAME)
        if cell["id"] in done:
            for path, content in ((row, {**done[cell["id"]], **identity(cell)}), (file, cell)):
                if not os.path.isfile(path):
                    write_json_atomically(path, content)
            continue
        scene, method = cell["scene"]["name"], cell["method"]["label"]  # what no cell needs is not prepared
        scenes[scene] = scenes.get(scene) or made_scene(cell["scene"], results)
        methods[method] = methods.get(method) or prepared_method(cell["method"], results)
        write_json_atomically(file, {**cell, "scene": scenes[scene], "method": methods[method]})
        if os.path.isfile(row):
            os.remove(row)
    said = {"name": suite.name, "protocol": suite.protocol, "cells": [cell["id"] for cell in suite.cells]}
    write_json_atomically(os.path.join(results, SUITE_NAME), said)


def read_row(results: str, name: str) -> Optional[Row]:
    """The row in a cell's folder; None if there is none. Raises BenchError if it is damaged or another cell's."""
    path = os.path.join(results, CELLS_FOLDER, name, ROW_NAME)
    row = read_object(path, CellRow)
    other = name if row is None else row["cell"]
    refuse(other != name, f"{path}: is the row of another cell, {other}; remove it to have it made anew")
    return row


def check_sharing(suite: Suite, jobs: Optional[int], slurm: Optional[Sequence[str]], per_gpu: int) -> None:
    for option, number in (("--jobs", jobs), ("--per-gpu", per_gpu)):
        refuse(number is not None and number < 1, f"{option} is {number}; it must be at least 1")
    for word in slurm or ():
        refuse(not all(word.partition("=")),
               f"--slurm {word}: must be KEY=VALUE, such as slurm_partition=gpu; the suite comes first")
    refuse(per_gpu > 1 and (suite.protocol["device"] != "cuda" or slurm is not None),
           f"--per-gpu is {per_gpu}; it is for protocol.device cuda, without --slurm")
    gpus = suite.protocol.get("gpus", 1)
    refuse(per_gpu > 1 and gpus > 1, f"--per-gpu is {per_gpu}; it must be 1 with protocol.gpus {gpus}")


def command(suite: Suite, cells: List[Dict[str, Any]], results: str, jobs: Optional[int],
            slurm: Optional[Sequence[str]], per_gpu: int = 1) -> List[str]:
    require("snakemake")
    on_gpu, each = suite.protocol["device"] == "cuda", suite.protocol.get("gpus", 1)
    gpus = visible_gpus() if on_gpu and slurm is None else []
    refuse(on_gpu and slurm is None and not gpus,
           "protocol.device is cuda, and torch finds no CUDA device on this machine; for the CPU set protocol.device: "
           "cpu")
    refuse(gpus and each > len(gpus), f"protocol.gpus is {each}, and torch finds {len(gpus)} on this machine")
    together = min(jobs or (len(cells) if slurm is not None else max(1, per_gpu * len(gpus) // each)), len(cells))
    # Spread over the GPUs first: no more cells share one than must. In a queue nobody counts: 0.
    per_device = 0 if slurm is not None else min(per_gpu, -(-together // len(gpus))) if gpus else together
    asked = dict(word.partition("=")[::2] for word in slurm or ()).get("cpus_per_task", "1")
    refuse(not (asked.isascii() and asked.isdecimal() and int(asked)),
           f"--slurm cpus_per_task={asked}: must be a number of at least 1")
    threads = threads_of_each(together) if slurm is None else int(asked)
    said = {"cells": json.dumps([cell["id"] for cell in cells]), "python": sys.executable, "threads": threads,
            "gpus_each": each if on_gpu else 0, "per_device": per_device,
            "gpus": json.dumps(gpus)}  # a list: Snakemake takes a bare 0 for a number
    words = [sys.executable, "-m", "snakemake", "all", "--snakefile", SNAKEFILE, "--directory", results, "--nolock",
             "--quiet", "host", "reason", "rules", "--keep-going", "--rerun-incomplete",
             "--rerun-triggers", "mtime", "--scheduler", "greedy",
             "--config", *(f"{name}={value}" for name, value in said.items())]
    if slurm is not None:
        refuse(importlib.util.find_spec("snakemake_executor_plugin_slurm") is None,
               "--slurm needs Snakemake's plugin: pip install snakemake-executor-plugin-slurm")
        words += ["--executor", "slurm", "--jobs", str(together)]
        # Named resources bring Snakemake's own, 1000 MB among them; with 0 a cell has what the queue gives it.
        memory = [] if any(word.startswith("mem") for word in slurm) else ["mem_mb=0"]
        words += ["--default-resources", *slurm, *memory] if slurm else []
    else:
        words += ["--cores", str(together * threads)]
        words += ["--resources", f"gpu={per_device * len(gpus)}"] if on_gpu else []
    headline = [f"{CELLS_FOLDER}/{cell['id']}/{ROW_NAME}" for cell in cells if cell["headline"]]
    return words + (["--prioritize", *headline] if headline else [])


def threads_of_each(at_once: int) -> int:
    """Threads of each of so many cells: as many as torch would take for one alone, if there are cores for that."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(torch.get_num_threads(), cores // at_once))


def visible_gpus() -> List[str]:
    """The names of the GPUs that a cell may be given, as CUDA_VISIBLE_DEVICES takes them."""
    import torch

    count = torch.cuda.device_count()
    named = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return named[:count] if named else [str(index) for index in range(count)]


def environment() -> Dict[str, str]:
    """Of Snakemake and its cells: this package is found from any folder, and its commit is known."""
    path = [ROOT]
    path += [os.path.abspath(item) for item in os.environ.get("PYTHONPATH", "").split(os.pathsep) if item]
    known = {COMMIT_VARIABLE: project_commit(),
             **{name: os.path.abspath(os.environ[name]) for name in VARIABLES.values() if os.environ.get(name)}}
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path), "PYTHONSAFEPATH": "1",  # nothing of a cell's folder
            **{name: value for name, value in known.items() if value}}


def collect(results: str) -> Dict[str, Row]:
    found = {name: read_row(results, name) for name in cell_folders(results)}
    rows = {name: row for name, row in found.items() if row is not None}
    write_text_atomically(os.path.join(results, ROWS_NAME), "".join(json.dumps(row) + "\n" for row in rows.values()))
    return rows


def rows_table(rows: List[Row]) -> str:
    return "\n".join(map(_line, rows))


def _line(row: Row) -> str:
    def shown(field: str, form: str) -> str:
        return "-" if row.get(field) is None else format(row[field], form)

    name = "  ".join([row["label"], row["scene"], blend_of(row), row.get("strategy") or "own strategy",
                      shown("densify_grad_threshold", "g"),
                      *([f"n{row['budget']}"] if row["method"] == NATIVE and row.get("budget") else []),
                      f"s{row['seed']}"])
    if not row["ok"]:
        return f"{name}:  FAILED: {row.get('reason')}"
    return (f"{name}:  {shown('psnr', '.2f')} dB  SSIM {shown('ssim', '.4f')}  {shown('num_gaussians', ',')} Gaussians"
            f"  {shown('train_seconds', '.1f')} s  {shown('fps', '.1f')} FPS"
            + (f" ({at_once(row)} cells at once)" if at_once(row) > 1 else ""))
