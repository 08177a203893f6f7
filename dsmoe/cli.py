"""The `dsmoe` command: each of its commands in a few lines over what does the work."""
from __future__ import annotations

import argparse
import contextlib
import difflib
import os
import shlex
import sys
from typing import TYPE_CHECKING, Any, Dict, List, Optional, Tuple

from .arguments import build_parser, completion_script
from .errors import TrainerError, in_one_line, is_lost, print_any_name, printable, report
from .options.config import CHECKPOINT_NAME, TrainConfig, holds_run
from .options.config_arguments import config_from_arguments, given_options, take_paper
from .options.early import check_early
from .options.presets import STRATEGY
from .patches import PatchError
from .system.interrupt import PromptInterrupt, exit_status
from .system.process import command, typed

if TYPE_CHECKING:
    from .results.evaluation import Measure
    from .scenes.layout import Layout
    from .system.group import Group


OF_OTHERS = {  # what other trainers call an option of `dsmoe train`
    **dict.fromkeys(("--steps", "--max-steps", "--num-steps", "--iters", "--max-iters", "--max-num-iterations"),
                    "--iterations"),
    **dict.fromkeys(("--cap-max", "--max-cap", "--max-gaussians", "--num-gaussians"), "--budget"),
    **dict.fromkeys(("-m", "--model-path", "--out", "--result-dir", "--output-dir"), "--output"),
    **dict.fromkeys(("-s", "--source-path", "--data", "--data-dir"), "SCENE"),
    **dict.fromkeys(("--downscale-factor", "--data-factor"), "--resolution")}


def main(argv: Optional[List[str]] = None) -> int:
    """Runs the command; returns its exit status: 0, 1 on an error that its text explains, 130 or 143 if interrupted."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch: its idle threads sleep and do not spin
    print_any_name()
    parser = build_parser()
    arguments, unknown = parser.parse_known_args(argv)
    if not unknown and getattr(arguments, "action", True) is None or arguments.command is None:
        getattr(arguments, "command_parser", parser).print_help(sys.stderr)
        return 2
    arguments.command_words = list(sys.argv[1:] if argv is None else argv)
    if unknown:  # argparse would show the usage of `dsmoe` alone
        _refuse(unknown, getattr(arguments, "command_parser", parser))
    try:
        take_paper(arguments)
        check_early(arguments)
        with PromptInterrupt() if arguments.command in ("render", "export") else contextlib.nullcontext():
            status = COMMANDS[arguments.command](arguments) or 0
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever read the output, such as `head`, has enough of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        of_patch = isinstance(error, PatchError)  # which lists reasons line by line
        text = "\n".join(map(printable, str(error).split("\n"))) if of_patch else in_one_line(error)
        return report(f"dsmoe {arguments.command}", error, text)
    except KeyboardInterrupt as stop:
        trains = arguments.command in ("train", "simplify")
        continues = trains and os.path.isfile(os.path.join(arguments.output, CHECKPOINT_NAME))
        hint = f"; continue it with: {_resume_command(arguments)}" if continues else ""
        if arguments.command == "scene" or arguments.command == "bench" and arguments.action == "run":
            hint = "; the same command continues"
        print(f"\ndsmoe {arguments.command}: interrupted{hint}", file=sys.stderr)
        return exit_status(stop)


def _resume_command(arguments: argparse.Namespace) -> str:
    """What to type to continue an interrupted training."""
    if arguments.command == "simplify":
        given = [word for word in arguments.command_words if word not in ("--resume", "--overwrite")]
        return " ".join([command(), *map(shlex.quote, given), "--resume"])
    words = [command(), "train", "--resume", "-o", typed(arguments.output)]
    size = os.environ.get("WORLD_SIZE", "1")
    if size == "1":
        return " ".join(words)
    if os.environ.get("LOCAL_WORLD_SIZE") == size and TrainConfig.load(arguments.output).device == "cuda":
        return " ".join([*words, "--gpus", size])
    return " ".join([*words, "(by torchrun, as before)"])


def _refuse(unknown: List[str], parser: argparse.ArgumentParser) -> None:
    """Ends the command with its usage, the words that it does not know, and the options that may be meant."""
    options = [option for action in parser._actions for option in action.option_strings]
    named = [word.partition("=")[0].replace("_", "-") for word in unknown if word.startswith("-")]
    known = [name for name in map(OF_OTHERS.get, named) if name in (*options, "SCENE")]
    meant = known or [name for word in named if word.startswith("--")
                      for name in difflib.get_close_matches(word, options, n=1, cutoff=0.7)]
    parser.error("unrecognized arguments: " + " ".join(unknown)
                 + (f" (is {', '.join(meant)} meant?)" if meant else ""))


def _choose_device(arguments: argparse.Namespace) -> None:
    """Replaces `auto` by a device, and says which it is."""
    from .system.device import chosen_device, device_line

    arguments.device = chosen_device(arguments.device)
    print(device_line(arguments.device), flush=True)


def _bench(arguments: argparse.Namespace) -> Optional[int]:
    return _bench_run(arguments) if arguments.action == "run" else _bench_report(arguments)


def _bench_run(arguments: argparse.Namespace) -> int:
    from .bench import require

    require("yaml", "pydantic")
    from .bench.engine import rows_table, run_suite

    rows = run_suite(arguments.suite, results=arguments.output, jobs=arguments.jobs, slurm=arguments.slurm,
                     retry_failed=arguments.retry_failed, dry_run=arguments.dry_run, only=arguments.only,
                     per_gpu=arguments.per_gpu, rows=arguments.rows, device=arguments.device,
                     iterations=arguments.iterations, scenes=arguments.scenes)
    if rows:
        print(rows_table(rows))
    failed = sum(not row["ok"] for row in rows)
    if failed:
        print(f"{failed} of {len(rows)} cells failed; their rows say why, --retry-failed runs them again")
    if rows:
        results = arguments.output or os.path.join("bench_results", rows[0]["suite"])
        print(f"rows: {printable(results)}; tables and curves of them: {command()} bench report {typed(results)}")
    return 1 if failed else 0


def _bench_report(arguments: argparse.Namespace) -> None:
    from .bench import require

    require("pydantic", "jinja2", "matplotlib")
    from .bench.report import report

    print(report(arguments.results, arguments.output))


def _patch(arguments: argparse.Namespace) -> int:
    from .patches import commands

    options = {name: value for name, value in vars(arguments).items() if name in ("modernise", "fuse", "trainer")}
    return getattr(commands, arguments.action)(arguments.path, **options)


def _run(arguments: argparse.Namespace) -> None:
    from .patches.run import TRAINER_LIST, run

    words = arguments.words[1:] if arguments.words[:1] == ["--"] else arguments.words
    if arguments.trainer == "list":
        print(TRAINER_LIST)
        return
    if not arguments.blend_mode:
        arguments.command_parser.error("--blend-mode MODE or --paper is needed")
    run(words, arguments.blend_mode, arguments.trainer, arguments.background_gate, arguments.faint_below)


def _train(arguments: argparse.Namespace) -> Optional[int]:
    from .system.device import check_device
    from .system.group import join_group, launched_by_torchrun, leave_group
    from .system.process import set_up_process

    gpus = arguments.gpus
    if gpus is not None:
        if launched_by_torchrun():
            raise TrainerError("--gpus is given to a process that torchrun has started; leave out one of the two")
        if not arguments.resume and getattr(arguments, "device", "auto") == "auto":
            arguments.device = "cuda"
            arguments.command_words += ["--device", "cuda"]
    config, layout = _train_config(arguments)
    if gpus is not None:
        from .system.torchrun import chosen_gpus, launch, without_gpus

        return launch(chosen_gpus(gpus, config.device, config.batch), without_gpus(arguments.command_words))
    check_device(config.device)
    set_up_process(config.device)
    group = join_group(config.device)
    try:
        _train_in(group, config, layout, arguments)
    except KeyboardInterrupt as stop:
        if group.leads:
            raise
        return exit_status(stop)  # the first process says it
    except Exception as error:
        text = "another process has ended" if group.size > 1 and is_lost(error) else in_one_line(error)
        if text is None or group.size == 1:
            raise
        raise TrainerError(f"process {group.rank}: {text}") from error
    finally:
        leave_group(group)
    return None


def _train_in(group: Group, config: TrainConfig, layout: Optional[Layout], arguments: argparse.Namespace) -> None:
    from .results.modelfile import model_path
    from .results.rows import blend_name, results_table, viewer_warning
    from .system.device import device_line
    from .train import train

    if not group.leads:
        train(config, arguments.resume, arguments.overwrite, progress=False, group=group, layout=layout)
        return
    print(device_line(config.device), flush=True)
    blend = blend_name(config.blend_mode, config.background_gate, config.unusual_faint)
    budget = f" to {config.budget} Gaussians" if config.budget else ""
    batch = f", {config.batch} views a step" if config.batch > 1 else ""
    processes = f", in {group.size} processes" if group.size > 1 else ""
    print(f"{printable(config.scene)} -> {printable(config.output)}: blend mode {blend}, strategy "
          f"{config.strategy}{budget}, {config.iterations} iterations{batch}{processes}, seed {config.seed}")
    if group.size > config.batch:
        print(f"note: {group.size} processes share {config.batch} view{'s' if config.batch > 1 else ''} a step, so "
              f"{group.size - config.batch} blend nothing; --batch {group.size} keeps all busy")
    chooses = config.strategy == STRATEGY and not arguments.resume
    if chooses and not getattr(arguments, "budget", 0):
        whose = "that of the model" if config.init else "chosen for the scene"
        print(f"note: that number is {whose}; --budget N makes more or fewer, and --strategy 3dgs is the "
              "densification of 3DGS")
    if chooses and config.iterations < TrainConfig.iterations and not (
            hasattr(arguments, "iterations") or arguments.fast or arguments.best):
        print("note: fewer iterations, as the scene has few photographs; --iterations N sets another number")
    for note in config.notes():
        print(f"note: {note}")
    row = train(config, arguments.resume, arguments.overwrite, progress=not arguments.quiet, group=group,
                say=lambda text: print(text, flush=True), layout=layout)
    print(results_table([row]))
    if row["psnr_train"] is not None:
        print(f"the training views have {row['psnr_train']:.2f} dB")
    if row["psnr"] is None:
        print("the scene has no test images: nothing was measured")
    if viewer_warning(row):
        print(viewer_warning(row))
    print(f"model: {printable(model_path(config.output, config.iterations))}")
    print(f"to look at it in a browser: {command()} export {typed(config.output)} -o model.html")


def _simplify(arguments: argparse.Namespace) -> None:
    from .results.modelfile import model_path
    from .results.rows import results_table, viewer_warning
    from .simplify import simplify
    from .system.process import set_up_process

    arguments.device = getattr(arguments, "device", "auto")
    _choose_device(arguments)
    set_up_process(arguments.device)
    given = {name: value for name, value in given_options(arguments).items()
             if name not in ("scene", "output", "budget")}
    row = simplify(arguments.model, arguments.output, scene=arguments.scene, budget=arguments.budget,
                   keep=arguments.keep, loses=arguments.loses, resume=arguments.resume, overwrite=arguments.overwrite,
                   progress=not arguments.quiet, say=lambda text: print(text, flush=True), **given)
    print(results_table([row["start"], row]))
    if row["protocol"]["scene_kind"] == "model":
        print("measured against renderings of the model: there are no photographs")
    if row["psnr"] is None and row["psnr_train"] is not None:
        before = row["start"].get("psnr_train")
        print(f"the training views have {row['psnr_train']:.2f} dB"
              + ("" if before is None else f", and {before:.2f} dB before"))
    if viewer_warning(row):
        print(viewer_warning(row))
    path = model_path(arguments.output, row["protocol"]["iterations"])
    print(f"model: {printable(path)}, {os.path.getsize(path) / 1e6:.1f} MB of {row['start']['bytes'] / 1e6:.1f} MB")
    # Viewers blend by alpha; to bake a model to that needs photographs.
    bakes = row["blend_mode"] != "alpha" and row["protocol"]["scene_kind"] != "model"
    web = "model.spz" if bakes or row["blend_mode"] == "alpha" else "model.html"
    print(f"for the web: {command()} export {typed(arguments.output)}{' --bake alpha' * bakes} -o {web}")


def _train_config(arguments: argparse.Namespace) -> Tuple[TrainConfig, Optional[Layout]]:
    """The options of a training: those that are given, and for --resume the run's own; the scene's layout if read."""
    given = given_options(arguments)
    if arguments.resume and set(given) & {"scene", "output"} == {"scene"}:  # dsmoe train --resume OUT
        given["output"] = arguments.output = given.pop("scene")
        del arguments.scene
    if not given.get("output") or not given.get("scene") and not arguments.resume:
        arguments.command_parser.error("SCENE and -o OUT are needed; --resume needs only OUT")
    presets = [f"--{name}" for name in ("fast", "best") if getattr(arguments, name)]
    presets += ["--scale-recipe"] * arguments.scale_recipe
    if arguments.resume and presets and "scene" not in given:
        arguments.command_parser.error(f"{presets[0]} needs SCENE; --resume alone keeps the run's milestones")
    run = given.pop("output")
    if given.get("device", "auto") == "auto":
        from .system.device import chosen_device

        earlier = TrainConfig.load(run).device if arguments.resume and holds_run(run) else None
        given["device"] = arguments.device = earlier or chosen_device()
    if given.get("init"):
        _start_from(arguments)
    if not arguments.resume or "scene" in given and (presets or not holds_run(run)):
        earlier_run = TrainConfig.load(run, continues=True) if arguments.resume and holds_run(run) else None
        return config_from_arguments(arguments, earlier_run)
    return TrainConfig.of_run(run, "SCENE", resumes=True, **given), None


def _start_from(arguments: argparse.Namespace) -> None:
    """--init becomes the model's file, and the blend is its own unless another one is asked for."""
    from .starting import blend_options, find_model, read_start

    arguments.init = find_model(arguments.init).path
    for name, value in blend_options(read_start(arguments.init), given_options(arguments)).items():
        setattr(arguments, name, value)


def _scene(arguments: argparse.Namespace) -> None:
    from .options.short_run import train_command
    from .photos import make_scene
    from .system.device import device_to_train_on

    device = device_to_train_on()
    made = make_scene(arguments.photos, arguments.output, arguments.matching, arguments.camera_model,
                      not arguments.quiet, say=lambda text: print(text, flush=True), lenses=arguments.lenses,
                      fov=arguments.fov)
    print(made)
    words = [train_command(arguments.output, 'MODEL', device, *made.size), *made.options]
    print(f"to train on it: {' '.join(words)}")


def _eval(arguments: argparse.Namespace) -> None:
    from .inspection import evaluate_run
    from .results.metrics import image_metrics
    from .results.rows import results_table

    _choose_device(arguments)
    measure = _with_lpips(arguments.lpips, arguments.device) if arguments.lpips else image_metrics
    row = evaluate_run(arguments.output, arguments.device, arguments.split, arguments.scene, measure=measure)
    print(f"{arguments.split} views")
    print(results_table([row]))
    if arguments.lpips:
        print(f"LPIPS ({arguments.lpips}, v0.1, 8-bit images in [-1, 1]): {row['lpips_' + arguments.lpips]:.4f}")


def _with_lpips(net: str, device: str) -> Measure:
    """The trainer's metrics and LPIPS of images without a mask. Raises TrainerError if its weights are not there."""
    from .bench.errors import BenchError
    from .bench.lpips import lpips_network
    from .bench.names import check_weights
    from .results.metrics import image_metrics, quantised

    kind = {"vgg": "lpips_vgg_std", "alex": "lpips_alex"}[net]
    try:
        check_weights([kind])
        distance = lpips_network(kind, device)
    except (BenchError, ImportError, ValueError) as error:
        raise TrainerError(f"--lpips {net}: {error}") from error

    def measure(image: Any, target: Any, mask: Any, padding: str) -> Dict[str, Optional[float]]:
        if mask is not None:
            raise TrainerError("--lpips: the scene has masks, and LPIPS of a part of an image is not defined")
        return {**image_metrics(image, target, None, padding), "lpips_" + net: distance(quantised(image), target)}

    return measure


def _render(arguments: argparse.Namespace) -> None:
    from .inspection import config_of_model, render_images

    _choose_device(arguments)
    overrides = _overrides(arguments)
    outputs = [name for name in ("depth", "alpha") if getattr(arguments, name)]
    if arguments.orbit:
        _render_orbit(arguments, overrides, outputs)
        return
    if holds_run(arguments.model):
        config, ply = TrainConfig.of_run(arguments.model, "--scene", **overrides), None
    else:
        config, ply, missing = config_of_model(arguments.model, **overrides)
        if not config.scene:
            why = f", and the scene that it names, {missing}, is not there" if missing else ""
            raise TrainerError(f"{arguments.model} holds no cameras{why}; name the folder that has them with --scene")
    paths = render_images(config, ply, arguments.output, arguments.split, arguments.blend_mode, arguments.device,
                          background_gate=arguments.background_gate, outputs=outputs,
                          overwrite=arguments.overwrite, faint_below=arguments.faint_below)
    print(f"{len(paths)} images in {arguments.output}")


def _render_orbit(arguments: argparse.Namespace, overrides: Dict[str, Any], outputs: List[str]) -> None:
    from .filming import film
    from .inspection import open_trained

    trained = open_trained(arguments.model, arguments.blend_mode, arguments.background_gate, arguments.device,
                           arguments.faint_below, **overrides)
    given = {name: value for name, value in vars(arguments).items() if name in ("frames", "fps")}
    print(film(trained, arguments.output, outputs=outputs, overwrite=arguments.overwrite, **given))


def _overrides(arguments: argparse.Namespace) -> Dict[str, Any]:
    """The options of a run that a command was given in their place."""
    names = ("scene", "resolution", "principal_point", "white_background")
    return {name: getattr(arguments, name) for name in names if getattr(arguments, name, None) is not None}


def _export(arguments: argparse.Namespace) -> None:
    from .export.command import export

    if arguments.bake:
        _choose_device(arguments)
    given = {name: value for name, value in vars(arguments).items() if name == "bake_iterations"}
    path, warning = export(arguments.model, arguments.output, arguments.format, arguments.sh_degree,
                           arguments.blend_mode, arguments.background_gate, overwrite=arguments.overwrite,
                           bake=arguments.bake, device=arguments.device if arguments.bake else "cpu",
                           faint_below=arguments.faint_below, **given, **_overrides(arguments))
    print(f"{path}: {os.path.getsize(path):,} bytes")
    if warning:
        print(warning)


def _view(arguments: argparse.Namespace) -> None:
    from .view.following import Followed
    from .view.server import Viewer

    _choose_device(arguments)
    viewer = Viewer(Followed(arguments.model, arguments.blend_mode, arguments.background_gate, arguments.device,
                             arguments.faint_below, **_overrides(arguments)), arguments.host, arguments.port)
    print(f"{viewer.address}/?darkMode: open it in a browser; Ctrl-C ends", flush=True)
    viewer.wait()


def _info(arguments: argparse.Namespace) -> None:
    if arguments.cmake:
        from diff_smoe_rasterization.extension import cmake_prefix_path

        print(cmake_prefix_path())
        return
    from .system.environment import describe

    print(describe())


def _completion(arguments: argparse.Namespace) -> None:
    print(completion_script(arguments.shell))


COMMANDS = {"train": _train, "simplify": _simplify, "scene": _scene, "eval": _eval, "render": _render,
            "export": _export, "view": _view, "patch": _patch, "run": _run, "bench": _bench, "info": _info,
            "completion": _completion}
