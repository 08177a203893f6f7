"""What cells need before they can run: scenes that are there or made up, checkouts that are there and patched."""
from __future__ import annotations

import hashlib
import os
import shutil
from typing import Any, Dict, List

from ... import patches
from ...trainer.scenes.synthetic import write_synthetic_scene
from ...trainer.system.files import write_json_atomically
from ..errors import BenchError
from .expansion import NOT_IN_THE_IDENTITY
from .names import CHECKOUTS, NATIVE
from .protocol import commit_of
from .rows import read_object

NOT_COPIED = shutil.ignore_patterns(".git", "__pycache__", "output", "outputs", "build")


def what_is_missing(cells: List[Dict[str, Any]]) -> List[str]:
    """What these cells need and is not there: variables, folders of scenes and of checkouts; and what to do."""
    scenes = {cell["scene"]["name"]: cell["scene"] for cell in cells}
    methods = {cell["method"]["label"]: cell["method"] for cell in cells}
    absent = [f"{part['unset']}; set it" for part in (*scenes.values(), *methods.values()) if "unset" in part]
    absent += [f"scene {name}: {scene['path']}: no such folder; name it" for name, scene in scenes.items()
               if scene["path"] is not None and is_missing(scene, "path")]
    return absent + [f"method {label}: {key}: {method[key]}: no such folder, where {wanted}; name it"
                     for label, method in methods.items() for key, wanted in wanted_checkouts(method).items()
                     if is_missing(method, key)]


def is_missing(part: Dict[str, Any], key: str) -> bool:
    """Whether a path of a scene or a method is no folder; one with a variable that is not set is no path yet."""
    return "unset" not in part and not os.path.isdir(part[key])


def wanted_checkouts(method: Dict[str, Any]) -> Dict[str, str]:
    """The fields of a method that name checkouts, and what is wanted there, in words."""
    wanted = {"path": f"a checkout of {method['name']} must be",
              "base": f"the 3DGS checkout must be that trains what {method['name']} compresses"}
    return {key: words for key, words in wanted.items() if key in method}


def given(cell: Dict[str, Any]) -> Dict[str, Any]:
    """Where things lie, as the suite says it; a path that has changed changes no figure."""
    return {part: {key: cell[part][key] for key in NOT_IN_THE_IDENTITY if key in cell[part]}
            for part in ("scene", "method")}


def made_scene(scene: Dict[str, Any], results: str) -> Dict[str, Any]:
    """The scene with its path; a synthetic one is made where it is not there yet, or was made otherwise."""
    if scene["path"] is not None:
        return scene
    folder = os.path.join(results, "scenes", scene["name"])
    record = os.path.join(folder, "synthetic.json")  # written last
    if read_object(record) != scene["synthetic"]:
        shutil.rmtree(folder, ignore_errors=True)
        write_synthetic_scene(folder, **scene["synthetic"])
        write_json_atomically(record, scene["synthetic"])
    return dict(scene, path=folder)


def prepared_method(method: Dict[str, Any], results: str) -> Dict[str, Any]:
    """The method with its checkouts as they are run: patched ones are copies in RESULTS/checkouts.

    Where a checkout cannot be used, `refused` says why: that is what its cells' rows will say.
    """
    if method["name"] == NATIVE:
        return method
    try:
        paths = {key: prepared_checkout(method, key, results) for key in wanted_checkouts(method)}
    except (patches.PatchError, BenchError, OSError) as error:
        return {**method, "refused": " ".join(str(error).split())}
    commits = {"path": "commit", "base": "base_commit"}  # of what is copied, not of a copy
    return {**method, **paths, **{commits[key]: commit_of(method[key]) or method.get(commits[key]) for key in paths}}


def prepared_checkout(method: Dict[str, Any], key: str, results: str) -> str:
    """The folder of a checkout as it is run. Raises BenchError or PatchError."""
    path = method[key]
    if not CHECKOUTS[method["name"]]:
        return path
    found = patches.inspect(path, fuse=True)
    is_patched = found.verdict == "patched"
    is_fused = any(set(rule.files) - set(rule.pending) for rule in found.requested if rule.option == "fuse")
    if method["variant"] == "unpatched" and found.verdict != "patchable":
        raise BenchError(f"{path} is {found.verdict}, and the suite says it is an unpatched checkout (`dsmoe patch "
                         "revert` takes a patch back)")
    if method["variant"] == "patched" and is_patched and is_fused:
        raise BenchError(f"{path} is patched with --fuse, which the suite calls `variant: fused`")
    if method["variant"] == "unpatched" or (is_patched and is_fused == (method["variant"] == "fused")):
        return path
    folder = os.path.join(results, "checkouts", f"{method['label']}-{key}")
    return patched_copy(path, folder, fuse=method["variant"] == "fused")


def patched_copy(path: str, folder: str, fuse: bool) -> str:
    """A patched copy of a checkout, which itself stays as it is; made anew where it has changed. Raises PatchError."""
    record, now = folder + ".json", {"files": state_of_files(path)}
    if not os.path.isdir(folder) or read_object(record) != now:
        if os.path.isfile(record):  # removed first, and written once the copy is complete
            os.remove(record)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(path, folder, ignore=NOT_COPIED)
        write_json_atomically(record, now)
    patches.apply(folder, modernise=True, fuse=fuse)  # what an interruption left is finished; else nothing is done
    return folder


def state_of_files(path: str) -> str:
    """A checksum of the names, sizes and times of the files of a checkout that are copied.

    Of a commit that moves no file it says nothing, of an edit that is not committed it does.
    """
    checksum = hashlib.sha256()
    for folder, folders, names in os.walk(path, followlinks=True):
        left_out = NOT_COPIED(folder, [*folders, *names])
        folders[:] = sorted(set(folders) - left_out)
        for name in sorted(set(names) - left_out):
            file = os.path.join(folder, name)
            state = os.stat(file)
            checksum.update(os.fsencode(f"{os.path.relpath(file, path)}\0{state.st_size}\0{state.st_mtime_ns}\n"))
    return checksum.hexdigest()
