"""One scene, both blends: trains with `alpha` and with `smoe`, and shows what differs.

python -m diff_smoe_rasterization.trainer.quickstart [SCENE] [--iterations N] [--resolution R] [-o OUT]
"""
from __future__ import annotations

import argparse
import math
import os
import shutil
import sys
from typing import Any, Dict, List, Optional

import torch

from .config import TrainConfig, add_arguments
from .errors import in_one_line
from .images import image_size
from .inspection import open_renderer, to_image
from .loop import train
from .metrics import psnr, quantised
from .modelfile import model_path
from .pictures import comparison, evenly_spaced, file_names
from .process import set_up_process
from .results import results_table, write_results
from .scene import Scene, load_scene, read_layout
from .synthetic import write_synthetic_scene

MODES = ("alpha", "smoe")
PICTURES = 3  # test views that are shown
DEFAULT_OUTPUT = "quickstart_output"

# A few thousand steps are too few to recover from an opacity reset, so neither kind of scene gets one. The threshold
# is higher than that of full-size images: in NDC units, small images have larger gradients.
SHORT_RUN = {"iterations": 2000, "schedule": "steady", "densify_grad_threshold": 0.001}
# Larger scenes are reduced to what two processor cores train in minutes.
MAX_PIXELS = 70_000  # of an image
MAX_POINTS = 30_000

# Offered by `dsmoe train` and fixed here.
FIXED = ("scene", "output", "blend_mode", "background_gate", "background_gate_bound", "eval_every", "checkpoint_every")


def main(argv: Optional[List[str]] = None) -> int:
    """Runs the comparison; returns the exit status."""
    arguments = _parse(argv)
    try:
        run(arguments)
        return 0
    except Exception as error:
        text = in_one_line(error)
        if text is None:
            raise
        print(f"quickstart: error: {text}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nquickstart: interrupted", file=sys.stderr)
        return 130


def _parse(argv: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="quickstart", argument_default=argparse.SUPPRESS,
        description="Trains a scene twice, with alpha blending and with SMoE gating, and compares the results. "
                    "Options that are not given are chosen so that a processor finishes in minutes.")
    parser.add_argument("scene", nargs="?", metavar="SCENE", default=None,
                        help="folder of a COLMAP or NeRF-synthetic scene (default: a small one made on the spot)")
    parser.add_argument("-o", "--output", metavar="OUT", default=DEFAULT_OUTPUT,
                        help=f"folder to write (default: {DEFAULT_OUTPUT})")
    parser.add_argument("--quiet", action="store_true", default=False, help="no progress bars")
    add_arguments(parser, skip=FIXED, defaults=False)
    return parser.parse_args(argv)


def run(arguments: argparse.Namespace) -> List[Dict[str, Any]]:
    """Makes the scene where none is named, trains both modes, writes results and pictures; returns the rows."""
    given = {name: value for name, value in vars(arguments).items() if name not in ("scene", "output", "quiet")}
    output, progress = arguments.output, not arguments.quiet
    folder = arguments.scene
    if folder is None:
        folder = os.path.join(output, "scene")
        print(f"making a scene in {folder}")
        write_synthetic_scene(folder)
    config = choose_options(folder, given)
    set_up_process(config.device)
    os.makedirs(output, exist_ok=True)  # a folder that cannot be made is told before images are read
    scene = load_scene(config, progress)
    rows = []
    for mode in MODES:
        rows.append(train(config.changed(blend_mode=mode, output=os.path.join(output, mode)), overwrite=True,
                          progress=progress, scene=scene))
        shutil.copyfile(model_path(os.path.join(output, mode), config.iterations), os.path.join(output, mode + ".ply"))
    write_results(output, rows)
    pictures = write_pictures(config, scene, output)
    print()
    print(results_table(rows))
    print(f"\n{len(scene.train)} training and {len(scene.test)} test views; "
          f"results and models: {output}; pictures: {', '.join(pictures)}")
    return rows


def choose_options(folder: str, given: Dict[str, Any]) -> TrainConfig:
    """The given options, and for the others what a processor finishes in minutes; prints what it chose.

    The recipe's milestones keep their share of the iterations (`TrainConfig.shortened`).
    """
    chosen: Dict[str, Any] = dict(SHORT_RUN)
    layout = read_layout(TrainConfig(scene=folder))
    width, height = image_size(layout.train[0].path)
    if width * height > MAX_PIXELS:
        chosen["resolution"] = int(math.sqrt(MAX_PIXELS * width / height))
    if len(layout.points.positions) > MAX_POINTS:
        chosen["init_points"] = MAX_POINTS
    chosen = {name: value for name, value in chosen.items() if name not in given}
    if chosen:
        texts = (f"--{name.replace('_', '-')} {value}" for name, value in chosen.items())
        print(f"chosen for a run of some minutes: {' '.join(texts)}")
    base = TrainConfig(scene=folder, blend_mode=MODES[0], checkpoint_every=0)
    return base.changed(**{**chosen, **given}).shortened().changed(**given)


def write_pictures(config: TrainConfig, scene: Scene, output: str) -> List[str]:
    """Ground truth, alpha and smoe beside each other for some test views; returns the paths."""
    renderers = [(mode, open_renderer(config, os.path.join(output, mode + ".ply"), mode, config.device))
                 for mode in MODES]
    views = scene.test or scene.train
    names = file_names([view.camera.name for view in views])
    paths = []
    for index in evenly_spaced(len(views), PICTURES):
        view, labelled = views[index], []
        truth, mask = view.image_float(), view.mask_float()
        for mode, renderer in renderers:
            with torch.no_grad():
                color = renderer(view.camera).color.cpu()
            labelled.append((f"{mode}  {psnr(quantised(color), truth, mask):.2f} dB", to_image(color)))
        paths.append(os.path.join(output, f"compare_{names[index]}.png"))
        comparison(to_image(truth), labelled).save(paths[-1])
    return paths


if __name__ == "__main__":
    sys.exit(main())
