"""`dsmoe export`: a trained model as one file."""
from __future__ import annotations

import dataclasses
import os
from typing import Any, Dict, Optional, Tuple

from .. import io
from ..settings import GATED_MODES, record_of
from ..trainer.errors import TrainerError
from ..trainer.opening import Trained, open_trained
from ..trainer.results.pictures import evenly_spaced
from ..trainer.results.rows import viewer_warning
from ..trainer.system.files import write_atomically
from . import html
from .splat import splat_bytes

FORMATS = ("html", "ply", "splat")
VIEWS = 16  # of a page, at most


def export(source: str, path: Optional[str] = None, form: Optional[str] = None, sh_degree: Optional[int] = None,
           blend_mode: Optional[str] = None, background_gate: Optional[float] = None,
           **options: Any) -> Tuple[str, str]:
    """Writes the model of a run's folder or of a .ply; returns the file's path and a warning, which may be empty.

    form: one of FORMATS; None: by the ending of `path`, else html. path: None: model.FORM. sh_degree: the highest
    degree of view-dependent colour that is kept. The rest is as in `open_trained`. Raises TrainerError.
    """
    ending = os.path.splitext(path)[1][1:].lower() if path else FORMATS[0]
    if form and path and ending in FORMATS and ending != form:
        raise TrainerError(f"{path}: its ending says {ending}, and --format says {form}; they must agree")
    form = form or ending
    if form not in FORMATS:
        raise TrainerError(f"{path}: its ending is none of {', '.join(FORMATS)}; say which --format it is")
    path = path or f"model.{form}"
    trained = open_trained(source, blend_mode, background_gate, **options)
    gaussians = io.read_gaussians(trained.ply)
    if sh_degree is not None:
        gaussians = dataclasses.replace(gaussians, shs=gaussians.shs[:, :(sh_degree + 1) ** 2 - 1])
    if form == "ply":
        _write_ply(path, trained, gaussians)
    else:
        text = splat_bytes(gaussians) if form == "splat" else html.page(gaussians, _shown(trained)).encode("utf-8")
        write_atomically(path, lambda file: file.write(text))
    renderer = trained.renderer
    return path, "" if form == "html" else viewer_warning(
        {"blend_mode": renderer.blend_mode, "background_gate": renderer.background_gate}, form)


def _write_ply(path: str, trained: Trained, gaussians: io.Gaussians) -> None:
    if os.path.exists(path) and os.path.samefile(path, trained.ply):
        raise TrainerError(f"{path} is the model itself; choose another file with -o")
    mode, gate = trained.renderer.blend_mode, trained.renderer.background_gate
    recorded: Dict[str, Any] = {"blend_mode": record_of(mode),
                                "background_gate": float(gate) if mode in GATED_MODES else None}
    others = tuple(line for line in gaussians.comments if line.split(" ")[0] not in recorded)  # of an older name
    io.write_gaussians(path, dataclasses.replace(gaussians, comments=others, **recorded))


def _shown(trained: Trained) -> html.Shown:
    renderer = trained.renderer
    red, green, blue = renderer.background.tolist()
    cameras = [trained.cameras[index] for index in evenly_spaced(len(trained.cameras), VIEWS)]
    title = os.path.basename(os.path.abspath(trained.config.scene or trained.ply))
    return html.Shown(title, renderer.blend_mode, float(renderer.background_gate), (red, green, blue),
                      renderer.antialiasing, cameras, trained.orbit)


