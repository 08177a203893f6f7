"""What cells need before they can run: scenes that are there or made up, checkouts that are there and patched."""
from __future__ import annotations

import os
import shutil
from typing import Any, Dict, List

from .. import patches
from ..trainer.synthetic import write_synthetic_scene
from .errors import BenchError
from .methods.names import CHECKOUTS, NATIVE
from .protocol import commit_of
from .suite import NOT_IN_THE_IDENTITY

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
    """The scene with its path; a synthetic one is made where it is not there yet."""
    if scene["path"] is not None:
        return scene
    folder = os.path.join(results, "scenes", scene["name"])
    if not os.path.isfile(os.path.join(folder, "sparse", "0", "cameras.txt")):
        write_synthetic_scene(folder, **scene["synthetic"])
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
    return {**method, **paths, "commit": commit_of(method["path"]) or method.get("commit")}


def prepared_checkout(method: Dict[str, Any], key: str, results: str) -> str:
    """The folder of a checkout as it is run. Raises BenchError or PatchError."""
    path = method[key]
    if not CHECKOUTS[method["name"]]:
        return path
    found = patches.inspect(path)
    is_patched, is_fused = found.verdict == "patched", "fuse" in found.options
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
    """A patched copy of a checkout, which itself stays as it is; made once. Raises PatchError."""
    if os.path.isdir(folder):
        patches.apply(folder, modernise=True, fuse=fuse)  # what an interruption left is finished; else nothing is done
        return folder
    part = folder + ".part"
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(path, part, ignore=NOT_COPIED)
    patches.apply(part, modernise=True, fuse=fuse)
    os.rename(part, folder)
    return folder
