"""The `dsmoe` command: scene, train, eval, render, patch, run, bench, info; a few lines each over what does it."""
from __future__ import annotations

import argparse
import os
import shlex
import sys
from typing import TYPE_CHECKING, Any, Dict, Iterator, List, Optional, Tuple

from diff_smoe_rasterization._version import __version__
from diff_smoe_rasterization.settings import BLEND_MODES

from .config import (
    CHECKPOINT_NAME,
    DEVICES,
    PRINCIPAL_POINTS,
    TrainConfig,
    add_arguments,
    config_from_arguments,
    given_options,
    holds_run,
)
from .errors import TrainerError, in_one_line, is_lost, printable
from .patches import TRAINERS, PatchError
from .system.files import is_folder
from .system.interrupt import exit_status

if TYPE_CHECKING:
    from .results.evaluation import Measure
    from .system.group import Group


TRAIN_EXAMPLES = """examples:
  dsmoe train garden -o garden_model                              the recipe of 3DGS
  dsmoe train garden -o small --blend-mode smoe --budget 30000    a model of 30,000 Gaussians
  dsmoe train garden -o quick --iterations 3000 --scale-recipe --resolution 4    minutes on a processor"""


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(prog="dsmoe", description="Gaussian splatting with alpha and SMoE blending.")
    parser.add_argument("--version", action="version", version=f"dsmoe {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="train Gaussians on a scene",
                                usage="%(prog)s SCENE -o OUT [OPTION ...]\n       %(prog)s --resume OUT [OPTION ...]",
                                description="Trains Gaussians on a scene: photographs whose cameras are known.",
                                formatter_class=argparse.RawDescriptionHelpFormatter, epilog=TRAIN_EXAMPLES)
    train.add_argument("scene", metavar="SCENE", nargs="?", default=argparse.SUPPRESS,
                       help="folder of a COLMAP scene, of a transforms.json (nerfstudio, instant-ngp, Polycam) or of a "
                            "NeRF-synthetic scene; --resume finds it in OUT")
    train.add_argument("-o", "--output", metavar="OUT", default=argparse.SUPPRESS, help="folder to write")
    groups = add_arguments(train, skip=("scene", "output"))
    groups["length, and number of Gaussians"].add_argument(
        "--scale-recipe", action="store_true",
        help="squeeze the recipe into --iterations: its milestones (densification, resets, learning rate, SH degrees) "
             "keep their share of 30,000 steps, unless they are given")
    earlier_run = groups["run"].add_mutually_exclusive_group()
    earlier_run.add_argument("--resume", action="store_true",
                             help="continue the run in OUT from its last checkpoint with its own options; more "
                                  "--iterations extend it")
    earlier_run.add_argument("--overwrite", action="store_true",
                             help="replace the run in OUT, once this one can start")
    groups["run"].add_argument(
        "--gpus", type=int, metavar="N",
        help="train on so many GPUs of this machine: torchrun starts this command once for each; with --batch N or "
             "more")
    groups["run"].add_argument("--quiet", action="store_true", help="no progress bars")
    train.set_defaults(run=_train)

    scene = commands.add_parser("scene", help="make a scene of photographs",
                                description="Finds where photographs were taken, by COLMAP, and writes a scene for "
                                            "`dsmoe train`: images without lens distortion, cameras and points. It "
                                            "needs pycolmap. Started again it goes on with what it has found.")
    scene.add_argument("photos", metavar="PHOTOS", help="folder of photographs; subfolders are read too")
    scene.add_argument("-o", "--output", metavar="SCENE", required=True,
                       help="folder to write: new, empty, or of the same photographs")
    scene.add_argument("--matching", choices=("auto", "exhaustive", "sequential"), default="auto",
                       help="which photographs are compared. exhaustive: all pairs; sequential: neighbours by name, as "
                            "of a video; auto: all pairs of up to 200 (default: auto)")
    scene.add_argument("--camera-model", default="OPENCV",
                       choices=("PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"),
                       help="of the lens, by COLMAP's names (default: OPENCV)")
    scene.add_argument("--quiet", action="store_true", help="no progress bars")
    scene.set_defaults(run=_scene)

    evaluate = commands.add_parser("eval", help="measure a trained run again",
                                   description="Measures PSNR, SSIM and FPS of a finished run.")
    evaluate.add_argument("output", metavar="OUT", help="output folder of `dsmoe train`")
    evaluate.add_argument("--split", choices=("test", "train"), default="test", help="which views (default: test)")
    evaluate.add_argument("--scene", help="where the scene lies now, if it has moved")
    evaluate.add_argument("--lpips", choices=("vgg", "alex"),
                          help="also LPIPS with this network; weights: $DSMOE_LPIPS_VGG or $DSMOE_LPIPS_ALEX, else "
                               "torchmetrics downloads them")
    _add_device(evaluate)
    evaluate.set_defaults(run=_eval)

    render = commands.add_parser("render", help="write images or a video of a trained run or a .ply",
                                 description="Writes one PNG for every camera of a scene, or a video around it.")
    render.add_argument("source", metavar="OUT|PLY", help="output folder of `dsmoe train`, or a .ply file")
    render.add_argument("-o", "--output", metavar="DIR|VIDEO", required=True,
                        help="folder for the images: new, empty, or of an earlier rendering; with --orbit also a file "
                             "that ends in .mp4 (needs imageio-ffmpeg) or .gif")
    render.add_argument("--orbit", action="store_true", help="once around what the scene's cameras look at")
    render.add_argument("--frames", type=int, default=120, metavar="N", help="of an orbit (default: 120)")
    render.add_argument("--fps", type=float, default=30.0, metavar="X", help="of a video (default: 30)")
    render.add_argument("--split", choices=("test", "train", "all"), default="test",
                        help="which cameras (default: test)")
    _add_model_options(render, "whose cameras are rendered (default: the run's; needed for a .ply)")
    render.add_argument("--resolution", type=int, metavar="N",
                        help="as in train (default: the run's, for a .ply -1)")
    render.add_argument("--principal-point", choices=PRINCIPAL_POINTS,
                        help="as in train (default: the run's, for a .ply scene)")
    render.add_argument("--depth", action="store_true",
                        help="also NAME.depth.npy: view depth in the scene's units [H, W] float32, 0: nothing is hit")
    render.add_argument("--alpha", action="store_true",
                        help="also NAME.alpha.png: how much of a pixel Gaussians cover, 8 bits")
    render.add_argument("--overwrite", action="store_true",
                        help="write into any folder, and replace files of the same names; a VIDEO that is there too")
    _add_device(render)
    render.set_defaults(run=_render)

    export = commands.add_parser("export", help="write a trained model for other programs, or as a page to look at",
                                 description="Writes a trained model as one file. A page (.html) shows it in a "
                                             "browser by the blend that it was trained with; other viewers show the "
                                             "other formats by alpha.")
    export.add_argument("source", metavar="OUT|PLY", help="output folder of `dsmoe train`, or a .ply file")
    export.add_argument("-o", "--output", metavar="FILE", help="file to write (default: model.FORMAT)")
    export.add_argument("--format", choices=("html", "ply", "splat", "spz", "glb"),
                        help="default: by the ending of FILE, else html; spz needs gsply")
    export.add_argument("--sh-degree", type=int, choices=range(4), metavar="N",
                        help="keep view-dependent colour up to this degree: smaller files (default: all; .splat "
                             "holds degree 0)")
    export.add_argument("--bake", choices=("alpha",),
                        help="first fine-tune the model to this blend, which every viewer shows; needs the scene's "
                             "images, and prints the dB that it costs")
    export.add_argument("--bake-iterations", type=int, default=5000, metavar="N", help="(default: 5000)")
    _add_model_options(export, "whose test views the page begins with, and on which --bake trains (default: the run's)")
    export.add_argument("--overwrite", action="store_true", help="replace a FILE that is there")
    _add_device(export)
    export.set_defaults(run=_export)

    view = commands.add_parser("view", help="look at a trained model or a running training in the browser",
                               description="Serves a live viewer of a run's model, of the checkpoints of a training "
                                           "that goes on, or of a .ply. It needs viser.")
    view.add_argument("source", metavar="OUT|PLY", help="output folder of `dsmoe train`, or a .ply file")
    _add_model_options(view, "at whose first test view it begins (default: the run's)")
    view.add_argument("--host", default="127.0.0.1", help="address to serve at; 0.0.0.0: to the network too "
                                                          "(default: 127.0.0.1, this machine only)")
    view.add_argument("--port", type=int, default=8080, help="or the next free one (default: 8080)")
    _add_device(view)
    view.set_defaults(run=_view)

    patch = commands.add_parser("patch", help="make a public trainer's checkout train with this rasterizer",
                                description="Patches a checkout of a public trainer, which then knows the options "
                                            f"--blend_mode and --background_gate: {', '.join(TRAINERS)}.")
    _add_patch_arguments(patch)

    run = commands.add_parser("run", help="run an unmodified public trainer with this rasterizer",
                              usage="dsmoe run --blend-mode MODE [--background-gate V] [--trainer NAME] -- COMMAND ...",
                              description="Runs a command of an unmodified trainer with this rasterizer. Nothing is "
                                          "written into the checkout; what the command starts has the rasterizer too.")
    run.add_argument("--blend-mode", "--blend_mode", choices=BLEND_MODES, required=True,
                     help="nothing records it: give the same where a trained model is rendered")
    run.add_argument("--background-gate", "--background_gate", type=float, metavar="V",
                     help="in smoe, how much the background weighs; 0 is the paper's Eq. 7 (default: "
                          "$DSMOE_BACKGROUND_GATE, else 0); nothing records it either")
    run.add_argument("--trainer", metavar="NAME",
                     help="a trainer (3dgs-2023, ...) or, for other trainers, the rasterizer whose API they call "
                          "(inria, inria_2024, scaffold, ...); default: found out from the script's folder")
    run.add_argument("words", metavar="COMMAND", nargs=argparse.REMAINDER, help="such as: python train.py -s DATA")
    run.set_defaults(run=_run)

    bench = commands.add_parser("bench", help="compare blend modes and trainers over a suite of scenes",
                                description="Runs suites of training runs, measured alike, and reports on them.")
    _add_bench_arguments(bench)

    info = commands.add_parser("info", help="versions, backends, SIMD level, threads, GPU")
    info.add_argument("--cmake", action="store_true",
                      help="print only what CMAKE_PREFIX_PATH needs for find_package(diff_smoe_rasterization) in C++")
    info.set_defaults(run=_info)

    completion = commands.add_parser("completion", help="a script by which a shell completes commands and options",
                                     description="Prints a script for the shell. In ~/.bashrc or, behind compinit, in "
                                                 "~/.zshrc: eval \"$(dsmoe completion bash)\", respectively zsh.")
    completion.add_argument("shell", choices=("bash", "zsh"))
    completion.set_defaults(run=_completion)
    for command in (train, scene, evaluate, render, export, view, run, info, completion):
        command.set_defaults(command_parser=command)
    return parser


def main(argv: Optional[List[str]] = None) -> int:
    """Runs the command; returns its exit status: 0, 1 on an error that its text explains, 130 or 143 if interrupted."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch: its idle threads sleep, where they would spin
    parser = build_parser()
    arguments, unknown = parser.parse_known_args(argv)
    arguments.command_words = list(sys.argv[1:] if argv is None else argv)
    if unknown:  # argparse would show only the usage of `dsmoe`
        getattr(arguments, "command_parser", parser).error("unrecognized arguments: " + " ".join(unknown))
    try:
        status = arguments.run(arguments) or 0
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever read the output, such as `head`, has enough of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        text = str(error) if isinstance(error, PatchError) else in_one_line(error)
        if text is None:
            raise
        print(f"dsmoe {arguments.command}: error: {text}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as stop:
        continues = arguments.command == "train" and os.path.isfile(os.path.join(arguments.output, CHECKPOINT_NAME))
        hint = "; continue it with --resume" if continues else ""
        if arguments.command == "scene" or arguments.command == "bench" and arguments.action == "run":
            hint = "; the same command continues"
        print(f"\ndsmoe {arguments.command}: interrupted{hint}", file=sys.stderr)
        return exit_status(stop)


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", choices=DEVICES, default="auto",
                        help="where to render; auto: $DSMOE_DEVICE, else the GPU if it can be used (default: auto)")


def _choose_device(arguments: argparse.Namespace) -> None:
    """Replaces `auto` by a device, and says which it is."""
    from .system.device import chosen_device, device_line

    arguments.device = chosen_device(arguments.device)
    print(device_line(arguments.device), flush=True)


def _add_model_options(parser: argparse.ArgumentParser, scene: str) -> None:
    """What says how a trained model is opened; scene: what its folder is for."""
    parser.add_argument("--scene", help="folder " + scene)
    parser.add_argument("--blend-mode", choices=BLEND_MODES,
                        help="needed for a .ply that does not record it; must agree where it does")
    parser.add_argument("--background-gate", type=float, metavar="X",
                        help="background weight for smoe, if the .ply records none; old files without it used 0")
    parser.add_argument("--white-background", action="store_true", default=None,
                        help="white background (default: the run's, for a .ply black)")


def _add_patch_arguments(patch: argparse.ArgumentParser) -> None:
    actions = patch.add_subparsers(dest="action", required=True, metavar="ACTION")
    for name, text in (("apply", "patch the checkout; each line of the patch says so"),
                       ("check", "say whether it is patchable, and what is patched of it"),
                       ("diff", "show what the patch changes, and write nothing"),
                       ("revert", "take the patch out of every file, byte for byte")):
        action = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        action.add_argument("path", metavar="PATH", help="the checkout's folder")
        if name != "revert":
            action.add_argument("--modernise", action="store_true",
                                help="also what the trainer needs to start on today's torch, CUDA and Python")
            action.add_argument("--fuse", action="store_true",
                                help="also SSIM and Adam by this package's kernels: the same results, sooner")
            action.add_argument("--trainer", metavar="NAME", help="which trainer it is (default: found out)")
        action.set_defaults(run=_patch, command_parser=action)


def _add_bench_arguments(bench: argparse.ArgumentParser) -> None:
    actions = bench.add_subparsers(dest="action", required=True, metavar="ACTION")
    run = actions.add_parser("run", help="run what is not done yet of a suite",
                             description="Runs a suite with Snakemake; started again, it continues. A cell that fails "
                                         "becomes a row with its reason, and the command returns 1.",
                             usage="%(prog)s SUITE [-o RESULTS] [OPTION ...]")  # --slurm would take a SUITE behind it
    run.add_argument("suite", metavar="SUITE", help="a .yaml file, or a shipped one: smoke, table1, table2, table3, "
                                                    "fig4, fig5, captures, captures_ablation, captures_baselines, "
                                                    "gate, gate_equal, budgets")
    run.add_argument("-o", "--output", metavar="RESULTS", help="folder to write (default: bench_results/NAME)")
    run.add_argument("--device", choices=DEVICES,
                     help="where to train, in place of the suite's protocol.device; auto: the GPU if it can be used")
    run.add_argument("--jobs", type=int, metavar="N",
                     help="cells at once (default: --per-gpu on each GPU; on the CPU one, beyond which their times and "
                          "FPS stay out of the report)")
    run.add_argument("--per-gpu", type=int, default=1, metavar="K",
                     help="cells that share a GPU (default: 1); beyond 1 their times and FPS stay out of the report")
    run.add_argument("--slurm", nargs="*", metavar="KEY=VALUE",
                     help="submit cells to Slurm; resources of each, such as slurm_partition=gpu runtime=120 "
                          "mem_mb=32000 cpus_per_task=8")
    run.add_argument("--only", action="append", default=[], metavar="FIELD=VALUE",
                     help="only such cells; fields: method, scene, blend_mode, background_gate, schedule, "
                          "densify_grad_threshold, budget, seed, headline")
    run.add_argument("--rows", metavar="FILE|RESULTS",
                     help="a file of rows (.jsonl), or a folder of results, whose cells are not run again")
    run.add_argument("--retry-failed", action="store_true", help="run failed cells again")
    run.add_argument("--dry-run", action="store_true", help="say which cells are done and which are not")
    run.set_defaults(run=_bench_run)
    report = actions.add_parser("report", help="tables, curves and a page of results",
                                description="Writes tables, curves and a page that works offline.")
    report.add_argument("results", metavar="RESULTS", help="folder of `dsmoe bench run`, or a file rows.jsonl")
    report.add_argument("-o", "--output", metavar="DIR", default="report", help="folder to write (default: report)")
    report.set_defaults(run=_bench_report)


def _completion(arguments: argparse.Namespace) -> None:
    cases = "\n".join(f"    {path}) words='{' '.join(words)}' ;;" for path, words in _words_of(build_parser()))
    print(("autoload -U +X bashcompinit && bashcompinit\n" if arguments.shell == "zsh" else "") + f"""_dsmoe() {{
  local words
  case "${{COMP_WORDS[*]:1:COMP_CWORD-1}} " in
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o bashdefault -o default -F _dsmoe dsmoe""")


def _words_of(parser: argparse.ArgumentParser, path: str = "") -> Iterator[Tuple[str, List[str]]]:
    """(pattern of what is typed before, words that may follow) of a parser's commands and then its own."""
    words: List[str] = []
    for action in parser._actions:
        words += action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            words += action.choices
            for name, child in action.choices.items():
                yield from _words_of(child, f"{path}{name}\\ ")
    yield path + "*", words


def _bench_run(arguments: argparse.Namespace) -> int:
    from .bench import require

    require("yaml", "pydantic")
    from .bench.engine import rows_table, run_suite

    rows = run_suite(arguments.suite, results=arguments.output, jobs=arguments.jobs, slurm=arguments.slurm,
                     retry_failed=arguments.retry_failed, dry_run=arguments.dry_run, only=arguments.only,
                     per_gpu=arguments.per_gpu, rows=arguments.rows, device=arguments.device)
    if rows:
        print(rows_table(rows))
    failed = sum(not row["ok"] for row in rows)
    if failed:
        print(f"{failed} of {len(rows)} cells failed; their rows say why, --retry-failed runs them again")
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
    from .patches.run import run

    words = arguments.words[1:] if arguments.words[:1] == ["--"] else arguments.words
    run(words, arguments.blend_mode, arguments.trainer, arguments.background_gate)


def _train(arguments: argparse.Namespace) -> Optional[int]:
    from .system.group import join_group, launched_by_torchrun, leave_group
    from .system.process import set_up_process

    gpus = arguments.gpus
    if gpus is not None:
        if launched_by_torchrun():
            raise TrainerError("--gpus is given to a process that torchrun has started; leave out one of the two")
        if not arguments.resume and getattr(arguments, "device", "auto") == "auto":
            arguments.device = "cuda"
            arguments.command_words += ["--device", "cuda"]
    config = _train_config(arguments)
    if gpus is not None:
        from .system.torchrun import check_gpus, launch, without_gpus

        check_gpus(gpus, config.device)
        return launch(gpus, without_gpus(arguments.command_words))
    set_up_process(config.device)
    group = join_group(config.device)
    try:
        _train_in(group, config, arguments)
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


def _train_in(group: Group, config: TrainConfig, arguments: argparse.Namespace) -> None:
    from .results.modelfile import model_path
    from .results.rows import blend_name, results_table, viewer_warning
    from .system.device import device_line
    from .system.process import command
    from .training.loop import train

    if not group.leads:
        train(config, arguments.resume, arguments.overwrite, progress=False, group=group)
        return
    print(device_line(config.device), flush=True)
    blend = blend_name(config.blend_mode, config.background_gate)
    budget = f" to {config.budget} Gaussians" if config.budget else ""
    batch = f", {config.batch} views a step" if config.batch > 1 else ""
    processes = f", in {group.size} processes" if group.size > 1 else ""
    print(f"{printable(config.scene)} -> {printable(config.output)}: blend mode {blend}, strategy "
          f"{config.schedule}{budget}, {config.iterations} iterations{batch}{processes}, seed {config.seed}")
    if group.size > config.batch:
        print(f"note: {group.size} processes share {config.batch} view{'s' if config.batch > 1 else ''} a step, so "
              f"{group.size - config.batch} blend nothing; --batch {group.size} keeps all busy")
    if config.schedule == "gate" and 4 * config.densify_until_iter >= 3 * config.iterations:
        print(f"note: --densify-until-iter {config.densify_until_iter} leaves no iterations to settle; below three "
              "quarters of --iterations it does, and --scale-recipe makes it half of them")
    row = train(config, arguments.resume, arguments.overwrite, progress=not arguments.quiet, group=group,
                say=lambda text: print(text, flush=True))
    print(results_table([row]))
    if row["psnr"] is None:
        print("the scene has no test images: nothing was measured")
    if viewer_warning(row):
        print(viewer_warning(row))
    print(f"model: {printable(model_path(config.output, config.iterations))}")
    print(f"to look at it in a browser: {command()} export {shlex.quote(config.output)} -o model.html")


def _train_config(arguments: argparse.Namespace) -> TrainConfig:
    """The options of a training: those that are given, and for --resume the run's own."""
    given = given_options(arguments)
    if arguments.resume and set(given) & {"scene", "output"} == {"scene"}:  # dsmoe train --resume OUT
        given["output"] = arguments.output = given.pop("scene")
        del arguments.scene
    if "output" not in given or "scene" not in given and not arguments.resume:
        arguments.command_parser.error("SCENE and -o OUT are needed; --resume needs only OUT")
    if arguments.resume and arguments.scale_recipe and "scene" not in given:
        arguments.command_parser.error("--scale-recipe needs SCENE; --resume alone keeps the run's milestones")
    run = given.pop("output")
    if given.get("device", "auto") == "auto":
        from .system.device import chosen_device

        earlier = TrainConfig.load(run).device if arguments.resume and holds_run(run) else None
        given["device"] = arguments.device = earlier or chosen_device()
    if not arguments.resume or "scene" in given and (arguments.scale_recipe or not holds_run(run)):
        return config_from_arguments(arguments, TrainConfig.load(run) if arguments.resume and holds_run(run) else None)
    return TrainConfig.of_run(run, "SCENE", resumes=True, **given)


def _scene(arguments: argparse.Namespace) -> None:
    from .photos import make_scene
    from .system.process import command

    print(make_scene(arguments.photos, arguments.output, arguments.matching, arguments.camera_model,
                     not arguments.quiet, say=lambda text: print(text, flush=True)))
    print(f"to train on it: {command()} train {shlex.quote(arguments.output)} -o MODEL")


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
    """The trainer's metrics and LPIPS of images without a mask. Raises TrainerError where its weights are not there."""
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

    def measure(image: Any, target: Any, mask: Any = None) -> Dict[str, Optional[float]]:
        if mask is not None:
            raise TrainerError("--lpips: the scene has masks, and LPIPS of a part of an image is not defined")
        return {**image_metrics(image, target), "lpips_" + net: distance(quantised(image), target)}

    return measure


def _render(arguments: argparse.Namespace) -> None:
    from .inspection import render_images

    _choose_device(arguments)
    overrides = _overrides(arguments)
    outputs = [name for name in ("depth", "alpha") if getattr(arguments, name)]
    if arguments.orbit:
        _render_orbit(arguments, overrides, outputs)
        return
    if is_folder(arguments.source):
        config, ply = TrainConfig.of_run(arguments.source, "--scene", **overrides), None
    else:
        if not os.path.isfile(arguments.source):
            raise TrainerError(f"{arguments.source}: no such file or folder; name the output folder of `dsmoe train`, "
                               "or a .ply and --scene")
        if not arguments.scene:
            raise TrainerError("a .ply holds no cameras; name the folder that has them with --scene")
        config, ply = TrainConfig(blend_mode="alpha", **overrides).validate(), arguments.source
    paths = render_images(config, ply, arguments.output, arguments.split, arguments.blend_mode, arguments.device,
                          background_gate=arguments.background_gate, outputs=outputs,
                          overwrite=arguments.overwrite)
    print(f"{len(paths)} images in {arguments.output}")


def _render_orbit(arguments: argparse.Namespace, overrides: Dict[str, Any], outputs: List[str]) -> None:
    from .filming import film
    from .opening import open_trained

    trained = open_trained(arguments.source, arguments.blend_mode, arguments.background_gate, arguments.device,
                           **overrides)
    print(film(trained, arguments.output, arguments.frames, arguments.fps, outputs, arguments.overwrite))


def _overrides(arguments: argparse.Namespace) -> Dict[str, Any]:
    """The options of a run that a command was given in their place."""
    names = ("scene", "resolution", "principal_point", "white_background")
    return {name: getattr(arguments, name) for name in names if getattr(arguments, name, None) is not None}


def _export(arguments: argparse.Namespace) -> None:
    from .export.command import export

    if arguments.bake:
        _choose_device(arguments)
    path, warning = export(arguments.source, arguments.output, arguments.format, arguments.sh_degree,
                           arguments.blend_mode, arguments.background_gate, overwrite=arguments.overwrite,
                           bake=arguments.bake, bake_iterations=arguments.bake_iterations,
                           device=arguments.device if arguments.bake else "cpu", **_overrides(arguments))
    print(f"{path}: {os.path.getsize(path):,} bytes")
    if warning:
        print(warning)


def _view(arguments: argparse.Namespace) -> None:
    from .view.following import Followed
    from .view.server import Viewer

    _choose_device(arguments)
    viewer = Viewer(Followed(arguments.source, arguments.blend_mode, arguments.background_gate, arguments.device,
                             **_overrides(arguments)), arguments.host, arguments.port)
    print(f"{viewer.address}: open it in a browser; Ctrl-C ends", flush=True)
    viewer.wait()


def _info(arguments: argparse.Namespace) -> None:
    if arguments.cmake:
        from diff_smoe_rasterization.extension import cmake_prefix_path

        print(cmake_prefix_path())
        return
    from .system.environment import describe

    print(describe())
