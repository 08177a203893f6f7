"""Times the CPU rasterizer, forward and backward, and says how far it is from what the machine could do.

    python benchmarks/timing/cpu_rasterizer.py --ply MODEL.ply --scene SCENE [--resolution 800] [--views 0,18]
    python benchmarks/timing/cpu_rasterizer.py --npz PACKED.npz
    python benchmarks/timing/cpu_rasterizer.py --synthetic 100000

Forward is a rendering that keeps what a backward pass needs; backward goes from an image gradient to the gradients of
means3D, means2D, opacities, shs, scales and rotations. All combinations of view, mode and number of threads take turns,
so that a busy moment of the machine meets all of them. benchmarks/README.md explains every line of the output.
"""
from __future__ import annotations

import argparse
import collections
import itertools
import json
import os
import sys
import time
from statistics import fmean, median
from typing import Dict, NamedTuple

import dense_torch
import floor
import memory
import models
import torch

from diff_smoe_rasterization import BLEND_MODES, build_info, rasterize, set_profiling, stage_times
from dsmoe.system.environment import processor_name

STAGES = ("project", "sort", "bin", "blend", "blend_backward", "project_backward")
PAIRS = ("forward_pairs", "backward_pairs")
BUSY = 0.95  # processor time of a single thread as a part of the time it took; below, others were in the way


class Sample(NamedTuple):
    """One forward and backward pass, in seconds."""

    forward: float
    backward: float
    processor: float  # processor time of all threads
    stages: Dict[str, float]

    @property
    def total(self) -> float:
        return self.forward + self.backward


class Case(NamedTuple):
    view: int
    mode: str
    threads: int


def num_cores() -> int:
    """Processors that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def image_gradient(settings) -> torch.Tensor:
    """A fixed random gradient of a mean over the image."""
    shape = 3, settings.image_height, settings.image_width
    return torch.randn(shape, generator=torch.Generator().manual_seed(0)) / (shape[0] * shape[1] * shape[2])


def run(model: models.Model, case: Case) -> Sample:
    settings = model.settings(case.view, case.mode)
    dL_dcolor = image_gradient(settings)
    leaves = {name: tensor.detach().requires_grad_() for name, tensor in model.inputs.items()}
    leaves["means2D"] = torch.zeros_like(model.inputs["means3D"], requires_grad=True)
    torch.set_num_threads(case.threads)
    processor, start = time.process_time(), time.perf_counter()
    color = rasterize(settings=settings, **leaves).color
    middle = time.perf_counter()
    torch.autograd.grad(color, list(leaves.values()), dL_dcolor)
    end = time.perf_counter()
    return Sample(middle - start, end - middle, time.process_time() - processor, stage_times())


def measure(model: models.Model, cases, repeats: int) -> Dict[Case, list]:
    """Runs all cases in turn, one round more than `repeats`; the first round warms up and is dropped."""
    samples = collections.defaultdict(list)
    set_profiling(True)
    for repeat in range(repeats + 1):
        for case in cases:
            sample = run(model, case)
            if repeat:
                samples[case].append(sample)
    set_profiling(False)
    return samples


def summary(samples: Dict[Case, list], mode: str, threads: int) -> Dict[str, float]:
    """Means over views of the medians, the minima and the maxima over repeats, and of the stages."""
    views = [runs for case, runs in samples.items() if (case.mode, case.threads) == (mode, threads)]
    row = {"mode": mode, "threads": threads}
    for name in ("forward", "backward", "total"):
        row[name] = fmean(median(getattr(run, name) for run in runs) for runs in views)
    row["fastest"] = fmean(min(run.total for run in runs) for runs in views)
    row["slowest"] = fmean(max(run.total for run in runs) for runs in views)
    row["processor"] = fmean(median(run.processor for run in runs) for runs in views)
    for name in STAGES:
        row[name] = fmean(median(run.stages[name] for run in runs) for runs in views)
    for name in PAIRS:
        row[name] = fmean(runs[0].stages[name] for runs in views)
    row["other"] = max(0.0, row["total"] - sum(row[name] for name in STAGES))
    return row


def table(rows) -> str:
    """Aligned columns, the first to the left."""
    rows = [[str(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows)]
    return "\n".join("  ".join(cell.rjust(width) if i else cell.ljust(width)
                               for i, (cell, width) in enumerate(zip(row, widths))) for row in rows)


def print_machine(model: models.Model, views, threads) -> None:
    info = build_info()
    camera = model.cameras[views[0]]
    print(f"{processor_name()}, {max(threads)} of {num_cores()} cores, SIMD {info['simd_level']}, "
          f"compiler {info['compiler']}, torch {info['torch']}")
    print(f"{model.name}: {model.num_gaussians:,} Gaussians, {camera.width}x{camera.height}, "
          f"views {', '.join(model.cameras[view].name for view in views)}\n")


def print_times(rows) -> None:
    lines = [("ms", "threads", "forward", "backward", "total", "fastest", "slowest", "processor")]
    lines += [(row["mode"], row["threads"], *(f"{1e3 * row[name]:.1f}" for name in lines[0][2:])) for row in rows]
    print(table(lines))
    share = min((row["processor"] / row["total"] for row in rows if row["threads"] == 1), default=1.0)
    if share < BUSY:
        print(f"The machine was busy: single threads had a processor for {share:.0%} of their time.")
    print()


def print_ratios(rows) -> None:
    by_case = {(row["mode"], row["threads"]): row for row in rows}
    threads = sorted({row["threads"] for row in rows})
    for mode in dict.fromkeys(row["mode"] for row in rows):
        first, last = by_case[mode, threads[0]], by_case[mode, threads[-1]]
        if threads[0] != threads[-1]:
            print(f"{mode}: {first['total'] / last['total']:.2f} times faster from {threads[0]} to {threads[-1]} "
                  "threads")
    for (mode, count), row in by_case.items():
        if mode != "alpha" and ("alpha", count) in by_case:
            ratio = row["total"] / by_case["alpha", count]["total"]
            print(f"{mode} takes {ratio:.2f} times as long as alpha on {count} thread{'s' if count > 1 else ''}")
    print()


def print_stages(rows) -> None:
    lines = [("share of total, %", "threads", *STAGES, "other")]
    lines += [(row["mode"], row["threads"], *(f"{100 * row[name] / row['total']:.1f}" for name in lines[0][2:]))
              for row in rows]
    print(table(lines) + "\n")


def print_floor(rows) -> None:
    rates = {count: floor.multiply_adds_per_second(count) for count in sorted({row["threads"] for row in rows})}
    for count, rate in rates.items():
        print(f"{count} thread{'s' if count > 1 else ''}: {rate / 1e9:.1f} G multiply-adds/s in torch's matrix product")
    lines = [("arithmetic floor", "threads", "M pairs forward", "backward", "floor ms", "blend ms", "times the floor")]
    for row in rows:
        mode = row["mode"].partition(":")[0]
        row["floor"] = floor.floor_seconds(mode, *(row[name] for name in PAIRS), rates[row["threads"]])
        blend = row["blend"] + row["blend_backward"]
        lines.append((row["mode"], row["threads"], *(f"{row[name] / 1e6:.1f}" for name in PAIRS),
                      f"{1e3 * row['floor']:.1f}", f"{1e3 * blend:.1f}", f"{blend / row['floor']:.2f}"))
    print(table(lines) + "\n")


def print_memory(model: models.Model, view: int, modes, threads: int) -> Dict[str, dict]:
    lines = [("bytes beyond inputs, outputs, gradients", *("per " + unit for unit in memory.UNITS))]
    results = {}
    for mode in modes:
        counts, kept = memory.kept_tensors(model.inputs, model.settings(view, mode))
        results[mode] = {"kept": memory.per_unit(counts, kept), "instances": counts.instances}
        lines.append((f"{mode}, kept for the backward pass", *(f"{results[mode]['kept'][u]:.1f}"
                                                               for u in memory.UNITS)))
    for mode in modes:
        try:
            results[mode]["peak"] = memory.peak_per_unit(mode, threads)
        except (OSError, AttributeError) as error:
            print(f"No peak memory on this system: {error}")
            break
        lines.append((f"{mode}, at the peak", *(f"{results[mode]['peak'][unit]:.1f}" for unit in memory.UNITS)))
    lines.append(("limit", *(memory.LIMITS[unit] for unit in memory.UNITS)))
    print(table(lines))
    print(", ".join(f"{mode}: {result['instances']:,} tile instances" for mode, result in results.items()) + "\n")
    return results


def print_dense(model: models.Model, views, modes, threads: int, repeats: int, rows) -> Dict[str, dict]:
    torch.set_num_threads(threads)
    totals = {row["mode"]: row["total"] for row in rows if row["threads"] == threads}
    lines = [(f"dense per tile in torch, {threads} threads", "forward s", "forward and backward s", "times slower")]
    results = {}
    for mode in modes:
        seconds = collections.defaultdict(list)
        for view, _ in itertools.product(views, range(repeats)):
            settings = model.settings(view, mode)
            start = time.perf_counter()
            dense_torch.rasterize_with_gradients(model.inputs, settings)
            middle = time.perf_counter()
            dense_torch.rasterize_with_gradients(model.inputs, settings, image_gradient(settings))
            seconds["forward", view].append(middle - start)
            seconds["total", view].append(time.perf_counter() - middle)
        results[mode] = {name: fmean(median(seconds[name, view]) for view in views)
                         for name in ("forward", "total")}
        lines.append((mode, f"{results[mode]['forward']:.2f}", f"{results[mode]['total']:.2f}",
                      f"{results[mode]['total'] / totals[mode]:.0f}"))
    print(table(lines) + "\n")
    return results


def parse(arguments):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ply", help="trained model; with --scene")
    parser.add_argument("--scene", help="its scene folder, whose test views are rendered")
    parser.add_argument("--resolution", type=int, default=-1, help="as in `dsmoe train`")
    parser.add_argument("--npz", help="packed model with its cameras instead: xyz f_dc f_rest opacity scale quat "
                        "R t fx fy width height")
    parser.add_argument("--synthetic", type=int, metavar="N", help="N made-up Gaussians instead")
    parser.add_argument("--views", type=numbers, default=[0], help="numbers of the views, such as 0,18")
    parser.add_argument("--threads", type=numbers, default=sorted({1, num_cores()}), help="such as 1,2")
    parser.add_argument("--modes", type=blends, default=list(BLEND_MODES),
                        help=f"of {', '.join(BLEND_MODES)}; smoe:0.05 is smoe with that background gate")
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--dense", type=int, default=0, metavar="REPEATS",
                        help="also time the dense torch baseline, which takes seconds a view")
    parser.add_argument("--no-memory", action="store_true", help="leave the memory measurement out")
    parser.add_argument("--json", help="write all figures there")
    options = parser.parse_args(arguments)
    if sum((options.ply is not None, options.npz is not None, options.synthetic is not None)) != 1:
        parser.error("give one of --ply, --npz and --synthetic")
    if (options.ply is None) != (options.scene is None):
        parser.error("--ply and --scene go together")
    if options.repeats < 1 or min(options.threads) < 1:
        parser.error("--repeats and --threads must be at least 1")
    return parser, options


def blends(text: str):
    for blend in text.split(","):
        models.mode_and_gate(blend)
    return text.split(",")


def numbers(text: str):
    return [int(part) for part in text.split(",")]


def main(arguments=None) -> int:
    parser, options = parse(arguments)
    if options.ply:
        model = models.from_files(options.ply, options.scene, options.resolution)
    elif options.npz:
        model = models.from_npz(options.npz)
    else:
        model = models.synthetic(options.synthetic)
    if not all(0 <= view < len(model.cameras) for view in options.views):
        parser.error(f"--views: the model has views 0 to {len(model.cameras) - 1}")

    print_machine(model, options.views, options.threads)
    cases = [Case(*case) for case in itertools.product(options.views, options.modes, options.threads)]
    samples = measure(model, cases, options.repeats)
    rows = [summary(samples, mode, threads) for mode in options.modes for threads in options.threads]
    print_times(rows)
    print_ratios(rows)
    print_stages(rows)
    print_floor(rows)
    results = {"machine": processor_name(), "build": build_info(), "model": model.name, "views": options.views,
               "gaussians": model.num_gaussians, "repeats": options.repeats, "rows": rows}
    if not options.no_memory:
        results["memory"] = print_memory(model, options.views[0], options.modes, max(options.threads))
    if options.dense:
        results["dense"] = print_dense(model, options.views, options.modes, max(options.threads), options.dense, rows)
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(results, file, indent=2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
