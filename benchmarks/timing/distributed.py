"""Times training steps over batches of views, with the Gaussians divided over the processes of torchrun.

    torchrun --nproc-per-node 2 benchmarks/timing/distributed.py --npz PACKED.npz --batch 4 --json ROWS.jsonl

One process without torchrun takes the same steps. The model is one that `models.from_npz` reads, or --copies of it,
each moved by noise and made smaller, so that all together cover what one did. Targets are renderings of the model, but
lighter. The first process prints and writes a row: images a second and peak memory of each process. With --digest it
has checksums of the gradients, which with --deterministic are the same for any number of processes.
"""
from __future__ import annotations

import argparse
import gc
import hashlib
import json
import math
import time
from typing import Any, Dict, List

import models
import numpy as np
import torch

from dsmoe.distributed.batch import Batch
from dsmoe.distributed.shards import run_of
from dsmoe.distributed.trainer import BatchTrainer
from dsmoe.options.config import TrainConfig
from dsmoe.scenes.images import View
from dsmoe.scenes.pointcloud import PointCloud
from dsmoe.scenes.scene import Scene
from dsmoe.system.environment import machine, versions
from dsmoe.system.group import join_group, leave_group


def rows_of(packed: Dict[str, torch.Tensor], copies: int, begin: int, end: int) -> Dict[str, torch.Tensor]:
    """The raw parameters of Gaussians `begin` to `end` of so many copies of a model."""
    count = len(packed["means3D"])
    parts: List[Dict[str, torch.Tensor]] = []
    for copy in range(begin // count, -(-end // count)):
        rows = slice(max(begin - copy * count, 0), min(end - copy * count, count))
        part = {name: tensor[rows].clone() for name, tensor in packed.items()}
        if copy > 0:
            generator = torch.Generator(packed["means3D"].device).manual_seed(copy)
            noise = torch.randn(count, 3, generator=generator, device=packed["means3D"].device)[rows]
            part["means3D"] += noise * part["scales"].exp().mean(1, keepdim=True)
        part["scales"] -= math.log(copies) / 3
        parts.append(part)
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def new_trainer(options: argparse.Namespace, group: Any, batch: int, blend_mode: str) -> BatchTrainer:
    """A trainer of the model with all SH degrees active and a fixed number of Gaussians."""
    packed = np.load(options.npz)
    cameras = models.from_npz_cameras(packed)
    cameras = [camera.resized(options.width or camera.width, options.height or camera.height) for camera in cameras]
    blank = torch.zeros(3, cameras[0].height, cameras[0].width, dtype=torch.uint8)
    points = PointCloud(np.random.RandomState(0).rand(max(4, group.size), 3), np.zeros((max(4, group.size), 3)))
    scene = Scene("synthetic", [View(camera, blank) for camera in cameras], [], points, 1.0, "all train")
    config = TrainConfig(scene="-", output="-", device=options.device, batch=batch,
                         blend_mode=blend_mode, iterations=10**6 * batch, densify_until_iter=0,
                         sh_degree=options.sh_degree, deterministic=options.deterministic).validate()
    trainer = BatchTrainer(config, scene, group)
    tensors = {name: torch.tensor(packed[key], device=options.device) for name, key in (
        ("means3D", "xyz"), ("dc", "f_dc"), ("shs", "f_rest"), ("opacities", "opacity"), ("scales", "scale"),
        ("rotations", "quat"))}
    tensors["shs"] = tensors["shs"][:, :(options.sh_degree + 1)**2 - 1]
    total = len(tensors["means3D"]) * options.copies
    begin, end = run_of(group.rank, group.size, total)
    trainer.divided.divide(total)
    trainer.optimizer.replace_all(rows_of(tensors, options.copies, begin, end))
    trainer.strategy._forget_statistics()
    trainer.model.active_sh_degree = options.sh_degree
    return trainer


@torch.no_grad()
def render_targets(trainer: BatchTrainer) -> None:
    """Makes each view's image a rendering, lightened, in all processes."""
    views = trainer.scene.train
    for index, view in enumerate(views):
        settings = trainer.renderer.settings_of(view.camera)
        batch = Batch(trainer.group, trainer.model, [settings])
        image = torch.zeros_like(view.image)
        drawn = batch.draw(0, for_backward=False)
        if drawn:
            image = ((0.9 * drawn[1].color + 0.1).clamp(0, 1) * 255).to(torch.uint8)
        if trainer.group.size > 1:
            torch.distributed.broadcast(image, 0)
        views[index] = View(view.camera, image)


def digest(trainer: BatchTrainer) -> Dict[str, str]:
    """A checksum of all gradients and all parameters, in the first process."""
    sums = {"gradients": hashlib.sha256(), "parameters": hashlib.sha256()}
    for tensor in trainer.model.raw.values():
        for rows, of in ((tensor.grad, "gradients"), (tensor.detach(), "parameters")):
            whole = trainer.divided.whole(rows)
            if whole is not None:
                sums[of].update(whole.cpu().contiguous().numpy().tobytes())
    return {name: checksum.hexdigest()[:16] for name, checksum in sums.items()}


def measure(options: argparse.Namespace, group: Any, batch: int, blend_mode: str) -> Dict[str, Any]:
    """The row of this number of processes."""
    trainer = new_trainer(options, group, batch, blend_mode)
    render_targets(trainer)
    row: Dict[str, Any] = {"model": options.name, "gaussians": trainer.num_gaussians, "sh_degree": options.sh_degree,
                           "processes": group.size, "batch": batch, "blend_mode": blend_mode,
                           "deterministic": options.deterministic}
    if options.digest:
        seen: Dict[str, str] = {}
        for _ in range(3):  # the third step's gradients depend on the two before
            trainer.step(lambda: seen.update(digest(trainer)))
        row["digest"] = seen
    forget_peak(options.device)
    for _ in range(options.warmup):
        trainer.step()
    synchronize(options.device)
    started = time.perf_counter()
    for _ in range(options.steps):
        step = trainer.step()
    synchronize(options.device)
    seconds = time.perf_counter() - started
    peak = torch.cuda.max_memory_allocated() if options.device == "cuda" else 0
    row.update(steps=options.steps, milliseconds=1000 * seconds / options.steps, loss=float(step.loss),
               images_per_second=batch * options.steps / seconds,
               peak_gib=[numbers[0] / 1024 for numbers in group.gather_numbers([peak >> 20], options.device)],
               machine=machine(options.device), versions=versions())
    return row


def forget_peak(device: str) -> None:
    """Forgets the peak of memory that setting up has had."""
    if device == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--npz", required=True, help="a packed model")
    parser.add_argument("--name", default="model", help="of the model, in the row")
    parser.add_argument("--copies", type=int, default=1, help="of the model, that are trained together")
    parser.add_argument("--batch", type=int, nargs="+", default=[4], help="views a step; a row for each")
    parser.add_argument("--sh-degree", type=int, default=3)
    parser.add_argument("--blend-mode", nargs="+", default=["alpha"], help="a row for each")
    parser.add_argument("--width", type=int, default=0, help="of the images (default: the model's)")
    parser.add_argument("--height", type=int, default=0)
    parser.add_argument("--warmup", type=int, default=5, help="steps before those that are timed")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--deterministic", action="store_true")
    parser.add_argument("--digest", action="store_true", help="checksums of the third step's gradients and parameters")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--json", help="file to which the row is added")
    options = parser.parse_args()
    group = join_group(options.device)
    for blend_mode in options.blend_mode:
        for batch in options.batch:
            row = measure(options, group, batch, blend_mode)
            gc.collect()  # the trainer refers to itself, and the next one's peak is without it
            if not group.leads:
                continue
            print(json.dumps(row))
            if options.json:
                with open(options.json, "a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    leave_group(group)


if __name__ == "__main__":
    main()
