"""A trained model to start from: which file it is, what that holds, how it is blended, and what its folder knows."""
from __future__ import annotations

import dataclasses
import functools
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Dict, NamedTuple, Optional, Sequence, Tuple

import numpy as np
import torch

from diff_smoe_rasterization import io
from diff_smoe_rasterization.settings import GATED_MODES, trained_faint_below

from .errors import ConfigError, TrainerError
from .model import GaussianModel, finite_rows
from .options.config import CONFIG_NAME, LEARNED, TrainConfig, holds_run, learned_gate_of, runs_below
from .options.early import check_model
from .results.evaluation import evaluate
from .results.modelfile import (
    agreed_background_gate,
    agreed_blend_mode,
    model_path,
    read_gaussians,
    recorded_of,
)
from .results.pictures import evenly_spaced
from .results.rendering import Renderer, background_color
from .results.rows import blend_name
from .results.shown import raw_of
from .scenes.images import View
from .scenes.modelfolder import CAMERAS, cfg_args_of, latest_model
from .scenes.pointcloud import SH_C0, PointCloud
from .system.files import is_file, is_folder
from .system.process import typed

if TYPE_CHECKING:
    from .scenes.scene import Scene

LEAST_PSNR = 15.0  # of a model on its scene, dB: with less they do not belong together
CHECKED_VIEWS = 16
LEAST_ABOVE_BOUND = 1e-3  # a learned gate begins above its bound
CLEARLY = 0.1  # dB of difference that show where a model's program had the principal points


@dataclass(frozen=True)
class Start:
    """A model to start from."""

    path: str
    gaussians: io.Gaussians
    blend_mode: str
    background_gate: float
    faint_below: Optional[float] = None  # as usual

    @property
    def count(self) -> int:
        return len(self.gaussians.means3D)

    @property
    def blend_text(self) -> str:
        """Its blend mode, and how to declare one that the file does not record."""
        hint = "" if self.gaussians.blend_mode else (
            f" (not recorded; `dsmoe export {typed(self.path)} --paper -o declared.ply` records the blend of the "
            "paper's program, --blend-mode smoe --background-gate X that of another one)")
        return self.blend_mode + hint

    def points(self) -> PointCloud:
        """Places and base colours of the Gaussians."""
        colors = 0.5 + SH_C0 * self.gaussians.dc[:, 0].astype(np.float64)
        return PointCloud(self.gaussians.means3D.astype(np.float64), colors.clip(0, 1))


@dataclass(frozen=True)
class Found:
    """Where a model lies."""

    path: str
    options: Dict[str, Any] = field(default_factory=dict)  # of TrainConfig, that its folder records; a `scene` is there
    teacher: Dict[str, Any] = field(default_factory=dict)  # others in their place, for its renderings as the scene
    missing: str = ""  # a scene that its folder names and that is not there

    def options_on(self, scene: str) -> Dict[str, Any]:
        """The options for a scene; empty: the one that the folder names, else the model's renderings."""
        own = str(self.teacher.get("scene", ""))
        if own and (os.path.realpath(scene) == os.path.realpath(own) if scene else "scene" not in self.options):
            return {**self.options, **self.teacher}
        return dict(self.options)


class Quality(NamedTuple):
    """The PSNR of a model on some training images, dB."""

    views: int
    psnr: float
    centred: float  # with principal points in the images' centres

    @property
    def is_centred(self) -> bool:
        """Whether the model's program had them there."""
        return self.centred > self.psnr + CLEARLY

    def text(self, config: TrainConfig) -> str:
        """What to say of it."""
        if not self.is_centred:
            return f"it has {self.psnr:.2f} dB on {self.views} of the training images"
        if config.principal_point == "centre":
            return (f"it has {self.centred:.2f} dB on {self.views} of the training images with principal points in "
                    f"their centres, which are taken, and {self.psnr:.2f} dB as the scene has them")
        return (f"it has {self.psnr:.2f} dB on {self.views} of the training images; note: with --principal-point "
                f"centre it has {self.centred:.2f} dB")


def read_start(path: str) -> Start:
    """Reads a .ply, .splat, .spz or .glb; what does not say how it is blended is of another program: alpha.

    Raises TrainerError naming file and reason, also if a Gaussian cannot be shown.
    """
    try:
        stamp = os.stat(path)
    except OSError as error:
        raise TrainerError(f"{path}: {error.strerror or error}") from error
    return _read_start(path, stamp.st_mtime_ns, stamp.st_size)


@functools.lru_cache(maxsize=1)  # options, scene and training ask for it in turn, and a scene keeps it anyway
def _read_start(path: str, *_: int) -> Start:
    """`read_start` of a file as it was changed last."""
    gaussians = read_gaussians(path)
    count = len(gaussians.means3D)
    bad = count - int(finite_rows(raw_of(gaussians)).sum())
    if not count:
        raise TrainerError(f"{path}: it holds no Gaussians; name a model that has some")
    if bad:
        raise TrainerError(f"{path}: {bad:,} of its {count:,} Gaussians have a number that is NaN or infinite; `dsmoe "
                           f"export {typed(path)} -o clean.glb` leaves such Gaussians out")
    recorded = recorded_of(path, gaussians)
    gaussians = dataclasses.replace(gaussians, blend_mode=recorded.blend_mode)  # or of its folder
    mode = agreed_blend_mode(path, recorded.blend_mode, recorded.blend_mode or "alpha")
    return Start(path, gaussians, mode, agreed_background_gate(path, mode, recorded, None), recorded.faint_below)


def find_model(source: str) -> Found:
    """The model in a file, an output folder of `dsmoe train` or a model folder of 3DGS. Raises TrainerError."""
    check_model(source)
    if is_file(source):
        return Found(source)
    if holds_run(source):
        return _found_run(source)
    path = latest_model(source)
    if not path:
        raise TrainerError(f"{source}: no model is in it: neither {CONFIG_NAME} of `dsmoe train` nor point_cloud/"
                           "iteration_N/point_cloud.ply of 3DGS" + runs_below(source))
    options, missing = _options_of_3dgs(source)
    return Found(path, options, {"scene": source} if is_file(os.path.join(source, CAMERAS)) else {}, missing)


def _found_run(folder: str) -> Found:
    config = TrainConfig.load(folder)
    path = model_path(folder, config.iterations)
    if not is_file(path):
        raise TrainerError(f"{path}: no such file; the training in {folder} has not ended (continue it with --resume)")
    names = ["test_every", "white_background", "random_background", "antialiasing", "images", "strict", "resolution",
             "principal_point", "lenses"]
    if config.background_gate != LEARNED:
        names += ["blend_mode", "background_gate"]
    options = {name: getattr(config, name) for name in names}
    is_there = is_folder(config.scene)
    if is_there:
        options["scene"] = config.scene
    # Its cameras.json has those of the resized images.
    teacher = {"scene": folder, "resolution": 1, "principal_point": "scene", "lenses": TrainConfig().lenses}
    return Found(path, options, teacher if is_file(os.path.join(folder, CAMERAS)) else {},
                 "" if is_there else config.scene)


def _options_of_3dgs(folder: str) -> Tuple[Dict[str, Any], str]:
    """What cfg_args says of the training but the blend, which `recorded_of` reads; and a scene that is not there.

    Where it had principal points is seen later. A relative path of the scene begins in the current folder, as for 3DGS
    itself, else in the model folder.
    """
    options: Dict[str, Any] = {}
    known, missing = cfg_args_of(folder), ""
    scene = known.get("source_path")
    if isinstance(scene, str) and scene:
        places = [*dict.fromkeys(os.path.abspath(place) for place in (scene, os.path.join(folder, scene)))]
        there = list(filter(is_folder, places))
        if there:
            options["scene"] = there[0]
        else:
            missing = " or ".join(places)
    for name, kind in (("images", str), ("resolution", int), ("white_background", bool), ("antialiasing", bool)):
        if isinstance(known.get(name), kind):
            options[name] = known[name]
    if known.get("eval") is False:  # then it trains on all images
        options["test_every"] = 0
    return options, missing


def blend_options(start: Start, given: Dict[str, Any]) -> Dict[str, Any]:
    """Options of a training from the model, beside given ones: its blend, and a learned gate begins with its gate.

    A gate of 0, as the paper has it, stays, unless something is given of how one is learned.
    """
    mode = given.get("blend_mode") or start.blend_mode
    options: Dict[str, Any] = {"blend_mode": mode}
    if mode != start.blend_mode or mode not in GATED_MODES:
        return options
    options["faint_below"] = given.get("faint_below", trained_faint_below(mode, start.faint_below))
    learns = start.background_gate != 0 or not learned_gate_of(mode).keys().isdisjoint(given)
    # Given, so that $DSMOE_BACKGROUND_GATE does not count.
    options["background_gate"] = given.get("background_gate", LEARNED if learns else 0.0)
    if options["background_gate"] == LEARNED and "background_gate_start" not in given:
        bound = given.get("background_gate_bound", learned_gate_of(mode)["background_gate_bound"])
        options["background_gate_start"] = max(start.background_gate, bound + LEAST_ABOVE_BOUND)
    return options


def change_of_blend(start: Start, config: TrainConfig) -> str:
    """What to say if the training makes another blend than the model's; else nothing."""
    mode, gate = str(config.blend_mode), config.background_gate
    faint = (trained_faint_below(start.blend_mode, start.faint_below), config.faint_below)
    if mode == start.blend_mode and (mode not in GATED_MODES or gate in (start.background_gate, LEARNED)
                                     and faint[0] == faint[1]):
        return ""
    return (f"note: the model is blended by {blend_name(start.blend_mode, start.background_gate, faint[0])}, and the "
            f"result will be by {blend_name(mode, gate, faint[1])}")


def start_renderer(start: Start, config: TrainConfig) -> Renderer:
    """Renders the model as it was trained, on config.device."""
    model = GaussianModel.from_gaussians(raw_of(start.gaussians, config.device), start.gaussians.sh_degree)
    return Renderer(model, start.blend_mode, background_color(config.white_background, config.device),
                    config.antialiasing, background_gate=start.background_gate, faint_below=start.faint_below)


def check_start(scene: Scene, config: TrainConfig) -> Quality:
    """How well the model to start from shows some training views.

    Raises TrainerError if it does not, and ConfigError if the strategy cannot lead from it to the budget.
    """
    start = scene.start
    assert start is not None
    if config.strategy != "importance" and 0 < config.budget < start.count:
        raise ConfigError(f"--budget is {config.budget}; with --strategy {config.strategy} it must be at least "
                          f"{start.count}, which {start.path} has: only importance removes Gaussians to a number")
    renderer = start_renderer(start, config)

    def psnr(views: Sequence[View]) -> float:
        with torch.no_grad():
            moved = [view.to(config.device) for view in views]
            return float(evaluate(renderer, moved, config.device, passes=1).metrics["psnr"] or 0)

    views = [scene.train[index] for index in evenly_spaced(len(scene.train), CHECKED_VIEWS)]
    there = psnr(views)
    centred = [view.camera.centred() for view in views]
    is_centred = all(abs(view.camera.cx - camera.cx) + abs(view.camera.cy - camera.cy) < 1e-6
                     for view, camera in zip(views, centred))
    quality = Quality(len(views), there, there if is_centred else psnr(
        [dataclasses.replace(view, camera=camera) for view, camera in zip(views, centred)]))
    if max(quality.psnr, quality.centred) < LEAST_PSNR:
        raise TrainerError(f"{start.path} does not show {config.scene}: {there:.1f} dB on its images, and it must be "
                           f"at least {LEAST_PSNR:g}. {_why_not_shown(scene, config)}")
    return quality


def _why_not_shown(scene: Scene, config: TrainConfig) -> str:
    """Questions of what differs from the training of the model to start from."""
    assert scene.start is not None
    questions = ["is it another scene", "are its poses others than those of the training (some programs move and scale "
                 "them)", "was its background "
                 + ("black (now it is white)" if config.white_background else "white (--white-background)")]
    if any(view.camera.lens for view in scene.train):
        questions.append("were its images undistorted (--lenses undistort)")
    elif scene.note:
        questions.append("was it trained on images as they are (--lenses native)")
    if scene.start.gaussians.blend_mode is None:
        questions.append(f"is its blend mode not {scene.start.blend_text}")
    text = ", ".join(questions[:-1]) + ", or " + questions[-1]
    return text[0].upper() + text[1:] + "?"
