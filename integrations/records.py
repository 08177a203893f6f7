"""Blend mode and background gate in the files of a trainer: what is saved records them, what is read brings the gate.

`keep()` wraps, in this process, the functions by which public trainers save and read models. A .ply of Gaussians gets
the comments of `dsmoe train`, by which `dsmoe eval`, `export` and `view` know them. An archive of torch.save or
numpy.savez gets a comment behind its end (a zip file's), which no other reader looks at. No content changes.
"""
from __future__ import annotations

import contextlib
import functools
import glob
import importlib
import importlib.util
import json
import os
import shutil
import stat
import struct
import sys
import tempfile
import time
from typing import Any, Callable, Dict, Iterator, NamedTuple, Optional, Set, Tuple

import numpy
import torch

from diff_smoe_rasterization import settings
from diff_smoe_rasterization.learned_gate import LIMIT, START, gate

__all__ = ["keep"]

PROGRAM = "diff_smoe_rasterization"
END, SIGNATURE = 22, b"PK\x05\x06"  # bytes of a zip file's last record without a comment, and its first four
LONGEST = 65535  # bytes of such a comment
PART = ".dsmoe_part-"  # begins the name of a folder with a file that is not whole yet; a random name follows
ABANDONED = 6 * 3600  # seconds in which no process, of this host or another, is at one file
DAMAGE = (ValueError, OverflowError, RecursionError, OSError)
_kept = False
_told: Set[str] = set()
_models_read: Dict[str, Record] = {}  # by the file's name, the latest one last


class Record(NamedTuple):
    """What a file says of the blend of the process that wrote it."""

    blend_mode: str
    background_gate: Any = None  # None in modes that know none; of a process also LEARNED
    faint_below: Optional[float] = None  # None: as usual in this mode
    learned: Optional[Dict[str, Any]] = None  # state_dict of a gate that was still learned


def keep() -> None:
    """From now on files of this process record mode and gate of its renderings, and bring a learned gate.

    That is for PlyData of plyfile, torch.save and torch.load, numpy.savez, savez_compressed and load, called with a
    path. In `alpha` nothing is recorded: a file without a record counts as one of `alpha`.
    """
    global _kept
    if _kept:
        return
    _kept = True
    _wrap_save(torch, "save", 1, "f")
    _wrap_load(torch, "load", "f", _is_checkpoint)
    for name in ("savez", "savez_compressed"):
        _wrap_save(numpy, name, 0, "file", ending=".npz")
    _wrap_load(numpy, "load", "file", lambda loaded: any("opacit" in name for name in getattr(loaded, "files", ())))
    if importlib.util.find_spec("plyfile"):
        PlyData = importlib.import_module("plyfile").PlyData  # the trainer has it: this package does not need it
        write, read = PlyData.write, PlyData.read
        PlyData.write = functools.wraps(write)(lambda ply, *to, **named: write(_with_record(ply), *to, **named))
        PlyData.read = staticmethod(functools.wraps(read)(lambda *of, **named: _take_ply(read(*of, **named), of)))


def _wrap_save(owner: Any, name: str, place: int, keyword: str, ending: str = "") -> None:
    """place, keyword: of the argument that names the file. ending: what the function appends to the name."""
    function = getattr(owner, name)

    @functools.wraps(function)
    def save(*arguments: Any, **named: Any) -> Any:
        file = named.get(keyword, arguments[place] if place < len(arguments) else None)
        with _recorded(_with_ending(file, ending)) as written:
            if keyword in named:
                named[keyword] = written
            elif place < len(arguments):
                arguments = (*arguments[:place], written, *arguments[place + 1:])
            return function(*arguments, **named)

    setattr(owner, name, save)


def _wrap_load(owner: Any, name: str, keyword: str, is_model: Callable[[Any], bool]) -> None:
    function = getattr(owner, name)

    @functools.wraps(function)
    def load(*arguments: Any, **named: Any) -> Any:
        loaded = function(*arguments, **named)
        file = named.get(keyword, arguments[0] if arguments else None)
        if _is_path(file) and os.path.isfile(file):
            _take(file, lambda: _comment_of(file), is_model(loaded))
        return loaded

    setattr(owner, name, load)


def recorded() -> Dict[str, Any]:
    """Returns what files of this process record; {} in `alpha`, and where a learned gate is not known yet.

    A process that renders nothing, such as one that merges models, records what the models record that it has read.
    """
    own = blend_of_process()
    if _models_read and not gate.renders and (own is None or own.background_gate == settings.LEARNED):
        own = _of_models_read()
    if not own or own.blend_mode == "alpha":
        return {}
    if own.background_gate == settings.LEARNED:
        if not (gate.blend_mode and gate.is_known):
            return {}  # nothing was rendered with it
        own = own._replace(background_gate=gate.value(), learned=None if gate.frozen else gate.state_dict())
    return {name: value for name, value in own._asdict().items() if value is not None}


def _of_models_read() -> Record:
    """Returns the record of the model that was read last, and says so if another one differs."""
    *_, last = _models_read.values()
    if any(record[:3] != last[:3] for record in _models_read.values()):
        found = "; ".join(f"{name}: {_said_of(record)}" for name, record in _models_read.items())
        _warn("what this process saves", f"the models that it has read differ ({found}), and it records the last one's "
                                         "blend; options say another")
    return last


def blend_of_process() -> Optional[Record]:
    """Returns how this process blends.

    None if only the settings of its renderings say it, and none with a learned gate was there yet.
    """
    mode, background_gate = (settings.blend_of_process or (os.environ.get(settings.BLEND_MODE_VARIABLE), None))[:2]
    if gate.blend_mode:
        mode, background_gate = gate.blend_mode, settings.LEARNED
    if not mode:
        return None
    if mode == settings.PAPER:  # of the variable, before the trainer's options are read
        return Record(**settings.PAPER_PROGRAM)  # type: ignore[arg-type]
    mode = settings.resolve_blend_mode(mode)
    if mode not in settings.GATED_MODES:
        return Record(mode)
    faint = settings.resolve_faint_below(mode, None)
    return Record(mode, settings.resolve_background_gate(mode, background_gate),
                  None if faint == settings.usual_faint_below(mode) else faint)


def _is_path(file: Any) -> bool:
    return isinstance(file, (str, os.PathLike)) and isinstance(os.fspath(file), str)


def _with_ending(file: Any, ending: str) -> Any:
    return f"{os.fspath(file)}{ending}" if _is_path(file) and not os.fspath(file).endswith(ending) else file


@contextlib.contextmanager
def _recorded(file: Any) -> Iterator[Any]:
    """Gives what to write in place of a file: one of its name beside it, which becomes it with its comment.

    So a kill leaves a whole file with its record, or the one of before. Where that cannot be, as in a folder that must
    not be written, the file itself gets its comment once it is written. A pipe or a device gets none.
    """
    record = recorded() if _is_path(file) else {}
    if not record:
        yield file
        return
    comment, target = f"{PROGRAM} {json.dumps(record)}".encode(), os.path.realpath(file)
    folder = _folder_beside(target)
    if not folder:
        yield file
        if os.path.isfile(target):
            _put_comment(target, comment)
        return
    try:
        beside = os.path.join(folder, os.path.basename(file))  # torch writes the name into the archive
        yield beside
        _put_comment(beside, comment)
        with contextlib.suppress(FileNotFoundError):
            shutil.copymode(target, beside)
        os.replace(beside, target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _folder_beside(target: str) -> str:
    """Makes a folder beside a file; returns "" if that cannot be, or the file is none that can be replaced."""
    try:
        if os.path.exists(target) and not stat.S_ISREG(os.stat(target).st_mode):
            return ""
        where = os.path.dirname(target)
        for left in glob.glob(os.path.join(glob.escape(where), f"{PART}*")):
            with contextlib.suppress(OSError):
                there = os.lstat(left)  # a link is somebody else's
                if stat.S_ISDIR(there.st_mode) and time.time() - there.st_mtime > ABANDONED:  # its process was killed
                    shutil.rmtree(left, ignore_errors=True)
        return tempfile.mkdtemp(prefix=PART, dir=where)
    except OSError:
        return ""


def _put_comment(path: str, comment: bytes) -> None:
    """Writes the comment of a zip file that has none."""
    with open(path, "r+b") as archive:
        archive.seek(0, os.SEEK_END)
        if archive.tell() < END:
            return
        archive.seek(-END, os.SEEK_END)
        end = archive.read()
        if end[:4] == SIGNATURE and end[-2:] == b"\0\0":  # else it is of torch's older format
            archive.seek(-2, os.SEEK_END)
            archive.write(struct.pack("<H", len(comment)) + comment)


def _comment_of(path: Any) -> Any:
    """Returns what a zip file's comment records, None if it has none of this program. Raises one of DAMAGE."""
    with open(path, "rb") as archive:
        archive.seek(-min(os.path.getsize(path), LONGEST + END), os.SEEK_END)
        end = archive.read()
    comment = end[end.rfind(SIGNATURE):][END:] if SIGNATURE in end else b""
    begin = f"{PROGRAM} ".encode()
    return json.loads(comment[len(begin):]) if comment.startswith(begin) else None


def _with_record(ply: Any) -> Any:
    record = recorded() if _has_gaussians(ply) else {}
    if record:
        ply.comments = [line for line in ply.comments if line.split(" ")[0] not in Record._fields] + [
            f"{name} {value}" for name, value in record.items() if name != "learned"]
    return ply


def _take_ply(ply: Any, arguments: Tuple[Any, ...]) -> Any:
    said: Dict[str, Any] = dict(line.partition(" ")[::2] for line in ply.comments)
    said.pop("learned", None)
    for name in ("background_gate", "faint_below"):
        with contextlib.suppress(KeyError, ValueError):
            said[name] = float(said[name])
    _take(arguments[0] if arguments else "the .ply", lambda: said if "blend_mode" in said else None,
          _has_gaussians(ply))
    return ply


def _has_gaussians(ply: Any) -> bool:
    names = {one.name for element in ply.elements for one in element.properties}
    return {"opacity", "scale_0", "rot_0"} <= names


def _is_checkpoint(loaded: Any) -> bool:
    """Whether it has the form of a training's: 3DGS's pair with the iteration, or what gsplat and nerfstudio save."""
    if isinstance(loaded, dict):
        return not {"splats", "pipeline"}.isdisjoint(loaded)
    return isinstance(loaded, tuple) and len(loaded) == 2 and isinstance(loaded[1], int)


def checked(said: Any) -> Record:
    """Returns a record as a file has it. Raises ValueError, which says what is wrong with it."""
    if not isinstance(said, dict):
        raise ValueError(f"it is of type {type(said).__name__}")
    mode = said.get("blend_mode")
    if mode not in settings.BLEND_MODES:
        raise ValueError(f"the blend mode is {mode!r:.40}; this version knows {', '.join(settings.BLEND_MODES)}")
    if mode not in settings.GATED_MODES:
        return Record(mode)
    # A .ply that records a mode and no gate was trained with 0, as for `dsmoe render`.
    background_gate = _number("the background gate", said.get("background_gate", 0.0), 0, settings.MAX_BACKGROUND_GATE)
    faint, state = said.get("faint_below"), said.get("learned")
    if faint is not None:
        faint = _number("faint_below", faint, 0, settings.MAX_BACKGROUND_GATE)
    if state is not None:
        state = {"logarithm": _number("the gate's logarithm", state["logarithm"], -LIMIT - 1, LIMIT + 1),
                 "adam": _checked_adam(state["adam"])}
    return Record(mode, background_gate, faint, state)


def _checked_adam(adam: Any) -> Dict[str, Any]:
    if adam == {}:
        return {}
    return {"step": int(_number("the gate's step", adam["step"], 1, 2**53)),
            "exp_avg": _number("the gate's moment", adam["exp_avg"], -sys.float_info.max, sys.float_info.max),
            "exp_avg_sq": _number("the gate's square", adam["exp_avg_sq"], 0, sys.float_info.max)}


def _number(name: str, value: Any, least: float, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= most:
        raise ValueError(f"{name} is {value!r:.40}; it must be a number from {least:g} to {most:g}")
    return float(value)


def _take(file: Any, said: Callable[[], Any], is_model: bool) -> None:
    """Gives the learned gate what a file records, and says where that is not how this process blends.

    said: returns what the file records, None for nothing, or raises one of DAMAGE. While the gate is learned, only a
    model brings another: other files of the training record it too.
    """
    if gate.learns and not is_model:
        return
    name, own = str(file) if _is_path(file) else "the model", blend_of_process()
    record, damage = None, ""
    try:
        found = said()
        record = None if found is None else checked(found)
    except (KeyError, TypeError, *DAMAGE) as error:
        damage = f"its record of mode and gate is damaged ({type(error).__name__}: {error})"
    if record and is_model:
        _models_read.pop(name, None)
        _models_read[name] = record
    if own is None:  # its settings say it
        own = record._replace(background_gate=settings.LEARNED) if record else Record("alpha")
    is_learned, same_mode = own.background_gate == settings.LEARNED, record and record.blend_mode == own.blend_mode
    if damage:
        _warn(name, f"{damage}; it counts as a file without one")
    if record and same_mode and is_learned and record.background_gate is not None:
        gate.found(record.background_gate, record.learned)
        print(f"{PROGRAM}: {name} records the background gate {gate.value():.6g}", file=sys.stderr, flush=True)
    elif is_learned and is_model and not gate.learns:
        gate.found(0.0)
    if record:
        differs = [one for one, mine in zip(record[:3], own) if one != mine and mine != settings.LEARNED]
        another = "" if same_mode else ", in which its Gaussians show another scene"
        if differs:
            _warn(name, f"it is of {_said_of(record)}, and this process blends by {_said_of(own)}{another}; "
                        f"{_options_of(record)} is as it was")
    elif is_model and own.blend_mode != "alpha" and not gate.learns:
        learned = (f". The gate is 0 where nothing is learned, and learning starts at {START}; --background_gate says "
                   "otherwise" if is_learned else "")
        _warn(name, "it records no blend mode, as a file of alpha, and this process blends by "
                    f"{_said_of(own)}{learned}")


def _said_of(blend: Record) -> str:
    """Returns "smoe, background gate 0.3, faint_below 2"."""
    values = zip(("background gate", "faint_below"), blend[1:3])
    return ", ".join([blend.blend_mode, *(f"{name} {value}" for name, value in values if value is not None)])


def _options_of(blend: Record) -> str:
    """Returns what is typed for a blend; `faint_below` has only a variable everywhere."""
    values = zip((f"${settings.FAINT_BELOW_VARIABLE}=", "--blend_mode ", "--background_gate "),
                 (blend.faint_below, *blend[:2]))
    return " ".join(f"{name}{value}".lstrip("$") for name, value in values if value is not None)


def _warn(name: str, text: str) -> None:
    """Says once what is wrong, by no `warnings`: trainers such as Scaffold-GS switch these off."""
    if text not in _told:
        _told.add(text)
        print(f"{PROGRAM}: warning: {name}: {text}", file=sys.stderr, flush=True)
