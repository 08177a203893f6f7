"""`dsmoe export`: a trained model as one file."""
from __future__ import annotations

import dataclasses
import os
import tempfile
from typing import Any, Dict, Optional, Tuple

from diff_smoe_rasterization import io
from diff_smoe_rasterization.settings import GATED_MODES, leaves_out_faint, trained_faint_below

from ..errors import TrainerError, printable
from ..inspection import Trained, open_trained
from ..options.choices import BAKE_ITERATIONS
from ..options.choices import EXPORT_FORMATS as FORMATS
from ..results.glb import BLEND, Blend, glb_bytes
from ..results.modelfile import read_gaussians, recorded_of, save_model
from ..results.pictures import evenly_spaced
from ..results.rows import blend_name, viewer_warning
from ..results.shown import FAINT_BELOW, faint_comment
from ..results.splat import splat_bytes
from ..results.spz import check_spz, spz_bytes
from ..system.files import check_output, is_folder, new_file, write_atomically
from . import html

VIEWS = 16  # of a page, at most


def export(source: str, path: Optional[str] = None, form: Optional[str] = None, sh_degree: Optional[int] = None,
           blend_mode: Optional[str] = None, background_gate: Optional[float] = None, *, overwrite: bool = False,
           bake: Optional[str] = None, bake_iterations: int = BAKE_ITERATIONS, device: str = "cpu",
           **options: Any) -> Tuple[str, str]:
    """Writes a model as one file; returns the file's path and a note, which may be empty.

    form: one of FORMATS; None: by the ending of `path`, else html. path: None: model.FORM. sh_degree: the highest
    degree of view-dependent colour that is kept. overwrite: `path` may be a file that is there. bake: "alpha"
    fine-tunes the model to that blend, on the scene's images and the device; the note says what it costs. The rest is
    as in `open_trained`. Raises TrainerError.
    """
    ending = os.path.splitext(path)[1][1:].lower() if path else FORMATS[0]
    if form and path and ending in FORMATS and ending != form:
        raise TrainerError(f"{path}: its ending says {ending}, and --format says {form}; they must agree")
    form = form or ending
    if form not in FORMATS:
        raise TrainerError(f"{path}: its ending is none of {', '.join(FORMATS)}; say which --format it is")
    path = path or f"model.{form}"
    check_output(path, overwrite)  # refused before anything is read
    if form == "spz":
        check_spz()
    trained = open_trained(source, blend_mode, background_gate, device, **options)
    if os.path.exists(path) and os.path.samefile(path, trained.path):
        raise TrainerError(f"{path} is the model itself; choose another file with -o")
    if not bake and trained.has_ended:
        return path, _write(path, form, trained, sh_degree, overwrite, blend_mode is not None)
    with tempfile.TemporaryDirectory() as folder:
        if not bake:
            return path, _write(path, form, _stored(trained, folder), sh_degree, overwrite)
        baked, note = _baked(trained, folder, bake_iterations)
        _write(path, form, baked, sh_degree, overwrite)
    return path, note


def _stored(trained: Trained, folder: str) -> Trained:
    """The model of a checkpoint with a .ply in the folder."""
    renderer, ply = trained.renderer, os.path.join(folder, "model.ply")
    save_model(ply, renderer.model, renderer.blend_mode, float(renderer.background_gate), renderer.faint_below)
    return dataclasses.replace(trained, path=ply)


def _baked(trained: Trained, folder: str, iterations: int) -> Tuple[Trained, str]:
    """The model for alpha, its .ply in the folder, and what that costs."""
    from .bake import bake

    config, before = trained.config, trained.renderer
    if not is_folder(config.scene):
        raise TrainerError("--bake trains on the scene's images; name the scene's folder with --scene")
    baked = bake(config.changed(output=folder, device=str(before.background.device.type)), before, iterations,
                 run=config if config.output else None)
    ply = os.path.join(folder, "baked.ply")
    save_model(ply, baked.renderer.model, baked.renderer.blend_mode, 1.0)
    name = blend_name(before.blend_mode, float(before.background_gate), before.faint_below)
    note = "the scene has no test images: what the baking costs was not measured"
    if baked.trained is not None:
        note = (f"test PSNR: {baked.trained:.2f} dB in {name}, {baked.shown:.2f} dB when viewers blend that by alpha, "
                f"{baked.baked:.2f} dB baked to alpha ({baked.baked - baked.trained:+.2f} dB)")
    return dataclasses.replace(trained, path=ply, renderer=baked.renderer), note


def _write(path: str, form: str, trained: Trained, sh_degree: Optional[int], overwrite: bool,
           is_declared: bool = False) -> str:
    """Writes the file; returns a warning, which may be empty.

    is_declared: whether an option says how the model is blended, which a .ply then records.
    """
    gaussians = read_gaussians(trained.path)
    if sh_degree is not None:
        gaussians = dataclasses.replace(gaussians, shs=gaussians.shs[:, :(sh_degree + 1) ** 2 - 1])
    renderer = trained.renderer
    warning = viewer_warning({"blend_mode": renderer.blend_mode, "background_gate": renderer.background_gate}, form)
    if form == "ply":
        is_declared = is_declared or recorded_of(trained.path, gaussians).blend_mode is not None
        _write_ply(path, trained, gaussians, overwrite, is_declared)
    else:
        blend = Blend(renderer.blend_mode, float(renderer.background_gate), renderer.faint_below) if warning else None
        content = {"html": lambda: html.page(gaussians, _shown(trained)).encode("utf-8"),
                   "splat": lambda: splat_bytes(gaussians), "spz": lambda: spz_bytes(gaussians),
                   "glb": lambda: glb_bytes(gaussians, blend)}[form]()
        write_atomically(path, lambda file: file.write(content), overwrite)
    if form == "html":
        mode = renderer.blend_mode
        misses = mode == "smoe_eq7" and leaves_out_faint(mode, trained_faint_below(mode, renderer.faint_below))
        return "note: of smoe_eq7 the page draws all pairs, as with faint_below 2" if misses else ""
    if not warning:
        return ""
    if form == "glb":
        warning = f"note: the .glb requires {BLEND}, so that no viewer shows its {renderer.blend_mode} by alpha"
    return warning + "; with --bake alpha every viewer shows the model"


def _write_ply(path: str, trained: Trained, gaussians: io.Gaussians, overwrite: bool, is_declared: bool) -> None:
    mode, gate = trained.renderer.blend_mode, trained.renderer.background_gate
    recorded: Dict[str, Any] = {"blend_mode": mode if is_declared else None,
                                "background_gate": float(gate) if mode in GATED_MODES else None}
    known = (*recorded, FAINT_BELOW)  # also of an older name
    others = [line for line in gaussians.comments if line.split(" ")[0] not in known]
    if trained.renderer.faint_below is not None:
        others.append(faint_comment(trained.renderer.faint_below))
    with new_file(path, overwrite) as temporary:
        io.write_gaussians(temporary, dataclasses.replace(gaussians, comments=tuple(others), **recorded))


def _shown(trained: Trained) -> html.Shown:
    renderer = trained.renderer
    red, green, blue = renderer.background.tolist()
    cameras = [trained.cameras[index] for index in evenly_spaced(len(trained.cameras), VIEWS)]
    title = printable(os.path.basename(os.path.abspath(trained.config.scene or trained.path)))
    return html.Shown(title, renderer.blend_mode, float(renderer.background_gate), (red, green, blue),
                      renderer.antialiasing, cameras, trained.orbit, renderer.faint_below)


