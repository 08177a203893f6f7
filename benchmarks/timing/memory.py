"""Memory beyond inputs, outputs and returned gradients: what the graph keeps, and the peak, per unit.

Kept memory is read off the saved tensors. The peak also holds what no tensor shows (sort buffers, gradient records). It
is the growth of the process's largest resident size, in fresh processes. Three scenes are almost purely Gaussians,
pixels and tile instances: three equations give bytes per Gaussian, per pixel and per instance.
"""
from __future__ import annotations

import ctypes
import multiprocessing
import re
from typing import Dict, NamedTuple

import numpy as np
import torch
from models import Model

from diff_smoe_rasterization import rasterize
from dsmoe.scenes.cameras import Camera

UNITS = ("Gaussian", "pixel", "tile instance")
LIMITS = dict(zip(UNITS, (200, 64, 72)))  # bytes of float32 renderings with three channels
TILE = 16
FOCAL = 1000.0  # pixels


class Counts(NamedTuple):
    """How many of each unit a rendering has."""

    gaussians: int
    pixels: int
    instances: int


def kept_tensors(inputs: Dict[str, torch.Tensor], settings):
    """Renders; returns the Counts, and a list of (shape, bytes) of what the graph keeps beside inputs and outputs."""
    leaves = {name: tensor.detach().requires_grad_() for name, tensor in inputs.items()}
    saved = []

    def keep(tensor):
        saved.append(tensor)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        rendering = rasterize(settings=settings, **leaves)
    camera = (settings.bg, settings.viewmatrix, settings.projmatrix, settings.campos)
    callers = {tensor.data_ptr() for tensor in (*leaves.values(), *camera, rendering.color, rendering.radii)}
    kept = [tensor for tensor in saved if tensor.numel() and tensor.data_ptr() not in callers]
    instances = sum(len(tensor) for tensor in kept if tensor.dtype == torch.int32 and tensor.shape[1:] == (2,))
    counts = Counts(len(inputs["means3D"]), settings.image_height * settings.image_width, instances)
    return counts, [(tuple(tensor.shape), tensor.numel() * tensor.element_size()) for tensor in kept]


def per_unit(counts: Counts, kept) -> Dict[str, float]:
    """Bytes kept per Gaussian, pixel and tile instance; what grows with none of them (offsets of tiles) is left out."""
    by_unit = dict.fromkeys(UNITS, 0.0)
    for shape, size in kept:
        if shape[0] == counts.instances:
            by_unit["tile instance"] += size / counts.instances
        elif shape[0] in (counts.gaussians, counts.gaussians + 1, 3 * counts.gaussians):  # three features side by side
            by_unit["Gaussian"] += size / counts.gaussians
        elif int(np.prod(shape)) % counts.pixels == 0:
            by_unit["pixel"] += size / counts.pixels
    return by_unit


def _grid(num_gaussians: int, columns: int, rows: int, opacity: float, sigma: float):
    """Round Gaussians in the middles of tiles, several deep if there are more than tiles; sigma in pixels."""
    index = torch.arange(num_gaussians)
    x = (index % columns + 0.5) * TILE - columns * TILE / 2
    y = (index // columns % rows + 0.5) * TILE - rows * TILE / 2
    depth = 4 + index.float() / num_gaussians
    means3D = torch.stack([x / FOCAL * depth, y / FOCAL * depth, depth], 1)
    inputs = dict(means3D=means3D, opacities=torch.full((num_gaussians, 1), opacity),
                  scales=(sigma / FOCAL * depth)[:, None].repeat(1, 3),
                  rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(num_gaussians, 1),
                  shs=0.1 * torch.ones(num_gaussians, 16, 3))
    camera = Camera("", np.eye(3), np.zeros(3), FOCAL, FOCAL, columns * TILE / 2, rows * TILE / 2, columns * TILE,
                    rows * TILE)
    return Model("grid", inputs, [camera])


SCENES = {  # Gaussians, columns and rows of tiles, opacity, sigma in pixels
    "Gaussian": (400_000, 32, 32, 0.5, 0.1),  # each within one tile
    "pixel": (16, 256, 128, 0.5, 0.1),
    "tile instance": (400, 64, 64, 0.01, 4000.0),  # each covers every tile, and none ever saturates
}


def _status(field: str) -> int:
    with open("/proc/self/status", encoding="ascii") as file:
        return int(re.search(field + r":\s+(\d+) kB", file.read()).group(1)) * 1024


def _start_peak() -> None:
    """Gives freed memory back to the system, and starts the record of the largest resident size again."""
    ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")


def _measure(unit: str, blend: str, threads: int, pipe) -> None:
    """Child process: sends (Counts, bytes at the peak beyond inputs, outputs and gradients)."""
    torch.set_num_threads(threads)

    def run(num_gaussians, columns, rows, opacity, sigma):
        model = _grid(num_gaussians, columns, rows, opacity, sigma)
        leaves = {name: tensor.requires_grad_() for name, tensor in model.inputs.items()}
        settings = model.settings(0, blend)
        dL_dcolor = torch.ones(3, settings.image_height, settings.image_width)
        _start_peak()
        before = _status("VmRSS")
        rendering = rasterize(settings=settings, **leaves)
        gradients = torch.autograd.grad(rendering.color, list(leaves.values()), dL_dcolor)
        returned = (rendering.color, rendering.radii, *gradients)
        beyond = _status("VmHWM") - before - sum(tensor.numel() * tensor.element_size() for tensor in returned)
        return {name: tensor.detach() for name, tensor in leaves.items()}, settings, beyond

    run(64, 4, 4, 0.5, 0.1)  # code and thread stacks
    inputs, settings, beyond = run(*SCENES[unit])
    counts, _ = kept_tensors(inputs, settings)
    pipe.send((tuple(counts), beyond))


def peak_per_unit(blend: str, threads: int) -> Dict[str, float]:
    """Returns the peak's bytes per Gaussian, pixel and tile instance.

    Linux with glibc only; raises OSError or AttributeError elsewhere.
    """
    _start_peak()
    context = multiprocessing.get_context("spawn")
    equations, peaks = [], []
    for unit in UNITS:
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_measure, args=(unit, blend, threads, sender))
        process.start()
        sender.close()
        try:
            counts, beyond = receiver.recv()
        except EOFError:
            raise OSError(f"the memory measurement of a {unit} scene failed; its reason is printed above") from None
        finally:
            process.join()
        equations.append(counts)
        peaks.append(beyond)
    return dict(zip(UNITS, np.linalg.solve(np.array(equations, np.float64), np.array(peaks, np.float64)).tolist()))
