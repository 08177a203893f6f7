"""The native trainer as a method of the harness."""
from __future__ import annotations

import os
from typing import Any, Dict

import torch

from ...errors import TrainerError
from ...inspection import open_renderer
from ...options.config import CHECKPOINT_NAME, TrainConfig, holds_run
from ...results.evaluation import evaluate
from ...results.modelfile import model_path
from ...results.pictures import evenly_spaced
from ...results.rows import read_results
from ...system import torchrun
from ...system.process import set_up_process
from ...train import HISTORY_NAME, train
from ..measure import Measures
from ..names import read_json
from ..protocol import config_of
from .outcome import Outcome, scene_of


def run_native(cell: Dict[str, Any], output: str) -> Outcome:
    """Trains in output/run, continuing an earlier attempt, and measures. Raises TrainerError."""
    folder = os.path.join(output, "run")
    config = config_of(cell, folder)
    set_up_process(config.device)
    on_gpu = config.device == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    continued = os.path.isfile(os.path.join(folder, CHECKPOINT_NAME))
    scene = scene_of(config).to(config.device)
    gpus = cell["protocol"].get("gpus", 1)
    row = train_on(gpus, config) if gpus > 1 else train(config, resume=True, progress=False, scene=scene)
    # Else the peak of one part would be taken for the whole training's.
    peak = torch.cuda.max_memory_allocated() / 2**20 if on_gpu and gpus == 1 and not continued else None
    measures = Measures(config.device, cell["protocol"]["lpips"])  # after the peak, since LPIPS takes memory
    ply, history = model_path(folder, config.iterations), os.path.join(folder, HISTORY_NAME)
    renderer = open_renderer(config, ply, config.blend_mode, config.device)
    evaluation = evaluate(renderer, scene.test, config.device, measure=measures, passes=1)  # as in checkouts
    renders = {}
    with torch.no_grad():
        for index in evenly_spaced(len(scene.test), cell["images"]):
            camera = scene.test[index].camera
            renders[camera.name] = renderer(camera).color.cpu()
    return Outcome(scene=scene, evaluation=evaluation, lpips=measures.lpips_of(evaluation.metrics),
                   num_gaussians=row["num_gaussians"], own_bytes=os.path.getsize(ply),
                   train_seconds=row["train_seconds"], peak_gpu_mib=peak, renders=renders,
                   history=read_json(history) if os.path.isfile(history) else [],
                   notes={"continued": continued, "scale_recipe": cell["protocol"]["scale_recipe"],
                          "background_gate": row["background_gate"], **({"gpus": gpus} if gpus > 1 else {}),
                          **{name: value for name, value in row["protocol"].items() if name == "pinhole_every"}})


def train_on(gpus: int, config: TrainConfig) -> Dict[str, Any]:
    """Trains in as many processes, continuing an earlier attempt; returns the run's row. Raises TrainerError."""
    os.makedirs(config.output, exist_ok=True)
    if not holds_run(config.output):
        config.save(config.output)
    status = torchrun.launch(gpus, ["train", "--resume", "-o", config.output, "--quiet"])
    if status != 0:
        raise TrainerError(f"the training on {gpus} GPUs ended with status {status}; log.txt says why")
    return read_results(config.output)[0]
