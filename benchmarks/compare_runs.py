"""One test view of several trained models beside its photograph, and under them where the first and last differ most.

    python benchmarks/compare_runs.py OUT_ALPHA OUT_SMOE -o picture.jpg [--view NAME] [--scene SCENE] [--width 1200]

The OUTs are runs of `dsmoe train` on one scene. Labels have the blend, the PSNR of this view and the number of
Gaussians. It renders on the CPU.
"""
from __future__ import annotations

import argparse
import os
import sys
from typing import Optional, Sequence

import torch
from PIL import Image

from dsmoe.errors import TrainerError, in_one_line, report
from dsmoe.inspection import open_run, to_image
from dsmoe.options.config import TrainConfig
from dsmoe.results.metrics import psnr, quantised
from dsmoe.results.pictures import comparison
from dsmoe.scenes.scene import load_scene
from dsmoe.system.files import check_place

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("runs", nargs="+", metavar="OUT")
parser.add_argument("-o", "--output", required=True, metavar="PICTURE")
parser.add_argument("--view", metavar="NAME", help="file name of the test photograph (default: the first)")
parser.add_argument("--scene", help="folder of the scene (default: the first run's)")
parser.add_argument("--width", type=int, default=1200, help="of the picture, pixels (default: 1200)")


def main(argv: Optional[Sequence[str]] = None) -> int:
    try:
        compare(parser.parse_args(argv))
    except Exception as error:
        return report(parser.prog, error, in_one_line(error))
    return 0


def compare(arguments: argparse.Namespace) -> None:
    check_picture(arguments.output)
    if arguments.width < 1:
        raise TrainerError(f"--width is {arguments.width}; it must be at least 1")
    options = {"scene": arguments.scene} if arguments.scene else {}
    configs = [TrainConfig.of_run(run, "--scene", device="cpu", **options) for run in arguments.runs]
    views = load_scene(configs[0], progress=False).test
    if not views:
        raise TrainerError(f"{arguments.runs[0]}: no test view; --test-every keeps some")
    names = [view.camera.name for view in views]
    name = arguments.view or names[0]
    if name not in names:
        raise TrainerError(f"--view {name}: the test views are {', '.join(names)}")
    view = views[names.index(name)]
    truth = view.image_float()
    labelled = []
    for config in configs:
        renderer = open_run(config, None, None, "cpu").renderer
        with torch.no_grad():
            color = renderer(view.camera).color
        labelled.append((f"{renderer.blend_mode}, {renderer.model.num_gaussians:,} Gaussians, "
                         f"{psnr(quantised(color), truth, view.mask_float()):.2f} dB", to_image(color)))
    sheet = comparison(to_image(truth), labelled)
    os.makedirs(os.path.dirname(arguments.output) or ".", exist_ok=True)
    height = round(sheet.height * arguments.width / sheet.width)
    sheet.resize((arguments.width, height), Image.LANCZOS).save(arguments.output, quality=85)


def check_picture(path: str) -> None:
    """Raises TrainerError if no picture can be written there, by its ending or its folder."""
    ending = os.path.splitext(path)[1].lower()
    if Image.registered_extensions().get(ending) not in Image.SAVE:
        raise TrainerError(f"-o {path}: no picture ends in {ending or 'nothing'}; name a .png or .jpg")
    check_place(path, is_one_file=True)


if __name__ == "__main__":
    sys.exit(main())
