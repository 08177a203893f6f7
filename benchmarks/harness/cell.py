"""One cell: one training and its measurement, from a file of plain values to a row.

    python -m dsmoe.bench.cell CELL.json OUT [--gpus 0,1 --per-device 2 --locks FOLDER]

OUT/row.json is always written, unless this command itself is killed and has to be started again. The work
is done in a process of its own, whose end, a crash or a lack of memory included, becomes a row with the reason.
OUT/log.txt is what it printed.
"""
from __future__ import annotations

import argparse
import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import IO, Any, Dict, List, Optional, Tuple

from ..errors import TrainerError
from ..system.children import die_with_parent
from ..system.files import write_json_atomically
from ..system.output_folder import locked
from .errors import last_line
from .names import ROW_NAME, read_json

LOG_NAME = "log.txt"
SHARING = {"cuda": "cells_per_gpu", "cpu": "cells_at_once"}  # what a row's machine calls it, by device
SHARING_NAME = "cells_at_once.json"  # the seconds of the run's checkpoint were counted while so many shared the device
AXES = ("blend_mode", "background_gate", "strategy", "densify_grad_threshold", "seed", "headline")
FIGURES = ("psnr", "psnr_float", "ssim", "psnr_edge", "num_gaussians", "train_seconds", "fps", "peak_gpu_mib")


def identity(cell: Dict[str, Any]) -> Dict[str, Any]:
    method, scene = cell["method"], cell["scene"]
    return {"cell": cell["id"], "suite": cell["suite"], "method": method["name"], "label": method["label"],
            "variant": method["variant"], "scene": scene["name"], "dataset": scene["dataset"],
            **{axis: cell[axis] for axis in AXES}, "faint_below": cell.get("faint_below"),
            "iterations": cell["protocol"]["iterations"], "end": method.get("end"),
            "budget": cell.get("budget", method.get("budget"))}


def failed_row(cell: Dict[str, Any], reason: str, wall_seconds: Optional[float]) -> Dict[str, Any]:
    return {**identity(cell), "ok": False, "reason": reason, **dict.fromkeys(FIGURES),
            "lpips": {"value": None, "kind": next(iter(cell["protocol"]["lpips"]), None), "reason": "the cell failed"},
            "lpips_all": [], "size_bytes": {"own": None, "common": None}, "wall_seconds": wall_seconds,
            "protocol": {}, "commit": {"project": None, "trainer": None}, "machine": {}, "history": [], "per_view": []}


def measured_row(cell: Dict[str, Any], output: str, started: float, per_device: Optional[int]) -> Dict[str, Any]:
    """Trains and measures; per_device is as in `supervise`."""
    from ..results.rows import result_row
    from ..system.environment import machine, versions
    from . import methods, protocol
    from .measure import headline_lpips

    earlier = note_sharing(output, per_device)
    outcome = methods.run(cell, output)
    if outcome.notes.get("continued"):  # train_seconds goes on from what the earlier attempt counted
        per_device = max(filter(None, (per_device, earlier)), default=None)
    config, evaluation = protocol.config_of(cell, output), outcome.evaluation
    sharing = {} if per_device is None else {SHARING[config.device]: per_device}
    trained = result_row(config, outcome.scene, outcome.num_gaussians, outcome.train_seconds, evaluation)
    write_images(output, outcome)
    return {**identity(cell), "ok": True, "reason": None,
            **{name: evaluation.metrics.get(name) for name in ("psnr", "psnr_float", "ssim", "psnr_edge")},
            "lpips": headline_lpips(outcome.lpips), "lpips_all": outcome.lpips, "num_gaussians": outcome.num_gaussians,
            "size_bytes": {"own": outcome.own_bytes, "common": outcome.common_bytes},
            "train_seconds": outcome.train_seconds, "wall_seconds": time.time() - started, "fps": evaluation.fps,
            "peak_gpu_mib": outcome.peak_gpu_mib,
            "protocol": {**protocol.protocol_of(trained["protocol"], config, outcome.lpips), **outcome.notes},
            "commit": {"project": protocol.project_commit(), "trainer": outcome.commit},
            "machine": {"device": machine(config.device), "versions": versions(), **sharing},
            "history": outcome.history, "per_view": evaluation.per_view}


def note_sharing(output: str, per_device: Optional[int]) -> Optional[int]:
    """Writes into the cell's folder how many cells may have the device; returns the most of earlier attempts."""
    path = Path(output, SHARING_NAME)
    earlier = read_json(path) if path.is_file() else None
    if (per_device or 0) > (earlier or 0):
        write_json_atomically(str(path), per_device)
    return earlier


def write_images(output: str, outcome: Any) -> None:
    """OUT/images/{gt,render}/NAME.png of the views whose renderings were kept."""
    from ..inspection import to_image
    from ..results.pictures import file_names

    names = [view.camera.name for view in outcome.scene.test]
    for file, view in zip(file_names(names), outcome.scene.test):
        if view.camera.name in outcome.renders:
            for kind, image in (("gt", view.image_float()), ("render", outcome.renders[view.camera.name])):
                folder = Path(output, "images", kind)
                folder.mkdir(parents=True, exist_ok=True)
                to_image(image).save(folder / f"{file}.png")


def work(cell: Dict[str, Any], output: str, started: float, per_device: Optional[int] = None) -> None:
    """The inner process: writes the row, and removes what is no longer needed. Raises nothing but what kills it."""
    try:
        row = measured_row(cell, output, started, per_device)
    except TrainerError as error:
        row = failed_row(cell, str(error), time.time() - started)
    except Exception as error:  # whatever it is, it is the row's reason; KeyboardInterrupt and SystemExit are not
        traceback.print_exc()
        row = failed_row(cell, f"{type(error).__name__}: {error}", time.time() - started)
    write_json_atomically(os.path.join(output, ROW_NAME), row)
    if row["ok"] and not cell["keep_models"]:
        shutil.rmtree(os.path.join(output, "run"), ignore_errors=True)


def supervise(cell_path: str, output: str, gpu: Optional[str] = None, per_device: Optional[int] = None,
              held: Optional[IO[str]] = None) -> Dict[str, Any]:
    """Runs `work` in a process of its own, which ends with this one, and returns the row that is in OUT then.

    gpu: those that the process is given, "0" or "0,1"; None: as the machine has them. per_device: how many cells may
    have that GPU, or on the CPU this machine, at once; None if nobody counts. held: a lock that the process has too.
    """
    cell = read_json(cell_path)
    os.makedirs(output, exist_ok=True)
    row_path, log_path = os.path.join(output, ROW_NAME), os.path.join(output, LOG_NAME)
    if os.path.isfile(row_path):
        os.remove(row_path)
    environment = dict(os.environ, PYTHONUNBUFFERED="1", **({} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu}))
    command = [sys.executable, *["-I"] * sys.flags.isolated, "-m", __spec__.name, cell_path, output, "--inside"]
    command += ["--per-device", str(per_device)] if per_device is not None else []
    started = time.time()
    with open(log_path, "ab") as log:
        status = subprocess.call(command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                                 env=environment, preexec_fn=die_with_parent, pass_fds=[held.fileno()] if held else [])
    if not os.path.isfile(row_path):
        write_json_atomically(row_path, failed_row(cell, how_it_ended(status, log_path), time.time() - started))
    return read_json(row_path)


def how_it_ended(status: int, log_path: str) -> str:
    words = last_line(log_path)
    how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
    memory = "; the system may have been out of memory" if status == -signal.SIGKILL else ""
    return f"the process {how}{memory}" + (f"; its last line: {words}" if words else "")


def claim_gpu(gpus: List[str], folder: str, per_gpu: int = 1, poll_seconds: float = 1.0) -> Tuple[str, IO[str]]:
    """Waits for a GPU that fewer than per_gpu cells of these locks have: one that none has, if there is one.

    Returns its name and the lock, which must stay open. Snakemake counts GPUs, but does not say which is free.
    """
    import fcntl

    os.makedirs(folder, exist_ok=True)
    while True:
        for slot, gpu in itertools.product(range(per_gpu), gpus):
            lock = open(os.path.join(folder, f"gpu_{gpu}_{slot}.lock"), "w")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return gpu, lock
            except OSError:
                lock.close()
        time.sleep(poll_seconds)


def main(argv: Optional[List[str]] = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m dsmoe.bench.cell",
                                     description="Trains and measures one cell of a suite.")
    parser.add_argument("cell", metavar="CELL.json", help="what is trained on what, as plain values")
    parser.add_argument("output", metavar="OUT", help="folder of row.json, log.txt and images")
    parser.add_argument("--gpus", metavar="N,N", default="",
                        help="take of these GPUs as many as the cell says, one if nothing")
    parser.add_argument("--per-device", metavar="K", type=int,
                        help="cells that may have one GPU, or on the CPU this machine, at once; the row says it "
                             "(default: 1 with --gpus, else nothing is said)")
    parser.add_argument("--locks", metavar="FOLDER", help="where cells tell each other which GPU they have")
    parser.add_argument("--hold", metavar="FILE",
                        help="a lock that is held, together with other cells; ends with what started this command")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.inside:
        work(read_json(arguments.cell), arguments.output, time.time(), arguments.per_device)
        return 0
    gpu, held, per_device = None, None, arguments.per_device
    try:  # the locks are held until the process ends
        if arguments.hold:
            die_with_parent()
            held = locked(arguments.hold, shared=True)
        if arguments.gpus:
            per_device = per_device or 1
            claims = [claim_gpu(arguments.gpus.split(","), arguments.locks or arguments.output, per_device)
                      for _ in range(read_json(arguments.cell)["protocol"].get("gpus", 1))]
            gpu = ",".join(name for name, _ in claims)
        row = supervise(arguments.cell, arguments.output, gpu, per_device, held)
    except TrainerError as error:
        print(f"{arguments.cell}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    psnr = "-" if row.get("psnr") is None else f"{row['psnr']:.2f}"
    try:
        print(f"{row['cell']}:", f"{row['num_gaussians']} Gaussians, PSNR {psnr} dB" if row["ok"] else
              f"failed: {row['reason']}", flush=True)
    except (OSError, ValueError):  # Snakemake would remove the row of a command that failed here
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
