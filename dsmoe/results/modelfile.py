"""GaussianModel to and from files. Comments of a .ply record how its Gaussians are blended."""
from __future__ import annotations

import os
import sys
from typing import NamedTuple, Optional, Tuple, Union

from diff_smoe_rasterization import io
from diff_smoe_rasterization.settings import (
    BLEND_MODES,
    GATED_MODES,
    LEARNED,
    PAPER,
    PAPER_PROGRAM,
    resolve_background_gate,
    resolve_faint_below,
    trained_faint_below,
)

from ..errors import TrainerError, printable
from ..model import GaussianModel, finite_rows
from ..scenes.modelfolder import CFG_ARGS, cfg_args_of
from ..system.files import new_file
from ..system.process import typed
from .glb import glb_gaussians
from .shown import FAINT_BELOW, faint_comment, raw_of
from .splat import splat_gaussians
from .spz import spz_gaussians

READERS = {".splat": splat_gaussians, ".spz": spz_gaussians, ".glb": glb_gaussians}
FOLDER = "point_cloud"  # OUT/point_cloud/iteration_N/point_cloud.ply, as viewers of 3DGS expect it


class Recorded(NamedTuple):
    """What a file says of the blend that its Gaussians were trained with; None if it does not."""

    blend_mode: Optional[str]
    background_gate: Union[float, str, None]  # LEARNED: its value is not said
    faint_below: Optional[float] = None  # also: as usual


def model_path(output: str, iteration: int) -> str:
    """The path of a run's Gaussians of that iteration."""
    return os.path.join(output, FOLDER, f"iteration_{iteration}", "point_cloud.ply")


def save_model(path: str, model: GaussianModel, blend_mode: str, background_gate: float,
               faint_below: Optional[float] = None) -> None:
    """Writes the raw parameters, `comment blend_mode NAME` and in GATED_MODES `comment background_gate VALUE`.

    And `comment faint_below VALUE`, if there is one.
    """
    raw = {name: tensor.detach().cpu().numpy() for name, tensor in model.raw.items()}
    gaussians = io.Gaussians(
        means3D=raw["means3D"], dc=raw["dc"], shs=raw["shs"], opacity_logits=raw["opacities"],
        log_scales=raw["scales"], rotations=raw["rotations"], blend_mode=blend_mode,
        background_gate=background_gate if blend_mode in GATED_MODES else None,
        comments=() if faint_below is None else (faint_comment(faint_below),))
    with new_file(path) as temporary:
        io.write_gaussians(temporary, gaussians)


def load_model(path: str, device: str) -> Tuple[GaussianModel, Recorded]:
    """Reads a file; returns the model, all its SH degrees active, and what the file says of its blend.

    Raises TrainerError naming file and reason, also if no Gaussian can be shown.
    """
    stored = read_gaussians(path)
    raw = raw_of(stored, device)
    if len(stored.means3D) and not finite_rows(raw).any():
        raise TrainerError(f"{path}: each of its {len(stored.means3D):,} Gaussians has a number that is NaN or "
                           "infinite, so the rasterizer shows none; was the training diverging?")
    model = GaussianModel.from_gaussians(raw, stored.sh_degree)
    return model, recorded_of(path, stored)


def read_gaussians(path: str) -> io.Gaussians:
    """Reads a .ply, .splat, .spz or .glb. Raises TrainerError naming file and reason."""
    ending = os.path.splitext(path)[1].lower()
    try:
        if ending not in READERS:
            return io.read_gaussians(path)
        with open(path, "rb") as file:
            return READERS[ending](file.read())
    except OSError as error:
        raise TrainerError(f"{path}: {error.strerror or error}") from error
    except TrainerError:
        raise
    except ValueError as error:
        text = f"{path}: {error}" if ending in READERS else str(error)
        if "this is no PLY file" in text and ending != ".ply":
            text = f"{path}: it is none of .ply, .splat, .spz and .glb"
        other = ("; it is compressed, as SuperSplat does: let that write a .ply that is not"
                 if "packed_position" in text else
                 "; it is not a model of Gaussians, as `dsmoe train` and other 3DGS programs write it"
                 if "no scalar property" in text or "no element" in text else "")
        raise TrainerError(text + other) from error


def recorded_of(path: str, stored: io.Gaussians) -> Recorded:
    """What a file says of its blend, else the cfg_args of the 3DGS model folder that it lies in.

    Raises TrainerError for a comment on `faint_below`, and for values of cfg_args, that no training has.
    """
    said = [line.partition(" ")[2] for line in stored.comments if line.startswith(FAINT_BELOW + " ")]
    try:
        faint = resolve_faint_below("smoe", float(said[-1])) if said else None
    except ValueError as error:
        raise TrainerError(f"{path}: its comment records {FAINT_BELOW} {said[-1]!r}; it must be a number of at least 0"
                           ) from error
    recorded = Recorded(stored.blend_mode, stored.background_gate, faint)
    return recorded if any(said is not None for said in recorded) else _recorded_of_folder(path)


def _recorded_of_folder(path: str) -> Recorded:
    """The blend in the cfg_args of the 3DGS model folder that a file lies in, as `dsmoe patch` has it there.

    Raises TrainerError.
    """
    place = os.path.dirname(os.path.abspath(path))
    if os.path.basename(os.path.dirname(place)) != FOLDER:
        return Recorded(None, None)
    folder = os.path.dirname(os.path.dirname(place))
    known = cfg_args_of(folder)
    mode, gate, faint = (known.get(name) for name in PAPER_PROGRAM)
    if mode == PAPER:
        mode, gate, faint = PAPER_PROGRAM.values()
    if mode not in BLEND_MODES:
        return Recorded(None, None)
    if mode not in GATED_MODES:
        return Recorded(mode, None)
    if gate == "":
        gate = LEARNED if mode == "smoe" else None  # the defaults of a training there
    try:
        return Recorded(mode, gate if gate in (None, LEARNED) else float(resolve_background_gate(mode, float(gate))),
                        None if faint is None else resolve_faint_below(mode, faint))
    except (TypeError, ValueError) as error:
        raise TrainerError(f"{os.path.join(folder, CFG_ARGS)}: of the blend {mode} it records the background gate "
                           f"{gate!r} and faint_below {faint!r}; both must be numbers of at least 0") from error


def agreed_blend_mode(path: str, recorded: Optional[str], asked: Optional[str]) -> str:
    """The blend mode to render a file with: the recorded one, else the one asked for, else alpha, which a line says.

    Raises TrainerError if both disagree, or the recorded one is unknown.
    """
    if recorded is not None and recorded not in BLEND_MODES:
        raise TrainerError(f"{path}: its comment records the blend mode {recorded!r}; this version knows "
                           f"{', '.join(BLEND_MODES)}")
    if recorded is None and asked is None:
        print(f"note: {printable(path)} records no blend mode, so it is alpha, as other 3DGS programs blend; "
              "--blend-mode says otherwise", file=sys.stderr)
        return "alpha"
    if recorded is not None and asked is not None and asked != recorded:
        raise TrainerError(f"{path} was trained with the blend mode {recorded}, not {asked}; "
                           "in another mode its Gaussians show another scene")
    return recorded or asked or ""


def agreed_background_gate(path: str, blend_mode: str, recorded: Recorded, asked: Optional[float]) -> float:
    """The background gate to render a file with in this blend mode: by the rules of `agreed_blend_mode`.

    A file that records a mode and no gate was trained with 0. Of a gate that was learned the value must be given.
    Raises TrainerError.
    """
    if blend_mode not in GATED_MODES:
        fixed = float(resolve_background_gate(blend_mode, None))
        for said in (recorded.background_gate, asked):
            if said not in (None, fixed):
                raise TrainerError(f"{path}: the background gate is {said!r}; in the blend mode {blend_mode} it is "
                                   f"{fixed:g}")
        return fixed
    gate = recorded.background_gate
    if gate == LEARNED:
        if asked is None:
            raise TrainerError(f"{path} records no blend, and its folder's cfg_args says {blend_mode} with a learned "
                               f"background gate, but not its value; declare it: `dsmoe export {typed(path)} "
                               f"--blend-mode {blend_mode} --background-gate X -o declared.ply`")
        gate = asked
    elif gate is None and recorded.blend_mode is not None:
        gate = 0.0
    if gate is not None and asked is not None and asked != gate:
        raise TrainerError(f"{path} was trained with the background gate {gate!r}, not {asked!r}; "
                           "with another one its Gaussians show another scene")
    if gate is None and asked is None:
        raise TrainerError(f"{path} does not say which background gate it was trained with; pass "
                           "--background-gate, which is 0 for the paper's Eq. 7, or --paper for a model of its "
                           "authors' program")
    try:
        return float(resolve_background_gate(blend_mode, asked if gate is None else gate))
    except ValueError as error:
        raise TrainerError(str(error)) from error


def agreed_faint_below(path: str, blend_mode: str, recorded: Recorded, asked: Optional[float]) -> Optional[float]:
    """The `faint_below` to render a file with, None as usual: by the rules of `agreed_blend_mode`."""
    known = trained_faint_below(blend_mode, recorded.faint_below)
    if asked in (None, known):
        return recorded.faint_below
    if recorded.blend_mode is not None or recorded.faint_below is not None or blend_mode not in GATED_MODES:
        raise TrainerError(f"{path}: in the blend mode {blend_mode} its faint_below is {known!r}, not {asked!r}")
    try:
        return resolve_faint_below(blend_mode, asked)
    except ValueError as error:
        raise TrainerError(str(error)) from error
