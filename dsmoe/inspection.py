"""What is done with a trained model: open it with its cameras, measure it again, write its images."""
from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np
import torch
from PIL import Image

from .errors import TrainerError, printable
from .model import GaussianModel
from .options.config import CHECKPOINT_NAME, LEARNED, TrainConfig, holds_run
from .options.early import check_ending
from .results.evaluation import Measure, evaluate, psnr_alone
from .results.metrics import image_metrics, quantised
from .results.modelfile import (
    Recorded,
    agreed_background_gate,
    agreed_blend_mode,
    agreed_faint_below,
    load_model,
    model_path,
)
from .results.pictures import file_names
from .results.rendering import Renderer, background_color
from .results.rows import RESULTS_NAME, read_results, result_row, write_results
from .scenes.cameras import Camera
from .scenes.orbit import Orbit, default_camera, orbit_of_cameras, orbit_of_points, upright
from .scenes.scene import Scene, difference_of, load_cameras, load_scene, read_layout
from .scenes.straight import pinhole_every
from .starting import find_model
from .system.device import check_device
from .system.files import is_file, is_folder, write_atomically, write_json_atomically
from .system.output_folder import Record, make_folder, only_one, own_record, remove_files, write_record
from .system.progress import progress_bar
from .train import PER_VIEW_NAME
from .training.checkpoint import SoFar, damage_named, load_checkpoint, made_so_far

RENDER = "dsmoe render"  # in its folders' records


def evaluate_run(output: str, device: str = "cpu", split: str = "test", scene_folder: Optional[str] = None,
                 progress: bool = True, measure: Measure = image_metrics) -> Dict[str, Any]:
    """Measures the run in `output` again and returns its row; for the test split OUT/results.json follows.

    Of a training that has not ended, its checkpoint is measured, and nothing is written.

    scene_folder: where the scene lies, if not where it was trained. If it is another scene, as one that has changed
    since, or that is not known, a line says so; another scene's row is not written. measure: as in `evaluate`. A
    folder that cannot be written to is told, no error. Raises TrainerError.
    """
    options = {"scene": scene_folder} if scene_folder else {}
    config = TrainConfig.of_run(output, "--scene", device=device, **options)
    check_device(device)
    opened = open_run(config, None, None, device)
    earlier = [row for row in read_results(output) if row.get("blend_mode") == config.blend_mode]
    layout = read_layout(config)
    scene = load_scene(config, progress, layout).to(device)
    note, is_other = compared(scene, config)
    for line in filter(None, (layout.warning, note + f"; {RESULTS_NAME} stays" * is_other)):
        print(line)
    views = {"test": scene.test, "train": scene.train}[split]
    if not views:
        raise TrainerError(f"scene {config.scene} has no {split} views; --split names others")
    masked = bool(earlier) and "masks" in earlier[0].get("protocol", {})
    if masked != any(view.mask is not None for view in views) and earlier:
        raise TrainerError(f"{config.scene} has {'no masks' if masked else 'masks'}, but the run was measured "
                           f"{'with' if masked else 'without'} them: these would be figures of other pixels; "
                           f"{'put them back' if masked else 'rename the folder'}, or name another --scene")
    renderer, seconds = opened.renderer, earlier[0].get("train_seconds") if earlier else None
    if earlier:
        by_pinhole = earlier[0].get("protocol", {}).get("pinhole_every", 0)
    else:  # what another scene was trained with is not known
        by_pinhole = 0 if is_other else pinhole_every(scene.train, config.iterations)
    evaluation = evaluate(renderer, views, device, progress, measure)
    if opened.so_far:
        config, seconds = replace(config, iterations=opened.so_far.iteration), opened.so_far.seconds
    training = evaluate(renderer, scene.train, device, progress, psnr_alone, passes=1).metrics["psnr"]
    row = result_row(config, scene, renderer.model.num_gaussians, seconds, evaluation, training,
                     renderer.background_gate, by_pinhole)
    if earlier and "start" in earlier[0]:  # of `dsmoe simplify`
        row["start"] = earlier[0]["start"]
    if split == "test" and not is_other and not opened.so_far:
        try:
            write_results(output, [row])
            write_json_atomically(os.path.join(output, PER_VIEW_NAME), evaluation.per_view)
        except OSError as error:
            print(f"warning: {output}: its results could not be written anew ({error.strerror}); the figures hold")
    return row


def open_renderer(config: TrainConfig, ply: str, asked_blend_mode: Optional[str], device: str,
                  asked_gate: Optional[float] = None, asked_faint: Optional[float] = None) -> Renderer:
    """A renderer for a file of a model with the blend that it records.

    config gives background and antialiasing. Raises TrainerError if what is asked disagrees with the file.
    """
    model, recorded = load_model(ply, device)
    mode = agreed_blend_mode(ply, recorded.blend_mode, asked_blend_mode)
    gate = agreed_background_gate(ply, mode, recorded, asked_gate)
    faint = agreed_faint_below(ply, mode, recorded, asked_faint)
    return Renderer(model, mode, background_color(config.white_background, device), config.antialiasing,
                    background_gate=gate, faint_below=faint)


class OpenedRun(NamedTuple):
    """The model of a run."""

    renderer: Renderer
    path: str  # of its Gaussians, or the checkpoint
    so_far: Optional[SoFar]  # what the checkpoint holds, if the training has not ended


def open_run(config: TrainConfig, asked_blend_mode: Optional[str], asked_gate: Optional[float], device: str,
             asked_faint: Optional[float] = None) -> OpenedRun:
    """A renderer for the model of the run that config is of; before its end, of its checkpoint, which a line says.

    Raises TrainerError if there is neither, and if what is asked disagrees with the run.
    """
    ply = model_path(config.output, config.iterations)
    if is_file(ply):
        mode, gate, _ = _agreed_with_run(config, asked_blend_mode, asked_gate, asked_faint)
        return OpenedRun(open_renderer(config, ply, mode, device, gate), ply, None)
    if not is_file(os.path.join(config.output, CHECKPOINT_NAME)):
        _agreed_with_run(config, asked_blend_mode, asked_gate, asked_faint)
        raise TrainerError(f"{ply}: no such file; the training in {config.output} has not ended, and has no checkpoint "
                           "yet (continue it with --resume)")
    renderer, so_far = open_checkpoint(config, asked_blend_mode, asked_gate, device, asked_faint)
    print(f"note: the training in {printable(config.output)} has not ended; this is its checkpoint, at iteration "
          f"{so_far.iteration:,} of {config.iterations:,}", file=sys.stderr)
    return OpenedRun(renderer, so_far.path, so_far)


def open_checkpoint(config: TrainConfig, asked_blend_mode: Optional[str], asked_gate: Optional[float], device: str,
                    asked_faint: Optional[float] = None) -> Tuple[Renderer, SoFar]:
    """A renderer for the checkpoint of the run that config is of, and what that holds. Raises as `open_run`."""
    mode, gate, faint = _agreed_with_run(config, asked_blend_mode, asked_gate, asked_faint)
    so_far = made_so_far(config, device)
    gate = agreed_background_gate(so_far.path, mode, Recorded(mode, so_far.background_gate), gate)
    return Renderer(so_far.model, mode, background_color(config.white_background, device), config.antialiasing,
                    background_gate=gate, faint_below=faint), so_far


def _agreed_with_run(config: TrainConfig, asked_blend_mode: Optional[str], asked_gate: Optional[float],
                     asked_faint: Optional[float]) -> Tuple[str, Optional[float], Optional[float]]:
    """The mode, the gate (None: a learned one, of which nothing is asked) and `faint_below` of a run.

    Raises TrainerError if what is asked disagrees with it.
    """
    mode = agreed_blend_mode(config.output, config.blend_mode, asked_blend_mode)
    if config.background_gate != LEARNED:
        recorded = Recorded(mode, float(config.background_gate))
        asked_gate = agreed_background_gate(config.output, mode, recorded, asked_gate)
    faint = agreed_faint_below(config.output, mode, Recorded(mode, None, config.unusual_faint), asked_faint)
    return mode, asked_gate, faint


def compared(scene: Scene, config: TrainConfig) -> Tuple[str, bool]:
    """What to say of a scene that the run's checkpoint does not record, and whether it is another one; else nothing.

    scene: loaded with checksums.
    """
    path = os.path.join(config.output, CHECKPOINT_NAME)
    try:
        with damage_named(path):
            recorded = dict(load_checkpoint(path, "cpu")["scene"])
    except TrainerError as error:
        return f"note: whether {config.scene} is the scene that the run was trained on is not known: {error}", False
    difference = difference_of(scene, recorded)
    if not difference:
        return "", False
    return f"note: {config.scene} is not the scene that {config.output} was trained on: {difference} here", True


def render_images(config: TrainConfig, ply: Optional[str], folder: str, split: Optional[str] = None,
                  blend_mode: Optional[str] = None, device: str = "cpu",
                  background_gate: Optional[float] = None, outputs: Sequence[str] = (), overwrite: bool = False,
                  faint_below: Optional[float] = None) -> List[str]:
    """Writes a PNG per camera of config.scene into `folder`; returns the paths.

    folder: new, empty, or of an earlier rendering, whose images of another model or scene are removed; with
    `overwrite` any, whose files of the same names are replaced.
    split: None: the test views, or the training views if there are none, which a line says.
    outputs: "depth" and "alpha" are written beside each. NAME.depth.npy [H, W] float32 is the expected view depth in
    the scene's units, 0 if nothing is hit. NAME.alpha.png has 8 bits, white where Gaussians cover.

    ply: a file that records how it is blended, else `blend_mode`, `background_gate` and `faint_below` say it; None:
    what `open_run` opens of the run that config is of, whose record these must not contradict. Raises TrainerError.
    """
    check_device(device)
    check_ending(folder, orbit=False)
    own_record(folder, RENDER, overwrite)  # refused before anything is read
    if ply is None:
        renderer, ply, _ = open_run(config, blend_mode, background_gate, device, faint_below)
    else:
        renderer = open_renderer(config, ply, blend_mode, device, background_gate, faint_below)
    cameras = load_cameras(config, split or "test")
    if not cameras and not split:
        cameras = load_cameras(config, "train")
        why = " (no image is held out: --test-every 0, or eval=False in cfg_args)" if config.test_every == 0 else ""
        print(f"note: scene {printable(config.scene)} has no test views{why}; these are its training views",
              file=sys.stderr)
    if not cameras:
        raise TrainerError(f"scene {config.scene} has no {split or 'test'} views; --split names others")
    return write_images(renderer, cameras, folder, said_of_images(config, ply, renderer), outputs, overwrite)


def write_images(renderer: Renderer, cameras: Sequence[Camera], folder: str, subject: str,
                 outputs: Sequence[str] = (), overwrite: bool = False) -> List[str]:
    """Writes a PNG per camera into `folder`; returns the paths.

    subject: what they show, for the folder's record: images of something else are removed. The rest is as in
    `render_images`. Raises TrainerError.
    """
    endings = {"depth": ".depth.npy", "alpha": ".alpha.png"}
    stems = file_names([camera.name for camera in cameras])
    written = [stem + ending for stem in stems for ending in (".png", *map(endings.get, outputs))]
    if len({*written}) < len(written):
        raise TrainerError(f"{subject}: names of cameras differ only by {' or '.join(endings.values())}; rename one")
    own_record(folder, RENDER, overwrite)  # refused before the folder is made
    make_folder(folder)
    with only_one(folder), torch.no_grad():
        earlier = own_record(folder, RENDER, overwrite)
        kept = earlier.files if subject == earlier.subject else []  # of another split
        write_record(folder, RENDER, Record(subject, sorted({*kept, *written})), earlier.files, overwrite)
        remove_files(folder, written)
        paths = [os.path.join(folder, stem) for stem in stems]
        for camera, path in zip(progress_bar(cameras, desc="images", unit="image", leave=False), paths):
            rendering = renderer(camera, outputs=tuple(outputs))
            write_atomically(path + ".png", partial(to_image(rendering.color).save, format="PNG"))
            if rendering.depth is not None:
                depth = rendering.depth[0].cpu().numpy()
                write_atomically(path + endings["depth"], partial(np.save, arr=depth))
            if rendering.alpha is not None:
                alpha = to_image(rendering.alpha.expand(3, -1, -1)).convert("L")
                write_atomically(path + endings["alpha"], partial(alpha.save, format="PNG"))
    return [path + ".png" for path in paths]


def said_of_images(config: TrainConfig, ply: str, renderer: Renderer) -> str:
    """What images show, for their folder's record: other words, and they are not kept beside each other."""
    model = os.stat(ply)
    return (f"{os.path.abspath(ply)}, {model.st_size} bytes of {model.st_mtime_ns}, on "
            f"{os.path.abspath(config.scene)}: {renderer.blend_mode} {renderer.background_gate} "
            f"{renderer.faint_below}, resolution {config.resolution}, principal point {config.principal_point}, "
            f"lenses {config.lenses}, "
            f"{'white' if config.white_background else 'black'} background")


def to_image(color: torch.Tensor) -> Image.Image:
    """A rendering [3, H, W] as an 8-bit image, rounded as the metrics round."""
    values = (quantised(color.detach()) * 255).round().to(torch.uint8)
    return Image.fromarray(np.ascontiguousarray(values.permute(1, 2, 0).cpu().numpy()))


@dataclass(frozen=True)
class Trained:
    """An opened model."""

    config: TrainConfig  # the run's; of another model only what says how its scene is loaded means something
    path: str  # the file; of a training that has not ended, the checkpoint
    renderer: Renderer
    cameras: List[Camera]  # the scene's test views, else its training views, upright; one on the orbit without a scene
    orbit: Orbit
    has_ended: bool = True  # the training


def open_trained(source: str, blend_mode: Optional[str] = None, background_gate: Optional[float] = None,
                 device: str = "cpu", faint_below: Optional[float] = None, **options: Any) -> Trained:
    """Opens a model as `find_model` finds it; of a training that has not ended, its checkpoint.

    blend_mode, background_gate, faint_below: of a file that does not record them (else alpha); they must agree if
    something does.
    options: of TrainConfig, in place of the run's; `scene` is the folder whose cameras are taken. There are none if the
    run's scene is not there. Raises TrainerError.
    """
    check_device(device)
    so_far, missing = None, ""
    if holds_run(source):
        config = TrainConfig.load(source).changed(**options)
        renderer, path, so_far = open_run(config, blend_mode, background_gate, device, faint_below)
    else:
        config, path, missing = config_of_model(source, **options)
        renderer = open_renderer(config, path, blend_mode, device, background_gate, faint_below)
    if config.scene:
        missing = "" if is_folder(config.scene) or "scene" in options else config.scene
    if missing:
        print(f"note: the scene that {printable(source)} names, {printable(missing)}, is not there, so its cameras are "
              "not known; --scene names the folder that has them", file=sys.stderr)
    cameras, orbit = places(config, renderer.model, needed="scene" in options)
    return Trained(config, path, renderer, cameras, orbit, so_far is None)


def config_of_model(source: str, **options: Any) -> Tuple[TrainConfig, str, str]:
    """Of a model that is no run: what its folder knows of its scene, with some options set, its file, and a scene that
    the folder names and that is not there.

    Raises TrainerError.
    """
    found = find_model(source)
    known = found.options_on(options.get("scene", ""))
    return TrainConfig(**{"blend_mode": "alpha", **known, **options}).validate(), found.path, found.missing


def places(config: TrainConfig, model: GaussianModel, needed: bool = False) -> Tuple[List[Camera], Orbit]:
    """The cameras for a model: the test views of config.scene, else its training views, and their orbit.

    The views are upright, since photographs are often tilted, and pinhole cameras.

    If the scene is not there, it is an orbit about the Gaussians and one camera on it. needed: raise TrainerError
    then.
    """
    if needed or is_folder(config.scene):
        every = load_cameras(config, "all")
        orbit = orbit_of_cameras(every)
        return [upright(camera.pinhole(), orbit.up) for camera in load_cameras(config, "test") or every], orbit
    orbit = orbit_of_points(model.raw["means3D"].detach().cpu().double().numpy())
    return orbit.cameras(1, default_camera()), orbit
