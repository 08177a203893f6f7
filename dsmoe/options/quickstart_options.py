"""What may be typed behind `./quickstart`; it needs no package, so that a mistake is told before any is installed."""
from __future__ import annotations

import argparse
import sys
from typing import Any, Dict, List, Optional

from ..errors import SceneError, TrainerError, print_any_name
from ..system.files import is_file, is_folder
from .config import TrainConfig
from .config_arguments import add_arguments
from .presets import NUMBERS, STRATEGY

MODES = ("alpha", "smoe")
DEFAULT_FOLDER = "quickstart_output"  # has a folder for each scene
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
                        help="folder to write: new, empty, or of the same scene (default: "
                             f"{DEFAULT_FOLDER}/NAME, with the scene's name)")
    parser.add_argument("--quiet", action="store_true", default=False, help="no progress bars")
    add_arguments(parser, skip=FIXED, defaults=False)
    return parser.parse_args(argv)


def given_options(arguments: argparse.Namespace) -> Dict[str, Any]:
    """The options of the training that are given."""
    return {name: value for name, value in vars(arguments).items()
            if name not in ("scene", "output", "quiet") and (name, value) != ("budget", 0)}  # which is none


def unchecked_config(folder: str, options: Dict[str, Any]) -> TrainConfig:
    """The training by these options; milestones keep their share of the iterations."""
    return TrainConfig(**{"scene": folder, "blend_mode": MODES[0], "checkpoint_every": 0, **options}).shortened()


def config_of(folder: str, options: Dict[str, Any], given: Dict[str, Any]) -> TrainConfig:
    """The training by these options, of which some are given. Raises ConfigError."""
    return unchecked_config(folder, options).changed(**given)


def check(argv: Optional[List[str]] = None) -> int:
    """Says what is wrong with the arguments; returns the exit status."""
    print_any_name()
    arguments = parse(argv)
    options = {name: value for name, value in given_options(arguments).items() if name != "device"}
    if options.setdefault("strategy", STRATEGY) == STRATEGY:
        options.setdefault("budget", NUMBERS["cpu"].least)  # a scene's number is not known yet
    try:
        config_of(arguments.scene or "", options, options)
        if arguments.scene and not is_folder(arguments.scene):
            is_one = "is a file; a scene is a folder" if is_file(arguments.scene) else "no such folder"
            raise SceneError(f"scene {arguments.scene}: {is_one}")
    except TrainerError as error:
        print(f"quickstart: error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(check())
