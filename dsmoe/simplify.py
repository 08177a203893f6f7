"""`dsmoe simplify`: a trained model becomes one of fewer Gaussians, by the strategy `importance`, in seconds."""
from __future__ import annotations

import dataclasses
import os
from typing import Any, Callable, Dict, List, NamedTuple, Optional

from .errors import ConfigError, SceneError, TrainerError
from .inspection import open_renderer
from .options.choices import SIMPLIFY_ITERATIONS
from .options.config import TrainConfig, holds_run
from .results.evaluation import Evaluation, evaluate
from .results.modelfile import model_path
from .results.rendering import Renderer
from .results.rows import write_results
from .scenes.scene import Scene, describe_scene, load_scene, read_layout
from .starting import Found, Start, blend_options, change_of_blend, check_start, find_model, read_start, start_renderer
from .system.device import check_device
from .system.files import is_folder
from .system.output_folder import make_folder, only_one
from .system.process import typed
from .train import earlier_files, train

UNTIL = 0.35  # as with --fast: removals end at 0.95 of this part of the iterations, moves at 1.33 of it
FIRST_POSITION_RATE = 0.000064  # times the scene extent: trained positions move little
LEAST = 4  # Gaussians, as `importance` has it
CHECKPOINT_EVERY = {"cpu": 1000, "cuda": 0}  # on a GPU a checkpoint takes longer than the steps that it would save
# --loses tries these parts of the model, one after the other.
FIRST_PART, STEP = 1 / 40, 1.5


class _Measured(NamedTuple):
    """A model to simplify, on the scene that it is simplified on."""

    start: Start
    renderer: Renderer
    scene: Scene
    config: TrainConfig


def simplify(model: str, output: str, *, scene: Optional[str] = None, budget: Optional[int] = None,
             keep: Optional[float] = None, loses: Optional[float] = None, resume: bool = False,
             overwrite: bool = False, progress: bool = True, say: Optional[Callable[[str], None]] = None,
             **options: Any) -> Dict[str, Any]:
    """Makes a model of fewer Gaussians, writes it into the folder `output`, and returns the row of its results.json.

    model: a .ply, .splat, .spz or .glb, an output folder of `dsmoe train`, or a model folder of 3DGS. scene: the
    folder of its photographs; None: what the model's folder names. Where that is not there, the model's renderings at
    the cameras of its cameras.json take their place. One of three says how many Gaussians stay: budget, their number;
    keep, a part of the model's; loses, the fewest with which the PSNR of the training views falls by at most so many
    dB. resume, overwrite, say: as `train` has them. options: of TrainConfig, such as blend_mode, iterations (7,000),
    device, seed or resolution.
    The row's `start` has the model's own figures. Raises TrainerError, mostly before anything is written.
    """
    if sum(number is not None for number in (budget, keep, loses)) != 1:
        raise ConfigError("how many Gaussians are to stay? give one of --budget N, --keep PART and --loses DB")
    check_device(options.get("device", "cpu"))
    found = find_model(model)
    start = read_start(found.path)
    config = _config(model, found, start, {"output": output, **({"scene": scene} if scene else {}), **options})
    numbers = [_budget(start, budget, keep)] if loses is None else _ladder(start.count)
    if loses is not None and not loses >= 0:
        raise ConfigError(f"--loses is {loses}; it must be at least 0")
    if resume and loses is not None and holds_run(output):
        numbers = [number for number in numbers if number >= TrainConfig.load(output).budget] or numbers[-1:]
    config = config.changed(budget=numbers[0])
    finds_center = "principal_point" not in options and not (is_folder(model) and holds_run(model))
    if finds_center and resume and holds_run(output):
        config = config.changed(principal_point=TrainConfig.load(output).principal_point)
    earlier_files(config, resume, overwrite)
    measured = _measure(config, start, say, progress, finds_center, found)
    if loses is None:
        row = train(measured.config, resume, overwrite, progress, scene=measured.scene, say=say)
    else:
        row = _fewest(measured, numbers, loses, resume, overwrite, progress, say)
    row["start"] = _figures(measured)
    write_results(output, [row])
    return row


def _config(model: str, found: Found, start: Start, given: Dict[str, Any]) -> TrainConfig:
    """The options of the training: the given ones, those of the model's folder, and the preset's. Raises ConfigError.
    """
    blend = blend_options(start, given)
    mode = blend["blend_mode"]
    if start.blend_mode != "alpha" and mode != start.blend_mode:
        raise ConfigError(f"{model} is blended by {start.blend_mode}, and --blend-mode is {mode}; simplify it as it "
                          "is, then `dsmoe export OUT --bake alpha -o model.ply` makes an alpha model of it")
    recorded = found.options_on(given.get("scene") or "")
    if mode != recorded.pop("blend_mode", mode):
        recorded.pop("background_gate", None)
    options = {**blend, **recorded, **given, "blend_mode": mode, "init": found.path}
    if not options.get("scene"):
        why = (f"the scene that its folder names, {found.missing}, is not there, and the folder has no cameras.json"
               if found.missing else "neither photographs nor cameras are known")
        raise ConfigError(f"{model}: {why}; name its scene with --scene, or a model folder that holds cameras.json")
    iterations = options.setdefault("iterations", SIMPLIFY_ITERATIONS)
    if not isinstance(iterations, int) or iterations < 4:
        raise ConfigError(f"--iterations is {iterations!r}; it must be a whole number of at least 4")
    preset = {"densify_until_iter": max(2, round(UNTIL * iterations)), "position_lr_max_steps": iterations,
              "position_lr_init": FIRST_POSITION_RATE, "sh_degree": start.gaussians.sh_degree,
              "checkpoint_every": CHECKPOINT_EVERY[options.get("device", "cpu")]}
    return TrainConfig(strategy="importance", **{**preset, **options})


def _budget(start: Start, budget: Optional[int], keep: Optional[float]) -> int:
    """How many Gaussians are to stay. Raises ConfigError."""
    if keep is not None and not 0 < keep <= 1:
        raise ConfigError(f"--keep is {keep}; it must be above 0 and at most 1, the part of the Gaussians that stay")
    number = budget if budget is not None else max(LEAST, round((keep or 1) * start.count))
    if number < LEAST:
        raise ConfigError(f"--budget is {number}; it must be at least {LEAST}")
    if number > start.count:
        raise ConfigError(f"--budget is {number}; it must be at most {start.count}, which {start.path} has: to grow "
                          f"it, `dsmoe train SCENE --init {typed(start.path)}`")
    return number


def _ladder(count: int) -> List[int]:
    """The budgets that --loses tries, rising, up to the model's own number."""
    budgets, part = [], FIRST_PART
    while part < 1:
        budgets.append(max(LEAST, round(part * count)))
        part *= STEP
    return sorted({*budgets, count})


def _measure(config: TrainConfig, start: Start, say: Optional[Callable[[str], None]], progress: bool,
             finds_center: bool, found: Found) -> _Measured:
    """Loads the scene, and looks whether the model shows it. Raises TrainerError.

    finds_center: whether the model may tell where its program had the principal points.
    """
    config.validate()
    try:
        layout = read_layout(config)
    except SceneError as error:
        if not found.teacher or config.scene != found.options.get("scene"):
            raise
        raise SceneError(f"{error}; --scene {typed(str(found.teacher['scene']))} takes the model's renderings in "
                         "place of photographs") from error
    scene = load_scene(dataclasses.replace(config, init=""), progress, layout).starting_with(start)
    if say:
        if found.missing and scene.kind == "model":
            say(f"note: the scene that its folder names, {found.missing}, is not there; the model's renderings take "
                "the place of photographs, unless --scene names these")
        say(f"{start.path}: {start.count:,} Gaussians of SH degree {start.gaussians.sh_degree}, blend mode "
            f"{start.blend_text}, {os.path.getsize(start.path) / 1e6:.1f} MB")
        change = change_of_blend(start, config)
        if change:
            say(change)
        say(describe_scene(scene, layout, config))
    quality = check_start(scene, config)
    if finds_center and quality.is_centred:
        scene, config = scene.centred(), config.changed(principal_point="centre")
    if say and scene.kind != "model":  # which agrees with itself
        say(quality.text(config))
    return _Measured(start, start_renderer(start, config), scene, config)


def _fewest(measured: _Measured, budgets: List[int], loses: float, resume: bool, overwrite: bool, progress: bool,
            say: Optional[Callable[[str], None]]) -> Dict[str, Any]:
    """Tries the budgets, rising, until one loses no more. Raises TrainerError if none does."""
    device = measured.config.device
    scene = measured.scene.to(device)
    if scene.kind == "model":
        raise ConfigError("--loses compares with photographs, and these are the model's own renderings, of which it "
                          "loses nothing; give --budget or --keep, or name the photographs with --scene")

    def train_psnr(renderer: Renderer) -> float:
        return float(evaluate(renderer, scene.train, device, passes=1).metrics["psnr"] or 0)

    before = train_psnr(measured.renderer)
    make_folder(measured.config.output)
    with only_one(measured.config.output) as lock:  # over all of them
        for budget in budgets:
            config = measured.config.changed(budget=budget)
            row = train(config, resume, overwrite, progress, scene=measured.scene, say=say, lock=lock)
            path = model_path(config.output, config.iterations)
            after = train_psnr(open_renderer(config, path, None, device))
            lost = before - after
            if say:
                than = f"{lost:.2f} dB less" if lost >= 0 else f"{-lost:.2f} dB more"
                say(f"{budget:,} Gaussians: {after:.2f} dB on the training images, {than} than the model")
            if lost <= loses:
                return row
            resume, overwrite = False, True
    raise TrainerError(f"{measured.config.output}: even {budgets[-1]:,} Gaussians lose {lost:.2f} dB, more than "
                       f"--loses {loses:g}; the folder holds that model")


def _figures(measured: _Measured) -> Dict[str, Any]:
    """The model's own, for the row."""
    scene = measured.scene.to(measured.config.device)
    evaluation: Evaluation = evaluate(measured.renderer, scene.test, measured.config.device)
    metrics = {name: None if scene.kind == "model" else value for name, value in evaluation.metrics.items()}
    if not scene.test and scene.kind != "model":  # they alone tell what has changed
        metrics["psnr_train"] = evaluate(measured.renderer, scene.train, measured.config.device, passes=1
                                         ).metrics["psnr"]
    return {"blend_mode": measured.start.blend_mode, "background_gate": measured.start.background_gate,
            "protocol": {} if measured.start.faint_below is None else {"faint_below": measured.start.faint_below},
            **metrics, "num_gaussians": measured.start.count, "train_seconds": None, "fps": evaluation.fps,
            "bytes": os.path.getsize(measured.start.path)}
