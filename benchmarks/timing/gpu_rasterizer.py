"""Times the CUDA rasterizer beside every public one that is found, on the same model, cameras and card, in one run.

    python benchmarks/timing/gpu_rasterizer.py --npz PACKED.npz --peers-path DIR
    python benchmarks/timing/gpu_rasterizer.py --ply MODEL.ply --scene SCENE [--resolution 1]
    python benchmarks/timing/gpu_rasterizer.py --synthetic 1000000

DIR holds one folder a peer (inria, dr_aa, accel, speedy, fastergs, gsplat), each with that peer's importable package:
`pip install --no-deps --target DIR/inria PATH_OR_URL`. benchmarks/README.md explains the output.
"""
from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from typing import Any, Dict, List

import models
import torch
from gpu_renderers import RENDERERS, renderer_named

from diff_smoe_rasterization import build_info


def machine() -> Dict[str, Any]:
    """The card, its driver and what runs on it."""
    try:
        driver = subprocess.run(["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"],
                                stdout=subprocess.PIPE, universal_newlines=True, check=True).stdout.split("\n")[0]
    except (OSError, subprocess.CalledProcessError):
        driver = "unknown"
    return {"gpu": torch.cuda.get_device_name(), "driver": driver, "torch": torch.__version__,
            "cuda": torch.version.cuda, "version": build_info()["version"]}


def found(peers_path: str) -> List[str]:
    """Names of the renderers whose package is there; ours always are."""
    def has_package(folder):
        path = os.path.join(peers_path, folder)
        return os.path.isdir(path) and bool(os.listdir(path))

    return [name for name, renderer in RENDERERS.items()
            if not renderer.folder or peers_path and has_package(renderer.folder)]


def measure(name: str, options: argparse.Namespace, model: str, folder: str) -> Dict[str, Any]:
    """The row of one renderer, measured in a process of its own."""
    path = os.path.join(folder, name.replace(" ", "_") + ".json")
    request = {"renderer": name, "model": model, "folder": folder, "peers_path": options.peers_path or "",
               **{option: getattr(options, option) for option in ("views", "width", "height", "warmup", "repeats")}}
    with open(path, "w", encoding="utf-8") as file:
        json.dump(request, file)
    worker = os.path.join(os.path.dirname(os.path.abspath(__file__)), "gpu_worker.py")
    try:
        run = subprocess.run([sys.executable, worker, path], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                             universal_newlines=True, timeout=options.timeout)
        output, failure = run.stdout, f"its process ended with status {run.returncode}"
    except subprocess.TimeoutExpired:
        output, failure = "", f"not done after {options.timeout:g} s"
    try:
        with open(path + ".row", encoding="utf-8") as file:
            row = json.load(file)
    except FileNotFoundError:
        row = {"renderer": name, "error": failure}
    if "error" in row:
        print(f"{name}: {row['error']}\n{output[-2000:]}", file=sys.stderr)
    return row


def cell(value, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, (int, float)) else ""


def markdown(header, rows) -> str:
    """A table whose columns, but the first, lie to the right."""
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def comparison_table(rows: List[Dict[str, Any]]) -> str:
    # Whose results the others were compared with: the first that rendered.
    reference = next((row for row in rows if "forward_ms" in row and "psnr" not in row), rows[0])

    def ratio(row, name):
        return cell(reference[name] / row[name], 2) if name in row and name in reference else ""

    name = reference["renderer"]
    header = ["", "forward ms", "forward + backward ms", f"times {name}'s speed, forward", "forward + backward",
              "wall ms, forward", "forward + backward", "peak MiB", "outside torch MiB", "PSNR dB, worst view",
              "cosine of dL/dmeans"]
    lines = [[row["renderer"], cell(row.get("forward_ms"), 3), cell(row.get("total_ms"), 3), ratio(row, "forward_ms"),
              ratio(row, "total_ms"), cell(row.get("forward_wall_ms"), 3), cell(row.get("total_wall_ms"), 3),
              cell(row.get("peak_mib"), 0), cell(row.get("outside_torch_mib"), 0), cell(row.get("psnr_worst"), 1),
              cell(row.get("cosine"), 5)] for row in rows]
    notes = [f"- {row['renderer']}: {row[key]}" for row in rows for key in ("note", "error") if row.get(key)]
    return "\n".join([markdown(header, lines), "", f"PSNR and cosine against {name}.", *notes])


def stage_table(rows: List[Dict[str, Any]]) -> str:
    """Every stage of ours with its floor; a share is floor / measured."""
    rows = [row for row in rows if "stages" in row]
    if not rows:
        return ""
    names = list(rows[0]["stages"])
    lines = []
    for row in rows:
        stages = row["stages"]
        lines.append([row["renderer"] + ", ms"] + [cell(stages[name]["ms"], 3) for name in names]
                     + [cell(sum(stages[name]["ms"] for name in names), 3)])
        lines.append(["floor, ms"] + [
            cell(stages[name]["floor_ms"], 3)
            + (" (pairs)" if stages[name]["instructions_ms"] > stages[name]["bytes_ms"] else "") for name in names]
            + [cell(sum(stages[name]["floor_ms"] for name in names), 3)])
        lines.append(["times the floor"] + [
            cell(stages[name]["ms"] / stages[name]["floor_ms"], 1) if stages[name]["floor_ms"] else ""
            for name in names] + [""])
    counts = ["- {}: {:.2f} M of {:.2f} M Gaussians visible, {:.2f} M tile instances, {:.0f} and {:.0f} pairs a pixel "
              "forward and backward".format(
                  row["renderer"], c["visible"] / 1e6, c["gaussians"] / 1e6, c["instances"] / 1e6,
                  c["forward_pairs"] / c["pixels"], c["backward_pairs"] / c["pixels"])
              for row in rows for c in [row["counts"]]]
    return "\n".join([markdown(["", *names, "sum"], lines), "", *counts])


def parse(arguments):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--npz", help="packed model with its cameras: xyz f_dc f_rest opacity scale quat R t fx fy "
                        "width height")
    parser.add_argument("--ply", help="trained model instead; with --scene")
    parser.add_argument("--scene", help="its scene folder, whose test views are rendered")
    parser.add_argument("--resolution", type=int, default=1, help="as in `dsmoe train`")
    parser.add_argument("--synthetic", type=int, metavar="N", help="N made-up Gaussians instead")
    parser.add_argument("--width", type=int, help="of the images; default: the model's")
    parser.add_argument("--height", type=int)
    parser.add_argument("--views", type=int, default=8, help="at most so many, evenly chosen")
    parser.add_argument("--peers-path", help="folder of the other rasterizers' folders")
    parser.add_argument("--renderers", help=f"comma-separated, of {', '.join(RENDERERS)}, also with other gates; "
                        "default: all that are found")
    parser.add_argument("--warmup", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--timeout", type=float, default=240, help="seconds a renderer")
    parser.add_argument("--save-npz", metavar="FILE", help="only write the model there as --npz reads it")
    parser.add_argument("--json", help="write all figures there")
    options = parser.parse_args(arguments)
    if sum(value is not None for value in (options.npz, options.ply, options.synthetic)) != 1:
        parser.error("give one of --npz, --ply and --synthetic")
    if (options.ply is None) != (options.scene is None):
        parser.error("--ply and --scene go together")
    if min(options.views, options.repeats) < 1 or options.warmup < 0:
        parser.error("--views and --repeats must be at least 1, --warmup at least 0")
    names = options.renderers.split(",") if options.renderers else found(options.peers_path)
    try:
        options.renderers = sorted(names, key=lambda name: [*RENDERERS, name].index(name))
        first, *_ = map(renderer_named, options.renderers)
    except ValueError as error:
        parser.error(f"--renderers: {error}: none of {', '.join(RENDERERS)}, nor of ours with another gate")
    if not first.is_alpha:
        parser.error(f"--renderers must hold one of {', '.join(n for n, r in RENDERERS.items() if r.is_alpha)}")
    return options


def packed_model(options: argparse.Namespace, folder: str) -> str:
    """Path of the model as .npz."""
    if options.npz:
        return options.npz
    model = (models.from_files(options.ply, options.scene, options.resolution) if options.ply
             else models.synthetic(options.synthetic))
    path = options.save_npz or os.path.join(folder, "model.npz")
    models.to_npz(model, path)
    return path


def main(arguments=None) -> int:
    options = parse(arguments)
    with tempfile.TemporaryDirectory() as folder:
        path = packed_model(options, folder)
        if options.save_npz:
            return 0
        rows = []
        for name in options.renderers:
            rows.append(measure(name, options, path, folder))
            print(f"{name}: {cell(rows[-1].get('total_ms', rows[-1].get('forward_ms')), 3)} ms", file=sys.stderr)
    about = machine()
    first = next((row for row in rows if "gaussians" in row), {})
    print("{gpu}, driver {driver}, torch {torch}, CUDA {cuda}".format(**about))
    print(f"{options.npz or options.ply or 'synthetic'}: {first.get('gaussians', 0):,} Gaussians, "
          f"{first.get('width')}x{first.get('height')}, {first.get('views')} views, "
          f"medians of {options.repeats}\n")
    print(comparison_table(rows) + "\n")
    print(stage_table(rows))
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump({**about, "model": options.npz or options.ply or "synthetic", "repeats": options.repeats,
                       "rows": rows}, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
