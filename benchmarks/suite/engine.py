"""Runs a suite with Snakemake: what is still to be done, how many cells at once, on which GPUs or in which queue.

What is done is what has a row, so that a run that was killed continues where it was. RESULTS/rows.jsonl is the
concatenation of the rows.
"""
from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
from functools import partial
from typing import IO, Any, Dict, List, Mapping, Optional, Sequence

from ...trainer.system.files import write_json_atomically, write_text_atomically
from ...trainer.system.output_folder import make_folder, only_one
from ..errors import BenchError
from . import require
from .cell import SHARING, identity, shown
from .expansion import NOT_IN_THE_IDENTITY, Suite, find_suite, load_suite
from .names import CELL_NAME, CELLS_FOLDER, ROW_NAME, ROWS_NAME, SUITE_NAME, blend_of
from .preparation import made_scene, prepared_method, what_is_missing
from .processes import die_with_parent
from .protocol import COMMIT_VARIABLE, ROOT, project_commit
from .rows import CellFile, CellRow, Row, cell_folders, read_object
from .selection import chosen, earlier_rows, plan
from .weights import check_weights, files_of_weights

SNAKEFILE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "Snakefile")


def run_suite(name: str, results: Optional[str] = None, jobs: Optional[int] = None,
              slurm: Optional[Sequence[str]] = None, retry_failed: bool = False, dry_run: bool = False,
              only: Sequence[str] = (), per_gpu: int = 1, rows: Optional[str] = None) -> List[Row]:
    """Runs what is not done of a suite; returns the rows of its cells, failed ones included.

    name: a file or a shipped suite. results: by default bench_results/NAME. jobs: cells at once, by default per_gpu
    on each GPU, or one on the CPU. slurm: None, or Snakemake's default resources ("slurm_partition=gpu"). only:
    "field=value" of cells that are run. per_gpu: cells that one GPU is given at once. Where it, or jobs on the CPU, is
    beyond 1, times are not the machine's own, and rows say so. rows: a file of rows, or a folder, whose cells
    are not run again, failed ones neither unless retry_failed. Raises BenchError.

    Where nothing is to be done, neither a GPU nor Snakemake is needed.
    """
    suite = load_suite(find_suite(name))
    check_sharing(suite, jobs, slurm, per_gpu)
    check_weights(suite.protocol["lpips"])
    cells = chosen(suite.cells, only)
    results = os.path.abspath(results or os.path.join("bench_results", suite.name))
    earlier = earlier_rows(rows, suite.cells) if rows else {}
    check_folder(suite, results)
    done: Dict[str, Row] = {}
    for cell in cells:
        known = [read_row(results, cell["id"]), earlier.get(cell["id"])]
        usable = [row for row in known if row and (row["ok"] or not retry_failed)]
        if usable:
            done[cell["id"]] = usable[0]
    if rows:
        print(f"{sum(row is earlier.get(name) for name, row in done.items())} of {len(cells)} cells taken from {rows}")
    to_do = [cell for cell in cells if cell["id"] not in done]
    absent = what_is_missing(to_do)
    if dry_run:
        print(plan(cells, done, absent))
        return []
    if absent:
        more = f" ({len(absent) - 1} more: --dry-run names them)" if absent[1:] else ""
        raise BenchError(f"{absent[0]}, or leave it out with --only{more}")
    words = command(suite, to_do, results, jobs, slurm, per_gpu) if to_do else None
    make_folder(results)
    with only_one(results) as lock:
        write_cells(suite, cells, results, done)
        try:
            status = run_snakemake(words, lock, is_queued=slurm is not None) if words else 0
        finally:
            measured = collect(results)
    here = [measured[cell["id"]] for cell in cells if cell["id"] in measured]
    lacking = len(cells) - len(here)
    if status != 0 or lacking:
        log = os.path.join(results, ".snakemake", "log")
        raise BenchError(f"snakemake ended with status {status}; {lacking} of {len(cells)} cells have no row yet. The "
                         f"same command continues; {log if os.path.isdir(log) else 'what it printed'} says what "
                         "happened")
    return here


def check_folder(suite: Suite, results: str) -> None:
    """Raises BenchError where the folder has rows of another suite or of another protocol, or a row that is none.

    What it is a row of, its cell's file says. Scenes and methods that are new, and values of the axes, may be added.
    """
    if os.path.exists(results) and not os.path.isdir(results):
        raise BenchError(f"{results}: is a file; it must be a folder, or a name where there is nothing yet")
    here = {"": {"name": suite.name}, "protocol.": suite.protocol,
            **{f"scene {scene['name']}: ": scene for scene in suite.scenes},
            **{f"method {method['label']}: ": method for method in suite.methods}}
    differ: List[str] = []
    for name in cell_folders(results):
        cell = read_object(os.path.join(results, CELLS_FOLDER, name, CELL_NAME), CellFile)
        if cell is None or read_row(results, name) is None:
            continue
        there = {"": {"name": cell["suite"]}, "protocol.": cell["protocol"],
                 f"scene {cell['scene'].get('name')}: ": cell["scene"],
                 f"method {cell['method'].get('label')}: ": cell["method"]}
        differ += [f"{what}{field} is {there[what].get(field)!r} there and {here[what].get(field)!r} here"
                   for what in there if what in here
                   for field in sorted({*there[what], *here[what]} - {*NOT_IN_THE_IDENTITY, "axes", "refused"})
                   if there[what].get(field) != here[what].get(field)]
    if differ:
        raise BenchError(f"{results}: holds rows of another suite or of another protocol, which are not put together: "
                         f"{'; '.join(dict.fromkeys(differ))}. Choose another folder with -o")


def run_snakemake(words: List[str], lock: IO[str], is_queued: bool) -> int:
    """Runs Snakemake, which inherits the lock and shares it with its cells (cell.py, --hold); returns its status.

    Where this process is interrupted or ends, however it ends, Snakemake is killed, since on a signal that it can catch
    it waits for the cells that run here. Those of a queue it is to cancel (is_queued): it gets one SIGINT. A second one
    would end it before it has, and so would a SIGHUP; in a session of its own it does not get the terminal's.
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
    """Writes RESULTS/suite.json and each cell's file, with scenes made and checkouts patched. Raises BenchError.

    done: rows by their cell's name; those of elsewhere are written here, as the suite's own.
    """
    scenes: Dict[str, Dict[str, Any]] = {}
    methods: Dict[str, Dict[str, Any]] = {}
    for cell in cells:
        folder = os.path.join(results, CELLS_FOLDER, cell["id"])
        file, row = os.path.join(folder, CELL_NAME), os.path.join(folder, ROW_NAME)
        if cell["id"] in done:
            if not os.path.isfile(row):
                write_json_atomically(row, {**done[cell["id"]], **identity(cell)})
            if not os.path.isfile(file):
                write_json_atomically(file, cell)
            continue
        scene, method = cell["scene"]["name"], cell["method"]["label"]  # what no cell needs is not prepared
        if scene not in scenes:
            scenes[scene] = made_scene(cell["scene"], results)
        if method not in methods:
            methods[method] = prepared_method(cell["method"], results)
        write_json_atomically(file, {**cell, "scene": scenes[scene], "method": methods[method]})
        if os.path.isfile(row):
            os.remove(row)
    said = {"name": suite.name, "protocol": suite.protocol, "cells": [cell["id"] for cell in suite.cells]}
    write_json_atomically(os.path.join(results, SUITE_NAME), said)


def read_row(results: str, name: str) -> Optional[Row]:
    """The row in a cell's folder; None where there is none. Raises BenchError where it is damaged or another cell's."""
    path = os.path.join(results, CELLS_FOLDER, name, ROW_NAME)
    row = read_object(path, CellRow)
    if row is not None and row["cell"] != name:
        raise BenchError(f"{path}: is the row of another cell, {row['cell']}; remove it to have it made anew")
    return row


def check_sharing(suite: Suite, jobs: Optional[int], slurm: Optional[Sequence[str]], per_gpu: int) -> None:
    """Raises BenchError where --jobs, --slurm and --per-gpu are out of range or do not go together."""
    for option, number in (("--jobs", jobs), ("--per-gpu", per_gpu)):
        if number is not None and number < 1:
            raise BenchError(f"{option} is {number}; it must be at least 1")
    for word in slurm or ():
        if not all(word.partition("=")):
            raise BenchError(f"--slurm {word}: must be KEY=VALUE, such as slurm_partition=gpu; the suite comes first")
    if per_gpu > 1 and (suite.protocol["device"] != "cuda" or slurm is not None):
        raise BenchError(f"--per-gpu is {per_gpu}; it is for protocol.device cuda, without --slurm")
    if per_gpu > 1 and suite.protocol.get("gpus", 1) > 1:
        raise BenchError(f"--per-gpu is {per_gpu}; it must be 1 with protocol.gpus {suite.protocol['gpus']}")


def command(suite: Suite, cells: List[Dict[str, Any]], results: str, jobs: Optional[int],
            slurm: Optional[Sequence[str]], per_gpu: int = 1) -> List[str]:
    """Snakemake's command line, for cells that are all to be run. Raises BenchError."""
    require("snakemake")
    on_gpu = suite.protocol["device"] == "cuda"
    gpus = visible_gpus() if on_gpu and slurm is None else []
    if on_gpu and slurm is None and not gpus:
        raise BenchError("protocol.device is cuda, and torch finds no CUDA device on this machine; for the "
                         "CPU set protocol.device: cpu")
    each = suite.protocol.get("gpus", 1)
    if gpus and each > len(gpus):
        raise BenchError(f"protocol.gpus is {each}, and torch finds {len(gpus)} on this machine")
    at_once = min(jobs or (len(cells) if slurm is not None else max(1, per_gpu * len(gpus) // each)), len(cells))
    # Spread over the GPUs first: no more cells share one than must. In a queue nobody counts: 0.
    per_device = 0 if slurm is not None else min(per_gpu, -(-at_once // len(gpus))) if gpus else at_once
    threads = threads_of_each(at_once) if slurm is None else threads_asked_for(slurm)
    said = {"cells": json.dumps([cell["id"] for cell in cells]), "python": sys.executable, "threads": threads,
            "gpus_each": each if on_gpu else 0, "per_device": per_device,
            "gpus": json.dumps(gpus)}  # a list: Snakemake takes a bare 0 for a number
    words = [sys.executable, "-m", "snakemake", "all", "--snakefile", SNAKEFILE, "--directory", results, "--nolock",
             "--quiet", "host", "reason", "rules", "--keep-going", "--rerun-incomplete",
             "--rerun-triggers", "mtime", "--scheduler", "greedy",
             "--config", *(f"{name}={value}" for name, value in said.items())]
    if slurm is not None:
        if importlib.util.find_spec("snakemake_executor_plugin_slurm") is None:
            raise BenchError("--slurm needs Snakemake's plugin: pip install snakemake-executor-plugin-slurm")
        words += ["--executor", "slurm", "--jobs", str(at_once)]
        # Named resources bring Snakemake's own, 1000 MB among them; with 0 a cell has what the queue gives it.
        memory = [] if any(word.startswith("mem") for word in slurm) else ["mem_mb=0"]
        words += ["--default-resources", *slurm, *memory] if slurm else []
    else:
        words += ["--cores", str(at_once * threads)]
        words += ["--resources", f"gpu={per_device * len(gpus)}"] if on_gpu else []
    headline = [f"{CELLS_FOLDER}/{cell['id']}/{ROW_NAME}" for cell in cells if cell["headline"]]
    return words + (["--prioritize", *headline] if headline else [])


def threads_of_each(at_once: int) -> int:
    """Threads of each of so many cells: as many as torch would take for one alone, if there are cores for that."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(torch.get_num_threads(), cores // at_once))


def threads_asked_for(resources: Sequence[str]) -> int:
    """Threads of a cell in Slurm's queue: what its resources say as cpus_per_task=N, else 1. Raises BenchError."""
    threads = dict(resource.partition("=")[::2] for resource in resources).get("cpus_per_task", "1")
    if not (threads.isascii() and threads.isdecimal() and int(threads)):
        raise BenchError(f"--slurm cpus_per_task={threads}: must be a number of at least 1")
    return int(threads)


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
    known = {COMMIT_VARIABLE: project_commit(), **files_of_weights()}
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path), "PYTHONSAFEPATH": "1",  # nothing of a cell's folder
            **{name: value for name, value in known.items() if value}}


def collect(results: str) -> Dict[str, Row]:
    """Every row in RESULTS/cells by its cell's name; writes RESULTS/rows.jsonl."""
    found = {name: read_row(results, name) for name in cell_folders(results)}
    rows = {name: row for name, row in found.items() if row is not None}
    write_text_atomically(os.path.join(results, ROWS_NAME), "".join(json.dumps(row) + "\n" for row in rows.values()))
    return rows


def rows_table(rows: List[Row]) -> str:
    """A line for each row: what a terminal shows at the end."""
    lines = []
    for row in rows:
        name = "  ".join([row["label"], row["scene"], blend_of(row), row.get("schedule") or "own schedule",
                          shown(row["densify_grad_threshold"], "g"), f"s{row['seed']}"])
        at_once = max((row.get("machine") or {}).get(key) or 1 for key in SHARING.values())
        told = (f"  {shown(row.get('psnr'), '.2f')} dB  SSIM {shown(row.get('ssim'), '.4f')}  "
                f"{shown(row.get('num_gaussians'), ',')} Gaussians  {shown(row.get('train_seconds'), '.1f')} s  "
                f"{shown(row.get('fps'), '.1f')} FPS" + (f" ({at_once} cells at once)" if at_once > 1 else "")
                if row["ok"] else f"  FAILED: {row.get('reason')}")
        lines.append(f"{name}:{told}")
    return "\n".join(lines)
