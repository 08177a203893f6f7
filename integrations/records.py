"""Blend mode and background gate in the files of a trainer: what is saved records them, what is read brings the gate.

`keep()` wraps, in this process, the functions by which public trainers save and read models. A .ply of Gaussians gets
the comments of `dsmoe train`, by which `dsmoe eval`, `export` and `view` know them. An archive of torch.save or
numpy.savez gets a comment behind its end (a zip file's), which no other reader looks at. No content changes.
"""
from __future__ import annotations

import functools
import importlib
import importlib.util
import json
import os
import struct
import sys
import warnings
from typing import Any, Callable, Dict, Optional, Sequence

import numpy
import torch

from diff_smoe_rasterization import settings
from diff_smoe_rasterization.learned_gate import START, gate

__all__ = ["keep"]

PROGRAM = "diff_smoe_rasterization"
END, SIGNATURE = 22, b"PK\x05\x06"  # bytes of a zip file's last record without a comment, and its first four
LONGEST = 65535  # bytes of such a comment
_kept = False


def keep() -> None:
    """From now on files of this process record mode and gate of its renderings, and bring a learned gate.

    That is for PlyData of plyfile, torch.save and torch.load, numpy.savez, savez_compressed and load, called with a
    path. Nothing is recorded in modes without a background gate.
    """
    global _kept
    if _kept:
        return
    _kept = True
    _wrap(torch, "save", after=lambda _, obj, f=None, *more, **named: _record(f))
    _wrap(torch, "load", after=lambda loaded, f=None, *more, **named: _take(f, _is_checkpoint(loaded)))
    for name in ("savez", "savez_compressed"):
        _wrap(numpy, name, after=lambda _, file=None, *more, **named: _record(_as_npz(file)))
    _wrap(numpy, "load", after=lambda loaded, file=None, *more, **named: _take(
        file, any("opacit" in name for name in getattr(loaded, "files", ()))))
    if importlib.util.find_spec("plyfile"):
        PlyData = importlib.import_module("plyfile").PlyData  # the trainer has it: this package does not need it
        _wrap(PlyData, "write", before=_record_ply)
        read = PlyData.read
        PlyData.read = staticmethod(functools.wraps(read)(lambda *of, **named: _take_ply(read(*of, **named), of)))


def _wrap(owner: Any, name: str, before: Optional[Callable[..., None]] = None,
          after: Optional[Callable[..., None]] = None) -> None:
    function = getattr(owner, name)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        if before:
            before(*arguments, **named)
        result = function(*arguments, **named)
        if after:
            after(result, *arguments, **named)
        return result

    setattr(owner, name, call)


def recorded() -> Dict[str, Any]:
    """Returns blend_mode and background_gate of this process, and an unusual faint_below; {} in ungated modes."""
    mode, background_gate = (settings.blend_of_process or (settings.resolve_blend_mode(None), None))[:2]
    if gate.blend_mode:
        mode, background_gate = gate.blend_mode, settings.LEARNED
    if mode not in settings.GATED_MODES:
        return {}
    background_gate = settings.resolve_background_gate(mode, background_gate)
    is_learned = isinstance(background_gate, str)
    if is_learned and not (gate.blend_mode and gate.is_known):
        return {}  # nothing was rendered with it
    faint = settings.resolve_faint_below(mode, None)
    return {"blend_mode": mode, "background_gate": gate.value() if is_learned else background_gate,
            **({} if faint == settings.usual_faint_below(mode) else {"faint_below": faint}),
            **({"learned": gate.state_dict()} if is_learned and not gate.frozen else {})}


def _is_path(file: Any) -> bool:
    return isinstance(file, (str, os.PathLike))


def _as_npz(file: Any) -> Any:
    return f"{os.fspath(file)}.npz" if _is_path(file) and not os.fspath(file).endswith(".npz") else file


def _record(file: Any) -> None:
    """Writes the comment of a zip file that has none."""
    record = recorded() if _is_path(file) else {}
    if not record:
        return
    comment = f"{PROGRAM} {json.dumps(record)}".encode()
    with open(file, "r+b") as archive:
        archive.seek(0, os.SEEK_END)
        if archive.tell() < END:
            return
        archive.seek(-END, os.SEEK_END)
        end = archive.read()
        if end[:4] == SIGNATURE and end[-2:] == b"\0\0":  # else it is of torch's older format
            archive.seek(-2, os.SEEK_END)
            archive.write(struct.pack("<H", len(comment)) + comment)  # one write: no kill leaves half of it


def _take(file: Any, is_model: bool) -> None:
    """Takes the gate that a zip file's comment records."""
    if not _is_path(file) or not os.path.isfile(file):
        return
    with open(file, "rb") as archive:
        archive.seek(-min(os.path.getsize(file), LONGEST + END), os.SEEK_END)
        _, there, comment = archive.read().rpartition(SIGNATURE)[2][END - 4:].partition(f"{PROGRAM} ".encode())
    found = None
    if there:
        try:
            found = json.loads(comment)
        except ValueError:
            pass
    _found(file, found, is_model)


def _record_ply(ply: Any, *_: Any, **__: Any) -> None:
    if not _has_gaussians(ply):
        return
    ours = ("blend_mode ", "background_gate ", "faint_below ")
    record = recorded()
    if record:
        ply.comments = [line for line in ply.comments if not line.startswith(ours)] + [
            f"{name}{record[name.strip()]}" for name in ours if name.strip() in record]


def _take_ply(ply: Any, arguments: Sequence[Any]) -> Any:
    said = dict(line.partition(" ")[::2] for line in ply.comments)
    found = None
    try:
        found = {"blend_mode": said["blend_mode"], "background_gate": float(said["background_gate"])}
    except (KeyError, ValueError):
        pass
    _found(arguments[0] if arguments else "the .ply", found, _has_gaussians(ply))
    return ply


def _has_gaussians(ply: Any) -> bool:
    names = {one.name for element in ply.elements for one in element.properties}
    return {"opacity", "scale_0", "rot_0"} <= names


def _is_checkpoint(loaded: Any) -> bool:
    """Whether it has the form of a training's: 3DGS's pair with the iteration, or what gsplat and nerfstudio save."""
    if isinstance(loaded, dict):
        return not {"splats", "pipeline"}.isdisjoint(loaded)
    return isinstance(loaded, tuple) and len(loaded) == 2 and isinstance(loaded[1], int)


def _found(file: Any, record: Optional[Dict[str, Any]], is_model: bool) -> None:
    """Gives the learned gate what a file records. A model without a record: 0, and a warning.

    While the gate is learned, only a model brings another: other files of the training record it too.
    """
    mode, background_gate = (settings.blend_of_process or (settings.resolve_blend_mode(None), None))[:2]
    name = file if _is_path(file) else "the model"
    if record and (is_model or not gate.learns):
        gate.found(float(record["background_gate"]), record.get("learned"))
        print(f"{PROGRAM}: {name} records the background gate {gate.value():.6g}", file=sys.stderr, flush=True)
    elif not record and is_model and not gate.learns and mode in settings.GATED_MODES and isinstance(
            settings.resolve_background_gate(mode, background_gate), str):
        gate.found(0.0)
        warnings.warn(f"{PROGRAM}: {name} records no background gate, so it is 0 where nothing is learned, and "
                      f"learning starts at {START}; --background_gate says otherwise", stacklevel=4)
