"""What may be typed behind `./quickstart`; it needs no package, so that a mistake is told before any is installed."""
from __future__ import annotations

import argparse
import glob
import itertools
import os
import shutil
import sys
from typing import Any, Dict, List, Optional, Tuple

from ..errors import TrainerError, print_any_name, report
from ..system.files import check_place
from ..system.output_folder import own_record, read_record
from .choices import asked_device
from .config import TrainConfig
from .config_arguments import add_arguments
from .early import check_scene
from .presets import NUMBERS, STRATEGY

MODES = ("alpha", "smoe")
DEFAULT_FOLDER = "quickstart_output"  # has a folder for each scene
PROGRAM = "quickstart"  # in its folder's record
MODELS = "point_cloud"  # the folder of a run's models
MADE_UP = "the one that it makes itself"
MADE_UP_NAME = "room"
GPU_FILES = ("/dev/nvidia*", "/dev/nvhost*", "/dev/dxg")  # one is there with a GPU: on Linux, on a Jetson, in WSL
OWN = ("scene", "output", "overwrite", "quiet")  # arguments that are no options of the training
# Offered by `dsmoe train` and fixed here.
FIXED = ("scene", "output", "blend_mode", "background_gate", "background_gate_bound", "background_gate_start",
         "background_gate_lr", "init", "eval_every", "checkpoint_every")


def parse(argv: Optional[List[str]] = None) -> argparse.Namespace:
    """The arguments, of which options that are not given are absent."""
    parser = argparse.ArgumentParser(
        prog="quickstart", argument_default=argparse.SUPPRESS,
        description="Trains a scene twice, with alpha blending and with SMoE gating, and compares the results. "
                    "Options that are not given are chosen so that a processor finishes in minutes; on a GPU it "
                    "trains at full size for about a minute.")
    parser.add_argument("scene", nargs="?", metavar="SCENE", default=None,
                        help="folder of a scene: COLMAP, transforms.json or NeRF-synthetic (default: one made on the "
                             "spot)")
    parser.add_argument("-o", "--output", metavar="OUT", default=None,
                        help="folder to write: new or empty, or with --overwrite of the same scene (default: "
                             f"{DEFAULT_FOLDER}/NAME, with the scene's name, or NAME_2 and so on if it has results)")
    parser.add_argument("--overwrite", action="store_true", default=False,
                        help="replace an earlier comparison of the scene")
    parser.add_argument("--quiet", action="store_true", default=False, help="no progress bars")
    add_arguments(parser, skip=FIXED, defaults=False)
    return parser.parse_args(argv)


def given_options(arguments: argparse.Namespace) -> Dict[str, Any]:
    """The options of the training that are given."""
    return {name: value for name, value in vars(arguments).items() if name not in OWN
            and (name, value) != ("budget", 0)}  # which is none


def unchecked_config(folder: str, options: Dict[str, Any]) -> TrainConfig:
    """The training by these options; milestones keep their share of the iterations."""
    return TrainConfig(**{"scene": folder, "blend_mode": MODES[0], "checkpoint_every": 0, **options}).shortened()


def config_of(folder: str, options: Dict[str, Any], given: Dict[str, Any]) -> TrainConfig:
    """The training by these options, of which some are given. Raises ConfigError."""
    return unchecked_config(folder, options).changed(**given)


def output_and_subject(arguments: argparse.Namespace) -> Tuple[str, str]:
    """The folder to write, and what its record says it is of."""
    subject = os.path.abspath(arguments.scene) if arguments.scene else MADE_UP
    return arguments.output or _default_output(subject, arguments.overwrite), subject


def _default_output(subject: str, overwrite: bool) -> str:
    """The folder for a scene if none is named: its name, with a number if that is another scene's, or has results."""
    name = MADE_UP_NAME if subject == MADE_UP else os.path.basename(subject)
    for number in itertools.count(1):
        folder = os.path.join(DEFAULT_FOLDER, name if number == 1 else f"{name}_{number}")
        record = read_record(folder, PROGRAM)
        if record is None or record.subject in ("", subject) and (overwrite or not _there(folder, record.files)):
            break
    return folder


def earlier_files(output: str, subject: str, overwrite: bool) -> List[str]:
    """What an earlier comparison on the same scene has written.

    Raises TrainerError if `output` holds another's, or some of these files or a model that nobody lets be replaced. A
    comparison that was interrupted before its first model has none.
    """
    record = own_record(output, PROGRAM, folders=("scene", *MODES))
    if record.subject not in ("", subject):
        raise TrainerError(f"{output} holds the models and pictures of another scene, {record.subject}; choose another "
                           "folder with -o, or remove it")
    there = _there(output, record.files)
    if there and not overwrite:
        raise TrainerError(f"{output} holds an earlier comparison ({', '.join(there)}); replace it with --overwrite, "
                           "or choose another folder with -o")
    return record.files


def _there(folder: str, names: List[str]) -> List[str]:
    """Which of these files, and models, are there: a model that is still being measured has no copy among the files."""
    return [name for name in (*names, *(f"{mode}/{MODELS}" for mode in MODES))
            if os.path.lexists(os.path.join(folder, name))]


def check_gpu(device: Optional[str]) -> None:
    """Raises TrainerError if a GPU is asked for, and nothing of the system speaks of one: there is no torch yet."""
    asked, source = asked_device(device)
    if asked == "cuda" and not shutil.which("nvidia-smi") and not any(map(glob.glob, GPU_FILES)):
        raise TrainerError(f"{source} is cuda, and this machine has no NVIDIA GPU (neither {GPU_FILES[0]} nor "
                           "nvidia-smi is there); use --device cpu")


def check(argv: Optional[List[str]] = None) -> int:
    """Says what is wrong with the arguments; returns the exit status."""
    print_any_name()
    arguments = parse(argv)
    options = given_options(arguments)
    device = options.pop("device", None)
    if options.setdefault("strategy", STRATEGY) == STRATEGY:
        options.setdefault("budget", NUMBERS["cpu"].least)  # a scene's number is not known yet
    try:
        config_of(arguments.scene or "", options, options)
        if arguments.scene:
            check_scene(arguments.scene, program="dsmoe")
        check_gpu(device)
        output, subject = output_and_subject(arguments)
        earlier_files(output, subject, arguments.overwrite)
        check_place(output, is_one_file=False)
    except TrainerError as error:
        return report("quickstart", error, str(error))
    return 0


if __name__ == "__main__":
    sys.exit(check())
