"""`dsmoe export`: a trained model as one file."""
from __future__ import annotations

import dataclasses
import os
from typing import Any, Optional, Tuple

from .. import io
from ..trainer.errors import TrainerError
from ..trainer.opening import Trained, open_trained
from ..trainer.results.pictures import evenly_spaced
from ..trainer.results.rows import viewer_warning
from ..trainer.system.files import write_atomically
from . import html
from .glb import BLEND, Blend, glb_bytes
from .splat import splat_bytes
from .spz import check_spz, spz_bytes

FORMATS = ("html", "ply", "splat", "spz", "glb")
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
    if form == "spz":
        check_spz()
    trained = open_trained(source, blend_mode, background_gate, **options)
    gaussians = io.read_gaussians(trained.ply)
    if sh_degree is not None:
        gaussians = dataclasses.replace(gaussians, shs=gaussians.shs[:, :(sh_degree + 1) ** 2 - 1])
    renderer = trained.renderer
    warning = viewer_warning({"blend_mode": renderer.blend_mode, "background_gate": renderer.background_gate}, form)
    if form == "ply":
        _write_ply(path, trained, gaussians)
    else:
        blend = Blend(renderer.blend_mode, float(renderer.background_gate)) if warning else None
        content = {"html": lambda: html.page(gaussians, _shown(trained)).encode("utf-8"),
                   "splat": lambda: splat_bytes(gaussians), "spz": lambda: spz_bytes(gaussians),
                   "glb": lambda: glb_bytes(gaussians, blend)}[form]()
        write_atomically(path, lambda file: file.write(content))
    if form == "html":
        return path, ""
    if warning and form == "glb":
        warning = f"note: the .glb requires {BLEND}, so that no viewer shows its {renderer.blend_mode} by alpha"
    return path, warning


def _write_ply(path: str, trained: Trained, gaussians: io.Gaussians) -> None:
    if os.path.exists(path) and os.path.samefile(path, trained.ply):
        raise TrainerError(f"{path} is the model itself; choose another file with -o")
    mode, gate = trained.renderer.blend_mode, trained.renderer.background_gate
    recorded = {"blend_mode": mode, "background_gate": float(gate) if mode == "smoe" else None}
    io.write_gaussians(path, dataclasses.replace(gaussians, **recorded))


def _shown(trained: Trained) -> html.Shown:
    renderer = trained.renderer
    red, green, blue = renderer.background.tolist()
    cameras = [trained.cameras[index] for index in evenly_spaced(len(trained.cameras), VIEWS)]
    title = os.path.basename(os.path.abspath(trained.config.scene or trained.ply))
    return html.Shown(title, renderer.blend_mode, float(renderer.background_gate), (red, green, blue),
                      renderer.antialiasing, cameras, trained.orbit)


