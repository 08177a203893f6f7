"""One scene, both blends: trains with `alpha` and with `smoe`, and shows what differs.

python -m dsmoe.quickstart [SCENE] [--iterations N] [--resolution R] [-o OUT]
"""
from __future__ import annotations

import argparse
import os
import shlex
import shutil
import sys
from typing import Any, Dict, List, Optional

import torch

from .errors import in_one_line, print_any_name, report
from .inspection import open_renderer, to_image
from .options.config import IMAGES, TrainConfig, flags_text
from .options.presets import FAST, STRATEGY, chosen_for_scene, with_preset
from .options.quickstart_options import (
    MODES,
    PROGRAM,
    config_of,
    earlier_files,
    given_options,
    output_and_subject,
    parse,
    unchecked_config,
)
from .options.short_run import smaller_images
from .results.metrics import psnr, quantised
from .results.modelfile import model_path
from .results.pictures import comparison, evenly_spaced, file_names
from .results.rows import RESULTS_NAME, blend_name, results_table, viewer_warning, write_results
from .scenes.images import View, image_size
from .scenes.scene import Scene, load_scene, read_layout
from .scenes.synthetic import write_synthetic_scene
from .system.device import chosen_device, device_line
from .system.interrupt import exit_status
from .system.output_folder import Record, make_folder, only_one, remove_files, write_record
from .system.process import command, set_up_process
from .train import train

PICTURES = 3  # test views that are shown
# On a GPU the scene that it makes is larger too.
MADE_UP_ON_GPU = {"views": 64, "width": 480, "height": 360, "points": 30_000}


def main(argv: Optional[List[str]] = None) -> int:
    """Runs the comparison; returns the exit status."""
    print_any_name()
    arguments = parse(argv)
    try:
        run(arguments)
        return 0
    except Exception as error:
        return report("quickstart", error, in_one_line(error))
    except KeyboardInterrupt as stop:
        print("\nquickstart: interrupted", file=sys.stderr)
        return exit_status(stop)


def run(arguments: argparse.Namespace) -> List[Dict[str, Any]]:
    """Makes the scene if none is named, trains both modes, writes results and pictures; returns the rows."""
    given = given_options(arguments)
    progress = not arguments.quiet
    given["device"] = chosen_device(given.get("device"))
    print(device_line(given["device"]), flush=True)
    config = choose_options(arguments.scene, given) if arguments.scene else None
    output, subject = output_and_subject(arguments)
    earlier_files(output, subject, arguments.overwrite)
    make_folder(output)  # a folder that cannot be made is told before images are read
    with only_one(output):
        earlier = earlier_files(output, subject, arguments.overwrite)  # again: another run may have been at work there
        if config is None:
            folder = os.path.join(output, "scene")
            print(f"making a scene in {folder}: a room, ray-traced", flush=True)
            write_record(output, PROGRAM, Record(subject, earlier), earlier)  # the scene is its own
            write_synthetic_scene(folder, progress=progress,
                                  **({} if given["device"] == "cpu" else MADE_UP_ON_GPU))
            config = choose_options(folder, given)
        set_up_process(config.device)
        scene = load_scene(config, progress)
        if scene.note:
            print(scene.note, flush=True)
        views = shown_views(scene)
        files = [RESULTS_NAME, *(mode + ".ply" for mode in MODES), *views]
        write_record(output, PROGRAM, Record(subject, files), earlier)
        remove_files(output, files)
        rows = []
        for mode in MODES:
            rows.append(train(config.changed(blend_mode=mode, output=os.path.join(output, mode)), overwrite=True,
                              progress=progress, scene=scene))
            shutil.copyfile(model_path(os.path.join(output, mode), config.iterations),
                            os.path.join(output, mode + ".ply"))
        write_results(output, rows)
        pictures = write_pictures(config, views, output)
    print()
    print(results_table(rows))
    print(f"\n{len(scene.train)} training and {len(scene.test)} test views; "
          f"results and models: {output}; pictures: {', '.join(pictures)}")
    print(viewer_warning(rows[1]))
    print(f"for photographs of yours: {command()} scene PHOTOS -o SCENE, which ends with the command that trains")
    print(f"to look at it in a browser: {command()} export {shlex.quote(os.path.join(output, MODES[1]))} -o model.html")
    return rows


def choose_options(folder: str, given: Dict[str, Any]) -> TrainConfig:
    """The given options, and for the others the preset `--fast`, with as many Gaussians in both modes.

    On a CPU large images are reduced. Prints what it chose.
    """
    layout = read_layout(TrainConfig(scene=folder, images=given.get("images", IMAGES),
                                     strict=given.get("strict", False)))
    if layout.warning:
        print(layout.warning, flush=True)
    device = given.get("device", "cpu")
    options: Dict[str, Any] = {"iterations": FAST[device].iterations}
    if device == "cpu":
        options.update(smaller_images(*image_size(layout.train[0].path)))
    options.update(given)
    if given.get("strategy", STRATEGY) == STRATEGY:
        options = with_preset(options, "fast", device)
        options.update(chosen_for_scene(unchecked_config(folder, options), given, layout))
    config = config_of(folder, options, given)
    chosen = {name: value for name, value in options.items() if name not in given}
    if chosen:
        lasts = "some minutes" if device == "cpu" else "about a minute"
        print(f"chosen for a run of {lasts}: {flags_text(chosen)}", flush=True)
    return config


def shown_views(scene: Scene) -> Dict[str, View]:
    """Some test views, by the names of their pictures."""
    views = scene.test or scene.train
    names = file_names([view.camera.name for view in views])
    return {f"compare_{names[index]}.png": views[index] for index in evenly_spaced(len(views), PICTURES)}


def write_pictures(config: TrainConfig, views: Dict[str, View], output: str) -> List[str]:
    """Ground truth, alpha and smoe beside each other for each view; returns the paths."""
    renderers = [(mode, open_renderer(config, os.path.join(output, mode + ".ply"), mode, config.device))
                 for mode in MODES]
    paths = []
    for name, view in views.items():
        labelled = []
        truth, mask = view.image_float(), view.mask_float()
        for mode, renderer in renderers:
            with torch.no_grad():
                color = renderer(view.camera).color.cpu()
            blend = blend_name(mode, float(renderer.background_gate))
            labelled.append((f"{blend}  {psnr(quantised(color), truth, mask):.2f} dB  "
                             f"{renderer.model.num_gaussians:,} Gaussians", to_image(color)))
        paths.append(os.path.join(output, name))
        comparison(to_image(truth), labelled).save(paths[-1])
    return paths


if __name__ == "__main__":
    sys.exit(main())
