"""What may be typed behind `dsmoe`, and how a shell completes it."""
from __future__ import annotations

import argparse
import dataclasses
from typing import Any, Iterator, List, Tuple

from diff_smoe_rasterization._version import __version__
from diff_smoe_rasterization.settings import BLEND_MODES, PAPER_PROGRAM

from .bench.names import SCENES, SELECTORS, SHIPPED
from .bench.names import VARIABLES as LPIPS_VARIABLES
from .options import choices
from .options.config import PRINCIPAL_POINTS, TrainConfig
from .options.config_arguments import add_arguments, blend_mode, file_name, number, whole_number
from .options.presets import BEST, FAST
from .patches import TRAINERS

TRAIN_EXAMPLES = """examples:
  dsmoe train garden -o garden_model                              as many Gaussians as the scene needs
  dsmoe train garden -o small --blend-mode smoe --budget 30000    30,000 Gaussians
  dsmoe train garden -o fast --fast                               in seconds on a GPU
  dsmoe train garden -o quick --fast --resolution 4               in minutes on a processor
  dsmoe train garden -o dense --strategy 3dgs                     the densification of 3DGS"""


# Options of a training that `dsmoe simplify` offers as they are.
SIMPLIFY_OPTIONS = ("images", "strict", "resolution", "test_every", "principal_point", "lenses", "white_background",
                    "blend_mode", "background_gate", "faint_below", "strategy_options", "device", "seed",
                    "deterministic", "eval_every", "checkpoint_every")


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(prog="dsmoe", description="Gaussian splatting with alpha and SMoE blending.")
    parser.add_argument("--version", action="version", version=f"dsmoe {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")

    train = commands.add_parser("train", help="train Gaussians on a scene",
                                usage="%(prog)s SCENE -o OUT [OPTION ...]\n"
                                      "       %(prog)s --resume -o OUT [OPTION ...]",
                                description="Trains Gaussians on a scene: photographs whose cameras are known.",
                                formatter_class=argparse.RawDescriptionHelpFormatter, epilog=TRAIN_EXAMPLES)
    train.add_argument("scene", type=file_name, metavar="SCENE", nargs="?", default=argparse.SUPPRESS,
                       help="folder of a COLMAP scene, of a transforms.json (nerfstudio, instant-ngp, Polycam) or of a "
                            "NeRF-synthetic scene; --resume finds it in OUT")
    train.add_argument("-o", "--output", type=file_name, metavar="OUT", default=argparse.SUPPRESS,
                       help="folder to write")
    groups = add_arguments(train, skip=("scene", "output"))
    _add_paper(groups["blending"])
    groups["length, and number of Gaussians"].add_argument(
        "--scale-recipe", action="store_true",
        help="squeeze the schedule into --iterations: milestones (densification, resets, learning rate, SH degrees) "
             "keep their share of 30,000 steps, unless they are given; importance does so by itself")
    presets = groups["length, and number of Gaussians"].add_mutually_exclusive_group()
    presets.add_argument(
        "--fast", action="store_true",
        help=f"a result in seconds on a GPU, by {FAST['cuda'].iterations} iterations with early milestones, or in "
             f"minutes on a CPU, by {FAST['cpu'].iterations}. Options that are given win")
    presets.add_argument(
        "--best", action="store_true",
        help=f"{BEST.iterations} iterations, and decisions that look at more views: better where the training views "
             "gain too")
    earlier_run = groups["run"].add_mutually_exclusive_group()
    earlier_run.add_argument("--resume", action="store_true",
                             help="continue the run in OUT from its last checkpoint with its own options; more "
                                  "--iterations extend it")
    earlier_run.add_argument("--overwrite", action="store_true",
                             help="replace the run in OUT, once this one can start; other files there stay")
    groups["run"].add_argument(
        "--gpus", metavar="N",
        help="train on so many GPUs of this machine: torchrun starts this command once for each; with --batch N or "
             "more. auto: on all of them, but on no more than --batch keeps busy")
    groups["run"].add_argument("--quiet", action="store_true", help="no progress bars")

    simplify = commands.add_parser(
        "simplify", help="make a trained model smaller, in seconds on a GPU",
        usage="%(prog)s MODEL [--scene SCENE] (--budget N | --keep X | --loses X) -o OUT [OPTION ...]",
        description="Trains a model of 3DGS on to fewer Gaussians: those go that change its images least. Options of "
                    "the scene that are not given are those that the model's folder records.")
    _add_simplify_arguments(simplify)

    scene = commands.add_parser("scene", help="make a scene of photographs",
                                description="Finds where photographs were taken, by COLMAP, and writes a scene for "
                                            "`dsmoe train`: images, cameras and points. It "
                                            "needs pycolmap. Started again it goes on with what it has found.")
    scene.add_argument("photos", type=file_name, metavar="PHOTOS",
                       help="folder of photographs; subfolders are read too")
    scene.add_argument("-o", "--output", type=file_name, metavar="SCENE", required=True,
                       help="folder to write: new, empty, or of the same photographs")
    scene.add_argument("--matching", choices=choices.MATCHING, default=choices.MATCHING[0],
                       help="which photographs are compared. exhaustive: all pairs; sequential: neighbours by name, as "
                            f"of a video; auto: all pairs of up to {choices.MOST_EXHAUSTIVE} (default: %(default)s)")
    scene.add_argument("--camera-model", choices=choices.CAMERA_MODELS, default=choices.CAMERA_MODEL,
                       help="of the lens, by COLMAP's names (default: %(default)s)")
    scene.add_argument("--fov", type=number, metavar="DEGREES",
                       help="about how much a photograph shows along its longer side, whatever it records: COLMAP "
                            "starts from it (default: what they record; else 150 of a fisheye, 48 of others)")
    scene.add_argument("--lenses", choices=choices.LENSES, default=choices.LENSES[0],
                       help="undistort: images of a pinhole camera; native: the photographs as they are, with the lens "
                            "that was found; auto: native where undistortion would cut off more than a tenth of a "
                            "photograph (default: %(default)s)")
    scene.add_argument("--quiet", action="store_true", help="no progress bars")

    evaluate = commands.add_parser("eval", help="measure a trained run again",
                                   description="Measures PSNR, SSIM and FPS of a finished run.")
    evaluate.add_argument("output", type=file_name, metavar="OUT", help="output folder of `dsmoe train`")
    evaluate.add_argument("--split", choices=("test", "train"), default="test", help="which views (default: test)")
    evaluate.add_argument("--scene", type=file_name, help="where the scene lies now, if it has moved")
    evaluate.add_argument("--lpips", choices=tuple(LPIPS_VARIABLES),
                          help="also LPIPS with this network; weights: $DSMOE_LPIPS_VGG or $DSMOE_LPIPS_ALEX, else "
                               "torchmetrics downloads them")
    _add_device(evaluate)

    render = commands.add_parser("render", help="write images or a video of a trained model",
                                 description="Writes one PNG for every camera of a scene, or a video around it.")
    render.add_argument("model", type=file_name, metavar="MODEL", help=choices.MODEL)
    render.add_argument("-o", "--output", type=file_name, metavar="DIR|VIDEO", required=True,
                        help="folder for the images: new, empty, or of an earlier rendering; with --orbit also a file "
                             "that ends in .mp4 (needs imageio-ffmpeg), .gif or .webp")
    render.add_argument("--orbit", action="store_true", help="once around what the scene's cameras look at")
    render.add_argument("--frames", type=whole_number, default=argparse.SUPPRESS, metavar="N",
                        help=f"of an orbit (default: {choices.ORBIT_FRAMES})")
    render.add_argument("--fps", type=number, default=argparse.SUPPRESS, metavar="X",
                        help=f"of a video (default: {choices.VIDEO_FPS:g})")
    render.add_argument("--split", choices=("test", "train", "all"),
                        help="which cameras (default: test, or train if there are none)")
    _add_model_options(render, "whose cameras are rendered (default: as the model's folder says)")
    render.add_argument("--resolution", type=whole_number, metavar="N",
                        help="as in train (default: the run's, else -1)")
    render.add_argument("--principal-point", choices=PRINCIPAL_POINTS,
                        help="as in train (default: the run's, else scene)")
    render.add_argument("--depth", action="store_true",
                        help="also NAME.depth.npy: view depth in the scene's units [H, W] float32, 0: nothing is hit")
    render.add_argument("--alpha", action="store_true",
                        help="also NAME.alpha.png: how much of a pixel Gaussians cover, 8 bits")
    render.add_argument("--overwrite", action="store_true",
                        help="write into any folder, and replace files of the same names; a VIDEO that is there too")
    _add_device(render)

    export = commands.add_parser("export", help="write a trained model for other programs, or as a page to look at",
                                 description="Writes a trained model as one file. A page (.html) shows it in a "
                                             "browser by the blend that it was trained with; other viewers show the "
                                             "other formats by alpha.")
    export.add_argument("model", type=file_name, metavar="MODEL", help=choices.MODEL)
    export.add_argument("-o", "--output", type=file_name, metavar="FILE",
                        help="file to write (default: model.FORMAT)")
    export.add_argument("--format", choices=choices.EXPORT_FORMATS,
                        help=f"default: by the ending of FILE, else {choices.EXPORT_FORMATS[0]}; spz needs gsply")
    export.add_argument("--sh-degree", type=whole_number, choices=range(4), metavar="N",
                        help="keep view-dependent colour up to this degree: smaller files (default: all; .splat "
                             "holds degree 0)")
    export.add_argument("--bake", choices=("alpha",),
                        help="first fine-tune the model to this blend, which every viewer shows; needs the scene's "
                             "images, and prints the dB that it costs")
    export.add_argument("--bake-iterations", type=whole_number, default=argparse.SUPPRESS, metavar="N",
                        help=f"(default: {choices.BAKE_ITERATIONS})")
    _add_model_options(export, "whose test views the page begins with, and on which --bake trains (default: the run's)")
    export.add_argument("--overwrite", action="store_true", help="replace a FILE that is there")
    _add_device(export, "--bake trains")

    view = commands.add_parser("view", help="look at a trained model or a running training in the browser",
                               description="Serves a live viewer of a run's model, of the checkpoints of a training "
                                           "that goes on, or of a file. It needs viser.")
    view.add_argument("model", type=file_name, metavar="MODEL", help=choices.MODEL)
    _add_model_options(view, "at whose first test view it begins (default: the run's)")
    view.add_argument("--host", default=choices.VIEW_HOST,
                      help="address to serve at; 0.0.0.0: to the network too (default: %(default)s, this machine only)")
    view.add_argument("--port", type=whole_number, default=choices.VIEW_PORT,
                      help="or the next free one (default: %(default)s)")
    _add_device(view)

    patch = commands.add_parser("patch", help="make a public trainer's checkout train with this rasterizer",
                                description="Patches a checkout of a public trainer, which then knows the options "
                                            f"--blend_mode and --background_gate: {', '.join(TRAINERS)}.")
    _add_patch_arguments(patch)

    run = commands.add_parser("run", help="run an unmodified public trainer with this rasterizer",
                              usage="dsmoe run (--paper | --blend-mode MODE) [OPTION ...] -- COMMAND ...",
                              description="Runs a command of an unmodified trainer with this rasterizer. Nothing is "
                                          "written into the checkout; what the command starts has the rasterizer too.")
    run.add_argument("--blend-mode", "--blend_mode", type=blend_mode, choices=BLEND_MODES,
                     help="nothing records it: give the same where a trained model is rendered")
    _add_paper(run)
    run.add_argument("--faint-below", "--faint_below", type=number, metavar="X", help="as in train")
    run.add_argument("--background-gate", "--background_gate", metavar="V",
                     help="how much the background weighs: a number, 0 in the paper, or `learned` (default: "
                          "$DSMOE_BACKGROUND_GATE, else learned in smoe, 0 in smoe_eq7); models record it. smoe with "
                          "0 is the program of the paper's authors, not Eq. 7 of its text, which is smoe_eq7 with 0")
    run.add_argument("--trainer", metavar="NAME",
                     help="a trainer (3dgs-2023, ...) or, for other trainers, the rasterizer whose API they call "
                          "(inria, inria_2024, scaffold, ...); list: print them all; default: found out "
                          "from the script's folder")
    run.add_argument("words", metavar="COMMAND", nargs=argparse.REMAINDER, help="such as: python train.py -s DATA")

    bench = commands.add_parser("bench", help="compare blend modes and trainers over a suite of scenes",
                                description="Runs suites of training runs, measured alike, and reports on them.")
    _add_bench_arguments(bench)

    info = commands.add_parser("info", help="versions, backends, SIMD level, threads, GPU")
    info.add_argument("--cmake", action="store_true",
                      help="print only what CMAKE_PREFIX_PATH needs for find_package(diff_smoe_rasterization) in C++")

    completion = commands.add_parser("completion", help="a script by which a shell completes commands and options",
                                     description="Prints a script for the shell. In ~/.bashrc or, behind compinit, in "
                                                 "~/.zshrc: eval \"$(dsmoe completion bash)\", respectively zsh.")
    completion.add_argument("shell", choices=("bash", "zsh"))
    for command in (train, simplify, scene, evaluate, render, export, view, patch, run, bench, info, completion):
        command.set_defaults(command_parser=command)
    return parser


def _add_simplify_arguments(simplify: argparse.ArgumentParser) -> None:
    simplify.add_argument("model", type=file_name, metavar="MODEL", help=choices.MODEL)
    simplify.add_argument("-o", "--output", type=file_name, metavar="OUT", required=True,
                          help="folder to write, as of `dsmoe train`")
    simplify.add_argument("--scene", type=file_name,
                          help="folder of the photographs (default: as the model's folder says; if it is not there, "
                               "the images are the model's renderings at its cameras.json)")
    stay = simplify.add_argument_group("number of Gaussians (one of these)").add_mutually_exclusive_group(
        required=True)
    stay.add_argument("--budget", type=whole_number, metavar="N", help="so many stay")
    stay.add_argument("--keep", type=number, metavar="X", help="this part of them stays: 0.1, a tenth")
    stay.add_argument("--loses", type=number, metavar="X",
                        help="the fewest of a few numbers that lose at most X dB of PSNR on the training images")
    groups = add_arguments(simplify, skip=[option.name for option in dataclasses.fields(TrainConfig)
                                           if option.name not in SIMPLIFY_OPTIONS], defaults=False)
    _add_paper(groups["blending"])
    groups["length, and number of Gaussians"].add_argument(
        "--iterations", type=whole_number, metavar="N", default=argparse.SUPPRESS,
        help=f"steps of training (default: {choices.SIMPLIFY_ITERATIONS})")
    earlier_run = groups["run"].add_mutually_exclusive_group()
    earlier_run.add_argument("--resume", action="store_true", help="continue what was interrupted, with the same "
                                                                   "options")
    earlier_run.add_argument("--overwrite", action="store_true", help="replace the run in OUT")
    groups["run"].add_argument("--quiet", action="store_true", help="no progress bars")


def _add_paper(parser: Any) -> None:
    parser.add_argument("--paper", action="store_true",
                        help="blend as the program of the paper's authors: " + " ".join(
                            f"--{name.replace('_', '-')} {value}" for name, value in PAPER_PROGRAM.items()))


def _add_device(parser: argparse.ArgumentParser, does: str = "to render") -> None:
    parser.add_argument("--device", choices=choices.DEVICES, default="auto",
                        help=f"where {does}; auto: $DSMOE_DEVICE, else the GPU if it can be used (default: auto)")


def _add_model_options(parser: argparse.ArgumentParser, scene: str) -> None:
    """What says how a trained model is opened; scene: what its folder is for."""
    parser.add_argument("--scene", type=file_name, help="folder " + scene)
    parser.add_argument("--blend-mode", type=blend_mode, choices=BLEND_MODES,
                        help="of a file that does not record it (default: alpha); must agree where it does")
    parser.add_argument("--background-gate", type=number, metavar="X",
                        help="likewise, in smoe; a file that records smoe and no gate was trained with 0")
    parser.add_argument("--faint-below", type=number, metavar="X", help="likewise (default: 0.25 in smoe)")
    _add_paper(parser)
    parser.add_argument("--white-background", action="store_true", default=None,
                        help="white background (default: the run's, else black)")


def _add_patch_arguments(patch: argparse.ArgumentParser) -> None:
    actions = patch.add_subparsers(dest="action", metavar="ACTION")
    for name, text in (("apply", "patch the checkout; each line of the patch says so"),
                       ("check", "say whether it is patchable, and what is patched of it"),
                       ("diff", "show what the patch changes, and write nothing"),
                       ("revert", "take the patch out of every file, byte for byte")):
        action = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        action.add_argument("path", type=file_name, metavar="PATH", help="the checkout's folder")
        if name != "revert":
            action.add_argument("--modernise", action="store_true",
                                help="also what the trainer needs to start on today's torch, CUDA and Python")
            action.add_argument("--fuse", action="store_true",
                                help="also SSIM and Adam by this package's kernels: the same results, sooner")
            action.add_argument("--trainer", metavar="NAME", help="which trainer it is (default: found out)")
        action.set_defaults(command_parser=action)


def _add_bench_arguments(bench: argparse.ArgumentParser) -> None:
    actions = bench.add_subparsers(dest="action", metavar="ACTION")
    run = actions.add_parser("run", help="run what is not done yet of a suite",
                             description="Runs a suite with Snakemake; started again, it continues. A cell that fails "
                                         "becomes a row with its reason, and the command returns 1.",
                             usage="%(prog)s SUITE [-o RESULTS] [OPTION ...]")  # --slurm would take a SUITE behind it
    run.add_argument("suite", type=file_name, metavar="SUITE",
                     help=f"a .yaml file, or a shipped one: {', '.join(sorted(SHIPPED))}")
    run.add_argument("-o", "--output", type=file_name, metavar="RESULTS",
                     help="folder to write (default: bench_results/NAME)")
    run.add_argument("--device", choices=choices.DEVICES,
                     help="where to train, in place of the suite's protocol.device; auto: the GPU if it can be used")
    run.add_argument("--iterations", type=whole_number, metavar="N",
                     help="a trial: so many iterations, with the schedule squeezed into them; not for checkouts")
    run.add_argument("--scenes", type=file_name, metavar="SCENES",
                     help=f"in place of the suite's: a .yaml file, or a shipped one: {', '.join(sorted(SCENES))}")
    run.add_argument("--jobs", type=whole_number, metavar="N",
                     help="cells at once (default: --per-gpu on each GPU; on the CPU one, beyond which their times and "
                          "FPS stay out of the report)")
    run.add_argument("--per-gpu", type=whole_number, default=1, metavar="K",
                     help="cells that share a GPU (default: 1); beyond 1 their times and FPS stay out of the report")
    run.add_argument("--slurm", nargs="*", metavar="KEY=VALUE",
                     help="submit cells to Slurm; resources of each, such as slurm_partition=gpu runtime=120 "
                          "mem_mb=32000 cpus_per_task=8")
    run.add_argument("--only", action="append", default=[], metavar="FIELD=VALUE",
                     help=f"only such cells; fields: {', '.join(SELECTORS)}")
    run.add_argument("--rows", type=file_name, metavar="FILE|RESULTS",
                     help="a file of rows (.jsonl), or a folder of results, whose cells are not run again")
    run.add_argument("--retry-failed", action="store_true", help="run failed cells again")
    run.add_argument("--dry-run", action="store_true", help="say which cells are done and which are not")
    report = actions.add_parser("report", help="tables, curves and a page of results",
                                description="Writes tables, curves and a page that works offline.")
    report.add_argument("results", type=file_name, metavar="RESULTS",
                        help="folder of `dsmoe bench run`, or a file rows.jsonl")
    report.add_argument("-o", "--output", type=file_name, metavar="DIR", default="report",
                        help="folder to write (default: report)")


def completion_script(shell: str) -> str:
    """What the shell, bash or zsh, is to run so that it completes commands and options."""
    cases = "\n".join(f"    {path}) words='{' '.join(words)}' ;;" for path, words in _words_of(build_parser()))
    return ("autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else "") + f"""_dsmoe() {{
  local words
  case "${{COMP_WORDS[*]:1:COMP_CWORD-1}} " in
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o bashdefault -o default -F _dsmoe dsmoe"""


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
