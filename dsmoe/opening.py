"""A trained model, from its run's folder or from only its .ply: how to render it, and from which cameras."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any, List, Optional, Tuple

from .config import TrainConfig
from .early import check_source
from .inspection import open_renderer, open_run
from .model import GaussianModel
from .results.rendering import Renderer
from .scenes.cameras import Camera
from .scenes.orbit import Orbit, default_camera, orbit_of_cameras, orbit_of_points, upright
from .scenes.scene import load_cameras
from .system.device import check_device
from .system.files import is_folder


@dataclass(frozen=True)
class Trained:
    """An opened model."""

    config: TrainConfig  # the run's; of a .ply only background, resolution and scene mean something
    path: str  # the .ply; of a training that has not ended, the checkpoint
    renderer: Renderer
    cameras: List[Camera]  # the scene's test views, else its training views, upright; one on the orbit without a scene
    orbit: Orbit
    has_ended: bool = True  # the training


def open_trained(source: str, blend_mode: Optional[str] = None, background_gate: Optional[float] = None,
                 device: str = "cpu", **options: Any) -> Trained:
    """Opens the output folder of `dsmoe train`, before its end the checkpoint in it, or a .ply.

    blend_mode, background_gate: of a .ply that does not record them (else alpha); they must agree if something does.
    options: of TrainConfig, in place of the run's; `scene` is the folder whose cameras are taken. There are none if the
    run's scene is not there. Raises TrainerError.
    """
    check_device(device)
    check_source(source)
    if is_folder(source):
        config = TrainConfig.load(source).changed(**options)
        renderer, path, so_far = open_run(config, blend_mode, background_gate, device)
    else:
        config, path, so_far = TrainConfig(blend_mode="alpha", **options).validate(), source, None
        renderer = open_renderer(config, path, blend_mode, device, asked_gate=background_gate)
    cameras, orbit = places(config, renderer.model, needed="scene" in options)
    return Trained(config, path, renderer, cameras, orbit, so_far is None)


def places(config: TrainConfig, model: GaussianModel, needed: bool = False) -> Tuple[List[Camera], Orbit]:
    """The cameras for a model: the test views of config.scene, else its training views, and their orbit.

    The views are upright: photographs are often tilted.

    If the scene is not there, it is an orbit about the Gaussians and one camera on it. needed: raise TrainerError
    then.
    """
    if needed or is_folder(config.scene):
        every = load_cameras(config, "all")
        orbit = orbit_of_cameras(every)
        return [upright(camera, orbit.up) for camera in load_cameras(config, "test") or every], orbit
    orbit = orbit_of_points(model.raw["means3D"].detach().cpu().double().numpy())
    return orbit.cameras(1, default_camera()), orbit
