"""What cells need before they can run: scenes that are there or made up, checkouts that are there and patched."""
from __future__ import annotations

import os
import shutil
from typing import Any, Dict, List, Tuple

from .. import patches
from ..system.files import write_json_atomically
from .errors import BenchError
from .names import CHECKOUTS, NATIVE
from .protocol import commit_of
from .rows import read_object

Cells = List[Dict[str, Any]]
# The fields of a method that name checkouts, and what is wanted there, in words.
CHECKOUT_FIELDS = {"path": "a checkout of {} must be",
                   "base": "the 3DGS checkout must be that trains what {} compresses"}
NOT_COPIED = shutil.ignore_patterns(".git", "__pycache__", "output", "outputs", "build")


def what_is_missing(cells: List[Dict[str, Any]]) -> List[str]:
    """The scenes, and the checkouts, that some of these cells need and that are not there, in words."""
    scenes = {cell["scene"]["name"]: cell["scene"] for cell in cells}
    methods = {cell["method"]["label"]: cell["method"] for cell in cells}
    found = [_missing(scene, "path", f"scene {name}") for name, scene in scenes.items() if scene["path"] is not None]
    found += [_missing_checkout(method) for method in methods.values()]
    return list(dict.fromkeys(filter(None, found)))


def without_absent_checkouts(cells: Cells, to_do: Cells) -> Tuple[Cells, Cells, List[str]]:
    """Both without the cells to do whose checkout is not there, if others remain; and in words what is left out."""
    absent = {cell["method"]["label"]: _missing_checkout(cell["method"]) for cell in to_do}
    gone = {label for label, words in absent.items() if words}
    if len(gone) == len({cell["method"]["label"] for cell in cells}):
        return cells, to_do, []
    kept = [cell for cell in to_do if cell["method"]["label"] not in gone]
    out = [cell["id"] for cell in to_do if cell["method"]["label"] in gone]
    return ([cell for cell in cells if cell["id"] not in out], kept,
            [f"left out: {absent[label]}" for label in sorted(gone)])


def _missing_checkout(method: Dict[str, Any]) -> str:
    found = (_missing(method, key, f"method {method['label']}: {key}", f", where {text.format(method['name'])}")
             for key, text in CHECKOUT_FIELDS.items() if key in method)
    return next(filter(None, found), "")


def _missing(part: Dict[str, Any], key: str, what: str, where: str = "") -> str:
    if "unset" in part:
        return f"{part['unset']}; set it"
    return "" if os.path.isdir(part[key]) else f"{what}: {part[key]}: no such folder{where}; name it"


def made_scene(scene: Dict[str, Any], results: str) -> Dict[str, Any]:
    """The scene with its path; a synthetic one is made if it is not there yet, or was made otherwise."""
    if scene["path"] is not None:
        return scene
    from ..scenes.synthetic import write_synthetic_scene  # it loads torch

    folder = os.path.join(results, "scenes", scene["name"])
    record = os.path.join(folder, "synthetic.json")  # written last
    if read_object(record) != scene["synthetic"]:
        shutil.rmtree(folder, ignore_errors=True)
        write_synthetic_scene(folder, **scene["synthetic"])
        write_json_atomically(record, scene["synthetic"])
    return dict(scene, path=folder)


def prepared_method(method: Dict[str, Any], results: str) -> Dict[str, Any]:
    """The method with its checkouts as they are run; `refused` says why they cannot be, as its cells' rows will."""
    if method["name"] == NATIVE:
        return method
    try:
        paths = {key: prepared_checkout(method, key, results) for key in CHECKOUT_FIELDS if key in method}
    except (patches.PatchError, BenchError, OSError) as error:
        return {**method, "refused": " ".join(str(error).split())}
    commits = {"path": "commit", "base": "base_commit"}  # of what is copied, not of a copy
    return {**method, **paths, **{commits[key]: commit_of(method[key]) or method.get(commits[key]) for key in paths}}


def prepared_checkout(method: Dict[str, Any], key: str, results: str) -> str:
    path = method[key]
    if not CHECKOUTS[method["name"]]:
        return path
    found = patches.check(path)
    is_patched, is_fused = found.state == "patched", "fuse" in found.applied
    if method["variant"] == "unpatched" and found.state != "patchable":
        raise BenchError(f"{path} is {found.state}, and the suite says it is an unpatched checkout (`dsmoe patch "
                         "revert` takes a patch back)")
    if method["variant"] == "patched" and is_patched and is_fused:
        raise BenchError(f"{path} is patched with --fuse, which the suite calls `variant: fused`")
    if method["variant"] == "unpatched" or (is_patched and is_fused == (method["variant"] == "fused")):
        return path
    # A patched copy, made anew; the checkout itself stays as it is.
    folder = os.path.join(results, "checkouts", f"{method['label']}-{key}")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(path, folder, ignore=NOT_COPIED)
    patches.apply(folder, modernise=True, fuse=method["variant"] == "fused")
    return folder
