"""A whole run of `dsmoe train`: a trainer with an output folder, which has progress, checkpoints and results."""
from __future__ import annotations

import contextlib
import math
import os
import re
from typing import IO, Any, Callable, Dict, List, Optional, Tuple

from .distributed.trainer import new_trainer
from .errors import TrainerError
from .options.config import CHECKPOINT_NAME, CONFIG_NAME, TrainConfig, holds_run
from .results.modelfile import FOLDER, model_path, save_model
from .results.pictures import loss_plot
from .results.rendering import Rasterize
from .results.rows import RESULTS_NAME, read_results, result_row, write_results
from .results.scalars import FOLDER as SCALARS_FOLDER
from .results.scalars import Scalars, scalar_files
from .scenes.layout import Layout
from .scenes.modelfolder import CAMERAS, cameras_content
from .scenes.scene import Scene, describe_scene, load_scene, read_layout
from .scenes.straight import pinhole_every
from .starting import change_of_blend, check_start
from .system.device import check_device
from .system.files import is_file, write_atomically, write_json_atomically
from .system.group import Group
from .system.interrupt import DelayedInterrupt
from .system.output_folder import (
    Record,
    check_inside,
    check_there,
    make_folder,
    only_one,
    read_record,
    refuse_others,
    remove_files,
    write_record,
)
from .system.progress import progress_bar
from .training.checkpoint import damage_named, load_checkpoint, save_checkpoint
from .training.forecast import Forecast
from .training.state_check import Misfit, check_numbers
from .training.strategy import Step, is_due
from .training.trainer import Trainer

HISTORY_NAME = "history.json"  # the evaluations during a run
LOSS_NAME = "loss.png"
PER_VIEW_NAME = "per_view.json"
# Beside config.json and the models.
PRODUCTS = (CHECKPOINT_NAME, RESULTS_NAME, PER_VIEW_NAME, HISTORY_NAME, LOSS_NAME, CAMERAS)
TRAIN = "dsmoe train"  # in its folders' records
PROGRESS_EVERY = {"cpu": 10, "cuda": 100}  # steps between two looks at the loss, which wait for the device


class Run:
    """A Trainer with an output folder: progress, evaluations on the way, checkpoints."""

    def __init__(self, trainer: Trainer, progress: bool = True, lock: Optional[IO[str]] = None,
                 forecast: Optional[Forecast] = None) -> None:
        """lock: the folder's, if this process leads. forecast: says how long it will take, if it is to."""
        self.trainer = trainer
        self.progress = progress
        self.lock = lock
        self.forecast = forecast
        self.history: List[Dict[str, Any]] = []
        self.losses: List[Tuple[int, float]] = []  # iteration and loss, as often as the loss is looked at
        self.scalars: Optional[Scalars] = None  # of the run in progress

    def resume(self) -> bool:
        """Continues from the folder's checkpoint; False if there is none yet."""
        path = self._path(CHECKPOINT_NAME)
        if not is_file(path):
            return False
        with damage_named(path):
            state = load_checkpoint(path, self.trainer.checkpoint_device)
            self.trainer.check_state(state)
        self.trainer.load_state_dict(state)
        self.history = list(state["history"])
        self.losses = [(int(iteration), float(loss)) for iteration, loss in state["losses"]]
        before, config = state["config"]["iterations"], self.trainer.config
        if before < config.iterations and self.trainer.leads:
            print(f"extended from {before} to {config.iterations} iterations; milestones stay: densification until "
                  f"{config.densify_until_iter}, falling learning rate of positions until "
                  f"{config.position_lr_max_steps}")
        return True

    def train(self) -> Dict[str, Any]:
        """Trains to the end, evaluates, writes the .ply and the results; returns the row."""
        trainer, config = self.trainer, self.trainer.config
        self.scalars = Scalars(config.output, trainer.iteration, wanted=trainer.leads)
        new_bar = progress_bar(total=config.iterations, initial=trainer.iteration, desc=self.title, unit="it",
                               disable=not self.progress, dynamic_ncols=True)
        patience = DelayedInterrupt(patient=trainer.is_divided)
        with contextlib.closing(self.scalars), new_bar as bar, patience as interrupt:
            trainer.wants_stop = lambda: interrupt.asked is not None
            trainer.watch.start()
            ends = trainer.iteration >= config.iterations
            while not ends:
                ends = self._step(bar)
            trainer.watch.stop()
        if trainer.stops():  # in all processes or in none
            raise interrupt.asked or KeyboardInterrupt
        return self._write_results()

    def _step(self, bar: Any) -> bool:
        """One step, and what comes with it: an evaluation, a look at the loss, a checkpoint. Whether the run ends."""
        trainer, config = self.trainer, self.trainer.config
        following = trainer.iteration + config.batch
        evaluates = following < config.iterations and is_due(following, config.eval_every, config.batch)
        step = trainer.step((lambda: self._evaluate(bar)) if evaluates else None)
        bar.update(config.batch)
        forecast = self.forecast(trainer.iteration) if self.forecast else None
        if forecast:
            bar.write(forecast)
        last = trainer.iteration >= config.iterations
        if last or step.due(PROGRESS_EVERY[config.device]):
            self.losses.append((trainer.iteration, _check_loss(step)))
            self._show(bar, self.losses[-1][1])
        ends = last or trainer.stops()
        if ends or step.due(config.checkpoint_every):
            trainer.watch.stop()
            _check_loss(step)
            self.save_checkpoint()
            trainer.watch.start()
        return ends

    def _write_results(self) -> Dict[str, Any]:
        """Evaluates the trained model, writes it and the results; returns the row."""
        trainer, config = self.trainer, self.trainer.config
        gate, model = trainer.background_gate, trainer.whole_model()
        if trainer.leads:
            save_model(self._path(_model_name(trainer.iteration)), model, str(config.blend_mode), gate,
                       config.unusual_faint)
        evaluation = trainer.evaluate(self.progress)
        row = result_row(config, trainer.scene, trainer.num_gaussians, trainer.watch.seconds, evaluation,
                         trainer.evaluate_training_views(self.progress), gate,
                         pinhole_every(trainer.scene.train, config.iterations))
        if not trainer.leads:
            return row
        folder = os.path.dirname(self._path(RESULTS_NAME))
        with contextlib.suppress(TrainerError):  # a damaged file is replaced
            for earlier in read_results(folder) if config.init else ():  # of a resumed run
                if "start" in earlier:  # of `dsmoe simplify`
                    row["start"] = earlier["start"]
        write_results(folder, [row])
        write_json_atomically(self._path(PER_VIEW_NAME), evaluation.per_view)
        views = [*trainer.scene.test, *trainer.scene.train]
        write_json_atomically(self._path(CAMERAS), cameras_content([view.camera for view in views]))
        if self.losses:
            write_atomically(self._path(LOSS_NAME), lambda file: loss_plot(self.losses).save(file, "PNG"))
        return row

    def save_checkpoint(self) -> None:
        """Writes the state of trainer, history and losses. Raises TrainerError if that could not be gone on with."""
        state = self._state()
        if self.trainer.leads:
            save_checkpoint(self._path(CHECKPOINT_NAME), {**state, "history": self.history, "losses": self.losses})
        self.trainer.meet()  # if one process ends before the file is whole, torchrun ends the others

    def _state(self) -> Dict[str, Any]:
        """The trainer's state. Raises TrainerError if a number in it is NaN or infinite."""
        state = self.trainer.state_dict()
        try:
            if self.trainer.leads:
                check_numbers(state)
        except Misfit as error:
            raise TrainerError(f"iteration {self.trainer.iteration}: the training has diverged, {error}; lower the "
                               "learning rates") from error
        return state

    def _show(self, bar: Any, loss: float) -> None:
        if not (self.progress or self.scalars.active):
            return
        trainer = self.trainer
        gate = {"gate": trainer.background_gate} if trainer.gate else {}
        quality, count = trainer.training_psnr(), trainer.num_gaussians
        self.scalars.add(trainer.iteration, loss=loss, psnr=quality, gaussians=count, **gate)
        if self.progress:
            shown = {name: f"{value:.4f}" for name, value in gate.items()}
            bar.set_postfix(loss=f"{loss:.4f}", psnr=f"{quality:.2f}", **shown, gaussians=f"{count:,}",
                            refresh=False)  # a number would become 3e+4

    def _evaluate(self, bar: Any) -> None:
        trainer = self.trainer
        trainer.watch.stop()
        evaluation = trainer.evaluate()
        self.history.append({"iteration": trainer.iteration, **evaluation.metrics,
                             "num_gaussians": trainer.num_gaussians, "train_seconds": trainer.watch.seconds})
        if trainer.leads:
            write_json_atomically(self._path(HISTORY_NAME), self.history)
        self.scalars.add(trainer.iteration, **{f"test__{name}": value for name, value in evaluation.metrics.items()
                                               if value is not None})
        if self.progress and evaluation.metrics["psnr"] is not None:
            bar.write(f"iteration {trainer.iteration}: test PSNR {evaluation.metrics['psnr']:.2f} dB, "
                      f"SSIM {evaluation.metrics['ssim']:.4f}, {trainer.num_gaussians} Gaussians")
        trainer.watch.start()

    def _path(self, name: str) -> str:
        """A file to write. Raises TrainerError if the folder is no longer the one in which the run has begun."""
        output = self.trainer.config.output
        if self.lock:
            check_there(output, self.lock)
        return os.path.join(output, name)

    @property
    def title(self) -> str:
        """Of the progress bar."""
        return str(self.trainer.config.blend_mode)


def _check_loss(step: Step) -> float:
    """The step's loss. Raises TrainerError if it is not finite: nothing that follows would be worth keeping."""
    loss = float(step.loss.detach())
    if not math.isfinite(loss):
        raise TrainerError(f"iteration {step.iteration}: the loss is {loss}; lower the learning rates")
    return loss


def _model_name(iterations: int) -> str:
    """The path, in its folder, of the model of a run of so many iterations."""
    return model_path("", iterations).replace(os.sep, "/")


def earlier_files(config: TrainConfig, resume: bool = False, overwrite: bool = False) -> List[str]:
    """Products and models that earlier runs have written into config.output, their paths in it.

    Raises TrainerError if something is there that this run must not go on with, or replace.
    """
    output = config.output
    if config.init and os.path.realpath(config.init).startswith(os.path.join(os.path.realpath(output), "")):
        raise TrainerError(f"{config.init}, the model to start from, lies in {output}, the folder to write; choose "
                           "another folder with -o")
    record = read_record(output, TRAIN)
    models = os.path.join(output, FOLDER)
    if not holds_run(output):
        recorded = {name.partition("/")[0] for name in record.files} if record else set()
        there = [name for name in (*PRODUCTS, FOLDER)
                 if os.path.lexists(os.path.join(output, name)) and name not in recorded]
        if there:
            raise TrainerError(f"{output} holds {', '.join(there)} but no {CONFIG_NAME}: no run of {TRAIN} "
                               "is known to have written them; choose another folder")
        if record is None and not overwrite:
            refuse_others(output, TRAIN, "; --overwrite trains beside what is there")
    elif not resume and not overwrite:
        raise TrainerError(f"{output} already holds a training run; continue it with --resume, "
                           "replace it with --overwrite, or choose another folder")
    elif resume or not record:  # a record is enough to be replaced
        earlier = TrainConfig.load(output, continues=resume)
        if resume:
            earlier.check_continued_by(config)
        record = record or Record(earlier.scene, [_model_name(earlier.iterations)])
    if os.path.lexists(models) and not os.path.isdir(models):
        raise TrainerError(f"{models} is not a folder; a run writes its model there")
    check_inside(output, [_model_name(config.iterations), os.path.join(SCALARS_FOLDER, "events")])
    # A record may be a stranger's: nothing but products and models is removed by it.
    model = _model_name(0).replace("0", r"\d+").replace(".", r"\.")
    known = [*(record.files if record else ()), *(PRODUCTS if holds_run(output) else ())]
    return sorted({name for name in known if name in PRODUCTS or re.fullmatch(model, name)})


def room_text(trainer: Trainer) -> Optional[str]:
    """How many Gaussians fit, and whether the strategy wants more; None on a CPU. All processes call it."""
    room, most = trainer.room(), trainer.strategy.most()
    if room is None:
        return None
    where = f"memory of {trainer.group.size} GPUs" if trainer.is_divided else "GPU's memory"
    text = f"about {room:,} Gaussians fit into the {where}"
    if most > room:
        text += (f"; note: --strategy {trainer.config.strategy} grows to {most:,}; take a smaller --budget or more "
                 "--gpus")
    return text


def train(config: TrainConfig, resume: bool = False, overwrite: bool = False, progress: bool = True,
          scene: Optional[Scene] = None, rasterize: Optional[Rasterize] = None, group: Optional[Group] = None,
          say: Optional[Callable[[str], None]] = None, lock: Optional[IO[str]] = None,
          layout: Optional[Layout] = None) -> Dict[str, Any]:
    """Trains a scene into config.output; returns the row of results.json.

    resume: continue the run in config.output; start it if it has no checkpoint yet. The result is bit for bit as if
        it had not stopped (on the CPU, with the same number of threads and the same SIMD level). With more
        iterations than it had, it is extended: its milestones stay, and if it had ended it lacks its last update.
    overwrite: replace a run that is there, once this one can start; files that no run wrote stay.
    scene: a loaded scene, if one is at hand. layout: what `read_layout` gave, likewise.
    group: the processes that train together, if there are several; all of them call this.
    say: is called with a line about what was loaded; with it a training on the CPU also says how long it takes.
    lock: the folder's, if the caller keeps it over several runs.
    Raises TrainerError before training starts if anything does not fit, such as another run at work in the folder.
    """
    if resume and overwrite:
        raise TrainerError("--resume continues a run and --overwrite replaces it; choose one")
    config.validate()
    check_device(config.device)
    if group and not group.leads:  # the folder is the first process's
        run = Run(new_trainer(config, scene or load_scene(config, False, layout), rasterize, group), progress=False)
        room_text(run.trainer)
        if resume:
            run.resume()
        return run.train()
    earlier_files(config, resume, overwrite)
    layout = None if scene else layout or read_layout(config)
    if config.init and layout and not resume:  # a model of another scene is told before a folder is made
        scene = load_scene(config, progress, layout)
        quality = check_start(scene, config)
        if say:
            say(f"{config.init}: blend mode {scene.start.blend_text}; {quality.text(config)}")
            change = change_of_blend(scene.start, config)
            if change:
                say(change)
    make_folder(config.output)  # a folder that cannot be made is told before images are read
    with contextlib.nullcontext(lock) if lock else only_one(config.output) as lock:
        earlier = earlier_files(config, resume, overwrite)  # again: another run may have been at work there
        scene = scene or load_scene(config, progress, layout)
        if config.random_background and config.background_gate == 0:
            print("warning: --random-background with a background gate of 0: the background is seen only where no "
                  "Gaussian is, so little is learned of transparency")
        if say and layout:
            say(describe_scene(scene, layout, config))
        forecast = Forecast(config, scene) if say and config.device == "cpu" else None
        run = Run(new_trainer(config, scene, rasterize, group), progress, lock, forecast)
        room = room_text(run.trainer)
        if say and room:
            say(room)
        if resume:
            resumed = run.resume()
            print(f"resumed at iteration {run.trainer.iteration}" if resumed else "no checkpoint yet: starting anew")
        models = {name for name in earlier if name not in PRODUCTS} if resume else set()
        files = sorted({*PRODUCTS, *models, _model_name(config.iterations)})
        write_record(config.output, TRAIN, Record(os.path.abspath(config.scene), files), earlier)
        if not resume:
            # config.json goes first: if this is killed, the folder holds no run that --resume could take up.
            remove_files(config.output, [CONFIG_NAME])
            remove_files(config.output, [*files, *(scalar_files(config.output) if overwrite else ())])
        config.save(config.output)
        return run.train()
