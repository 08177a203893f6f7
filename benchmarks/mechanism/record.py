"""What one recipe does to the Gaussians of each blend mode: a training, watched, and figures of what was seen.

    python -I -m diff_smoe_rasterization.benchmarks.mechanism run SCENE OUT --blend-mode smoe --device cuda ...
    python -I -m diff_smoe_rasterization.benchmarks.mechanism plot OUT [OUT ...] -o FOLDER

`run` takes the options of `dsmoe train` and trains as it does: watching draws no random number and changes no tensor.
OUT/mechanism.json then holds three series and a summary:

    states          every 100 steps, and every 10 steps after an opacity reset: opacities, the pull on them, test PSNR
    resets          test PSNR on both sides of each opacity reset
    densifications  what was cloned, split and pruned, what the pruned carried, where the cloned and split lie, and how
                    large they are: sizes are largest standard deviations in world units

A state is that of the model as its step begins. Its net pull sums minus the gradient of the loss by the opacity logits,
over Gaussians and over the steps since the state or the reset before, and divides by the sum of absolute values: 1
where every opacity is to rise, 0 where a common shift of all logits would leave the loss as it is. probe.py
says what the other numbers are.
"""
from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import sys
from typing import Any, Dict, Iterator, List, Optional, Sequence

import torch

from ...trainer.config import TrainConfig, add_arguments, config_from_arguments, holds_run
from ...trainer.errors import TrainerError
from ...trainer.scenes.scene import Scene, load_scene
from ...trainer.system.files import write_text_atomically
from ...trainer.system.process import set_up_process
from ...trainer.system.stopwatch import Stopwatch
from ...trainer.training.loop import Run, Trainer, check_device, earlier_models
from ...trainer.training.strategy import MAX_SCALE, MIN_OPACITY, Step, ThreeDGSStrategy
from ..errors import BenchError
from ..suite.methods import require_test_views
from ..suite.protocol import machine_of, project_commit
from .probe import QUANTILES, Probe, median, quantiles

RECORD_NAME = "mechanism.json"
EVERY = 100  # steps between two states,
EVERY_AFTER_RESET, AFTER_RESET = 10, 300  # and so many for so many steps after an opacity reset
LATER, SETTLED = 100, 1000  # steps after a reset at which the summary looks at PSNR, and at opacities
DIGITS = 6  # of the numbers in the record
SERIES = ("states", "resets", "densifications")


class Recorder:
    """Takes notes of a training between what its strategy does; a `watched` strategy calls it."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.probe = Probe(trainer.renderer, trainer.scene)
        self.watch = Stopwatch(trainer.config.device)
        self.states: List[Dict[str, Any]] = []
        self.resets: List[Dict[str, Any]] = []
        self.densifications: List[Dict[str, Any]] = []
        self.pull = self._no_pull()

    def _no_pull(self) -> torch.Tensor:
        return torch.zeros(2, dtype=torch.double, device=self.trainer.config.device)

    @contextlib.contextmanager
    def aside(self) -> Iterator[None]:
        """Time spent inside is the recorder's, not the training's."""
        self.trainer.watch.stop()
        self.watch.start()
        yield
        self.watch.stop()
        self.trainer.watch.start()

    def before_change(self, step: Step) -> None:
        """Gradients are known and nothing has changed: the time for a state, where one is due."""
        gradient = self.trainer.model.raw["opacities"].grad
        self.pull += torch.stack([-gradient.sum(), gradient.abs().sum()])
        since_reset = step.iteration - self.resets[-1]["iteration"] if self.resets else math.inf
        dense = since_reset == 1 or since_reset <= AFTER_RESET and since_reset % EVERY_AFTER_RESET == 0
        if step.iteration % EVERY and not dense:
            return
        with self.aside():
            model, (net, total) = self.trainer.model, self.pull.tolist()
            self.states.append({
                "iteration": step.iteration, "num_gaussians": model.num_gaussians, **self.probe.look(),
                "opacities": quantiles(model.opacities.squeeze(1)),
                "net_pull": net / total if total else None,
            })
            self.pull = self._no_pull()

    def before_densification(self, gradients: torch.Tensor, seen: torch.Tensor) -> None:
        """gradients: [N] as the strategy compares them; seen: [N] bool, whether they are of any view."""
        with self.aside():
            config, model = self.trainer.config, self.trainer.model
            parents = gradients >= config.densify_grad_threshold
            sizes = model.scales.detach().max(dim=1).values
            split = parents & (sizes > config.percent_dense * self.trainer.scene.extent)
            self.densifications.append({
                "iteration": self.trainer.iteration, "before": model.num_gaussians,
                "seen": int(seen.sum()), "gradients": quantiles(gradients[seen]),
                "cloned": int((parents & ~split).sum()), "split": int(split.sum()),
                "edges": self.probe.edges(parents),
                "size": {"all": median(sizes), "chosen": median(sizes[parents])},
            })

    def before_prune(self, large_too: bool) -> None:
        """large_too: whether Gaussians are pruned for their size."""
        with self.aside():
            model, row = self.trainer.model, self.densifications[-1]
            faint = model.opacities.detach().squeeze(1) < MIN_OPACITY
            large = ~faint & (model.scales.detach().max(dim=1).values > MAX_SCALE * self.trainer.scene.extent)
            doomed = {"faint": faint, "large": large & large_too}
            row.update({"grown": model.num_gaussians, **{name: int(mask.sum()) for name, mask in doomed.items()}})
            shares = self.probe.shares().double()
            total = float(shares.sum())
            row["pruned_colors"] = {name: float(shares[mask].sum()) / total if total else None
                                    for name, mask in doomed.items()}
            row["before_prune"] = self.probe.look()

    def after_prune(self) -> None:
        """The doomed are gone."""
        with self.aside():
            self.densifications[-1].update(after=self.trainer.model.num_gaussians, after_prune=self.probe.look())

    def before_reset(self) -> None:
        """Opacities are about to be lowered."""
        with self.aside():
            self.resets.append({"iteration": self.trainer.iteration, "before": self.probe.look()})

    def after_reset(self) -> None:
        """They are lowered."""
        with self.aside():
            self.resets[-1]["after"] = self.probe.look()
            self.pull = self._no_pull()


def watched(strategy: ThreeDGSStrategy, recorder: Recorder) -> ThreeDGSStrategy:
    """The same strategy, not yet begun, that tells a recorder before and after each of its acts."""

    class Watched(type(strategy)):  # type: ignore[misc]
        def after_backward(self, step: Step) -> None:
            recorder.before_change(step)
            super().after_backward(step)

        def densify(self, gradients: torch.Tensor, *limits: Any) -> torch.Tensor:
            recorder.before_densification(gradients, self.view_count > 0)
            return super().densify(gradients, *limits)

        def prune(self, large_too: bool) -> torch.Tensor:
            recorder.before_prune(large_too)
            kept = super().prune(large_too)
            recorder.after_prune()
            return kept

        def reset_opacities(self) -> None:
            recorder.before_reset()
            super().reset_opacities()
            recorder.after_reset()

    return Watched(strategy.context)


def run(config: TrainConfig, progress: bool = True, scene: Optional[Scene] = None) -> Dict[str, Any]:
    """Trains a scene into config.output, watched; writes the record there and returns it.

    scene: a loaded scene, where one is at hand. Raises TrainerError where the options or the scene do not fit, where
    config.output already holds a training run or another program's output, or where it lies in the scene's folder.
    """
    if inside(config.output, config.scene):
        raise BenchError(f"{config.output} lies in the scene's folder {config.scene}, which stays as it is; choose "
                         "another folder")
    config = config.changed(checkpoint_every=0)  # a record cannot be continued
    check_device(config.device)
    if holds_run(config.output):
        raise TrainerError(f"{config.output} already holds a training run; choose another folder")
    earlier_models(config)
    os.makedirs(config.output, exist_ok=True)
    trainer = Trainer(config, require_test_views(scene or load_scene(config, progress), config))
    recorder = Recorder(trainer)
    trainer.strategy = watched(trainer.strategy, recorder)
    config.save(config.output)
    row = Run(trainer, progress).train()
    record = {
        "config": {**dataclasses.asdict(config), "scene": row["scene"], "output": None},
        "machine": machine_of(config.device), "commit": project_commit(),
        "train_seconds": row["train_seconds"], "probe_seconds": recorder.watch.seconds,
        "extent": trainer.scene.extent, "quantiles": QUANTILES, "result": {name: row[name] for name in (
            "psnr", "ssim", "psnr_float", "num_gaussians")},
        "states": recorder.states, "resets": recorder.resets, "densifications": recorder.densifications,
    }
    record = _plain({**record, "summary": summary(record)})
    write_text_atomically(os.path.join(config.output, RECORD_NAME), json.dumps(record) + "\n")
    return record


def inside(path: str, folder: str) -> bool:
    """Whether a path is a folder, or below it."""
    path, folder = os.path.realpath(path), os.path.realpath(folder)
    return os.path.commonpath([path, folder]) == folder


def summary(record: Dict[str, Any]) -> Dict[str, Any]:
    """The numbers that say most, from the series of a record; None, 0 or an empty list where a run has no such thing.

    resets: PSNR [dB] on both sides of each and 100 steps later, before the next prune. settled_opacity: the median 1000
    steps after the last reset. net_pull: means over the states within 100 steps after a reset, and over the others.
    pruned: how many; color: the fraction of the picture that they made; psnr: dB gained; both summed over prunes, and
    of the first prune after each reset. densified: how many times likelier than any Gaussian a parent lies near an
    edge, and its size over the median size; means over parents.
    """
    states, resets, steps = record["states"], record["resets"], record["densifications"]
    at = {state["iteration"]: state for state in states}
    begins = [reset["iteration"] for reset in resets]

    def pulls(shaken: bool) -> List[float]:
        return [state["net_pull"] for state in states
                if any(0 < state["iteration"] - begin <= LATER for begin in begins) == shaken
                and state["net_pull"] is not None]

    settled = [state for state in states if begins and state["iteration"] >= begins[-1] + SETTLED]
    prunes = [{"iteration": step["iteration"], "color": step["pruned_colors"],
               "psnr": step["after_prune"]["psnr"] - step["before_prune"]["psnr"]} for step in steps]
    return {
        **record["result"],
        "resets": [{"iteration": reset["iteration"], "before": reset["before"]["psnr"],
                    "after": reset["after"]["psnr"], "later": at.get(reset["iteration"] + LATER, {}).get("psnr")}
                   for reset in resets],
        "settled_opacity": settled[0]["opacities"][QUANTILES.index(0.5)] if settled else None,
        "net_pull": {"after_resets": _mean(pulls(True)), "otherwise": _mean(pulls(False))},
        "pruned": {
            **{name: sum(step[name] for step in steps) for name in ("faint", "large")},
            "color": {name: sum(prune["color"][name] or 0 for prune in prunes) for name in ("faint", "large")},
            "psnr": sum(prune["psnr"] for prune in prunes),
            "after_resets": [next((prune for prune in prunes if prune["iteration"] > begin), None) for begin in begins],
        },
        "densified": {
            "parents": sum(step["cloned"] + step["split"] for step in steps),
            "edge_enrichment": _ratio_over_parents(steps, "edges"), "size_ratio": _ratio_over_parents(steps, "size"),
        },
    }


def _mean(values: Sequence[float]) -> Optional[float]:
    return sum(values) / len(values) if values else None


def _ratio_over_parents(steps: Sequence[Dict[str, Any]], name: str) -> Optional[float]:
    """The chosen over all, of densification steps that chose any, each step counting as often as it has parents."""
    pairs = [(step["cloned"] + step["split"], step[name]["chosen"] / step[name]["all"]) for step in steps
             if step[name]["chosen"] is not None and step[name]["all"]]
    count = sum(parents for parents, _ in pairs)
    return sum(parents * ratio for parents, ratio in pairs) / count if count else None


def _plain(value: Any) -> Any:
    """The value as JSON has it: numbers rounded, None for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def read_record(folder: str) -> Dict[str, Any]:
    """The record of a watched run, its folder's or a file. Raises BenchError where there is none, or a damaged one."""
    path = folder if os.path.isfile(folder) else os.path.join(folder, RECORD_NAME)
    try:
        with open(path, encoding="utf-8") as file:
            record = json.load(file)
    except FileNotFoundError as error:
        raise BenchError(f"{folder} holds no {RECORD_NAME}: no watched run has ended there") from error
    except ValueError as error:
        raise BenchError(f"{path}: not valid json ({error})") from error
    if not isinstance(record, dict) or not {"config", *SERIES} <= set(record):
        raise BenchError(f"{path}: not the record of a watched run; it lacks config, {', '.join(SERIES)}")
    return record


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Runs the command; returns its exit status: 0, or 1 on an error that its text explains."""
    parser = argparse.ArgumentParser(prog="python -I -m diff_smoe_rasterization.benchmarks.mechanism",
                                     description="Watches what a recipe does to the Gaussians of each blend mode.")
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    watch = actions.add_parser("run", help="train, and record what happens to the Gaussians")
    add_arguments(watch, skip=("output", "checkpoint_every"))
    watch.add_argument("output", metavar="OUT", help="folder to write")
    watch.add_argument("--scale-recipe", action="store_true", help="squeeze the recipe into --iterations")
    watch.add_argument("--quiet", action="store_true", help="no progress bars")
    plot = actions.add_parser("plot", help="draw the records of some runs into the same three figures")
    plot.add_argument("runs", metavar="OUT", nargs="+", help="folders of watched runs, or their mechanism.json")
    plot.add_argument("-o", "--output", metavar="FOLDER", required=True, help="folder to write")
    arguments = parser.parse_args(argv)
    try:
        if arguments.action == "plot":
            from .plots import draw_all

            print(*draw_all([read_record(folder) for folder in arguments.runs], arguments.output), sep="\n")
        else:
            _run(arguments)
    except (TrainerError, ImportError, OSError) as error:
        print(f"mechanism {arguments.action}: error: {error}", file=sys.stderr)
        return 1
    return 0


def _run(arguments: argparse.Namespace) -> None:
    config = config_from_arguments(arguments)
    set_up_process(config.device)
    print(json.dumps(run(config, progress=not arguments.quiet)["summary"], indent=2))
    print(f"written: {os.path.join(config.output, RECORD_NAME)}", file=sys.stderr)
