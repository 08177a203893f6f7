"""Suites: a YAML file that says what is trained on what, checked and expanded to cells.

A cell is one training and its measurement, as plain values: the command of cell.py needs nothing else. What makes two
figures comparable stands once in a suite (`protocol`, and each scene's images), never in a method, so that a suite
cannot mix protocols; what would mix them nevertheless is refused here.
"""
from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
from dataclasses import dataclass
from typing import Any, Dict, List, Sequence, Tuple

import yaml

from ...settings import resolve_background_gate
from ...trainer.config import BATCHED, LEARNED
from ...trainer.errors import ConfigError
from ..errors import BenchError
from . import schema
from .names import CHECKOUTS, COUNTED_BY, LACKS, NATIVE, NEEDS, RECIPE, WITHOUT_SCHEDULE, blend_of
from .protocol import config_of

SHIPPED = os.path.join(os.path.dirname(os.path.abspath(__file__)), "shipped")
AXIS_OF = {axis: axis[:-1] for axis in ("blend_modes", "background_gates", "densify_grad_thresholds", "schedules",
                                        "seeds")}
# Where things lie changes no figure.
NOT_IN_THE_IDENTITY = ("path", "base", "python", "pythonpath", "commit", "base_commit", "unset")


@dataclass(frozen=True)
class Suite:
    """A checked suite."""

    name: str
    protocol: Dict[str, Any]
    scenes: List[Dict[str, Any]]
    methods: List[Dict[str, Any]]
    cells: List[Dict[str, Any]]


def find_suite(name: str) -> str:
    """The path of a suite: a file, or the name of one that is shipped. Raises BenchError."""
    if os.path.isfile(name):
        return name
    shipped = os.path.join(SHIPPED, name + ".yaml")
    if os.path.isfile(shipped):
        return shipped
    names = sorted(os.path.splitext(file)[0] for file in os.listdir(SHIPPED) if file.endswith(".yaml"))
    raise BenchError(f"{name}: no such file, and no suite that is shipped ({', '.join(names)})")


def load_suite(path: str) -> Suite:
    """Reads, checks and expands a suite. Raises BenchError naming the file, the field and what it must be."""
    content = read_yaml(path)
    try:
        return expand(content, os.path.dirname(os.path.abspath(path)))
    except BenchError as error:
        raise BenchError(f"{path}: {error}") from error


def expand(content: Any, folder: str) -> Suite:
    """A suite from what its file says; relative paths are taken from `folder`. Raises BenchError."""
    content = with_scenes_of_a_file(content, folder)
    schema.check(content)
    content = {**schema.defaults(schema.Axes), **schema.defaults(schema.SuiteFile), **content}
    protocol = {**schema.defaults(schema.Protocol), **(content["protocol"] or {})}
    protocol = {name: value for name, value in protocol.items() if value is not None}
    scenes = [_scene({**schema.defaults(schema.Scene), "background": protocol["background"], **scene}, scene,
                     f"scenes[{index}]", folder) for index, scene in enumerate(content["scenes"])]
    methods = [_method(method, f"methods[{index}]", protocol, folder)
               for index, method in enumerate(content["methods"])]
    for field, key, items in (("scenes", "name", scenes), ("methods", "label", methods)):
        names = [item[key] for item in items]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise BenchError(f"{field}[{index}].{key}: {name!r} is there already")
    _one_downscaler(scenes)
    cells: List[Dict[str, Any]] = []
    for scene, method in itertools.product(scenes, methods):
        if method["name"] != NATIVE:
            _can_train(content, scene, method)
        _can_divide(content, protocol, scene, method)
        cells += _cells(content, protocol, scene, method)
    for cell in cells:
        try:
            config_of(cell)
        except (ConfigError, TypeError) as error:
            raise BenchError(f"cell {cell['id']}: {error}") from error
    return Suite(content["name"], protocol, scenes, methods, cells)


def with_scenes_of_a_file(content: Any, folder: str) -> Any:
    """The content with its list of scenes, where `scenes` names a file that has it. Raises BenchError."""
    if not isinstance(content, dict) or not isinstance(content.get("scenes"), str):
        return content
    path = os.path.join(folder, content["scenes"])
    if not os.path.isfile(path):
        raise BenchError(f"scenes: {path}: no such file")
    return {**content, "scenes": read_yaml(path)}


def read_yaml(path: str) -> Any:
    """What a YAML file says. Raises BenchError."""
    class Loader(yaml.SafeLoader):
        """Of a key that is there twice YAML keeps the last, without a word."""

        def compose_mapping_node(self, anchor: Any) -> Any:
            node = super().compose_mapping_node(anchor)
            keys = [key.value for key, _ in node.value]
            for index, (key, _) in enumerate(node.value):
                if key.value in keys[:index]:
                    raise yaml.MarkedYAMLError(problem=f"{key.value!r} is there twice", problem_mark=key.start_mark)
            return node

    # YAML 1.1, which PyYAML reads, takes 5e-3 for text.
    number = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, "-+0123456789")
    try:
        with open(path, encoding="utf-8") as file:
            return yaml.load(file, Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: no text, or a date that is none
        raise BenchError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from error


def _scene(scene: Dict[str, Any], given: Dict[str, Any], where: str, folder: str) -> Dict[str, Any]:
    """A scene with its defaults; under `axes` the axes that it has values of its own for."""
    if ("path" in given) == ("synthetic" in given):
        raise BenchError(f"{where}: give either `path` or `synthetic`")
    scene = {key: value for key, value in scene.items() if key not in AXIS_OF and (value, key) != (None, "synthetic")}
    paths = _paths({key: given[key] for key in ("path",) if key in given}, where, folder)
    return {**scene, **paths, "axes": {axis: given[axis] for axis in AXIS_OF if axis in given}}


def _method(method: Dict[str, Any], where: str, protocol: Dict[str, Any], folder: str) -> Dict[str, Any]:
    """The method with its defaults, and under `axes` the axes that it has values of its own for."""
    name = method["name"]
    given = {key: value for key, value in method.items() if key not in AXIS_OF}
    axes = {axis: method[axis] for axis in AXIS_OF if axis in method}
    if "budget" in given and name not in COUNTED_BY:
        raise BenchError(f"{where}.budget: is for {' and '.join(COUNTED_BY)}, which are given a number of primitives; "
                         f"{name} has densify_grad_thresholds")
    if name == NATIVE:
        wrong = [key for key in ("variant", "arguments", *NOT_IN_THE_IDENTITY)
                 if key in given and (key, given[key]) != ("variant", NATIVE)]
        if wrong:
            raise BenchError(f"{where}.{wrong[0]}: is for checkouts; the native trainer's recipe stands in "
                             "protocol.options")
        return {"label": NATIVE, "variant": "native", **given, "axes": axes}
    if "path" not in given:
        raise BenchError(f"{where}.path: is missing; it names the checkout's folder")
    if (name == "c3dgs") != ("base" in given):
        raise BenchError(f"{where}.base: c3dgs, and nothing else, needs it: a 3DGS checkout that trains what it "
                         "compresses")
    arguments = [str(word) for word in given.get("arguments", [])]
    _no_protocol_among(arguments, name, where)
    variant = given.setdefault("variant", "patched" if CHECKOUTS[name] else "unpatched")
    if variant == "native" or (variant != "unpatched" and not CHECKOUTS[name]):
        raise BenchError(f"{where}.variant: is {variant!r}; {name} can be "
                         + ("unpatched, patched or fused" if CHECKOUTS[name] else "unpatched only"))
    if variant == "unpatched":
        if axes.get("blend_modes", ["alpha"]) != ["alpha"]:
            raise BenchError(f"{where}.blend_modes: an unpatched checkout has its own blending alone, which is `alpha`")
        axes["blend_modes"] = ["alpha"]
    if name in NEEDS and NEEDS[name] not in arguments:
        raise BenchError(f"{where}.arguments: {name} needs {NEEDS[name]} N in place of a threshold")
    if "budget" in given:
        wanted = {COUNTED_BY[name]: str(given["budget"])}
        if name == "taming":
            wanted["--mode"] = "final_count"  # else its number is a multiple of that of the first points
        if not wanted.items() <= dict(zip(arguments, arguments[1:])).items():
            raise BenchError(f"{where}.budget: is {given['budget']}; {name} is told so by its arguments, among which "
                             f"must be {' '.join(itertools.chain(*wanted.items()))}")
    if name in WITHOUT_SCHEDULE:
        if "schedules" in axes:
            raise BenchError(f"{where}.schedules: {name} has none of the schedules; leave them out")
        axes["schedules"] = [None]
    _can_follow(protocol, name, where)
    given.setdefault("pythonpath", [])
    paths = _paths({key: given[key] for key in ("path", "base", "pythonpath") if key in given}, where, folder)
    python = os.path.expanduser(os.path.expandvars(given["python"])) if "python" in given else None
    return {"label": name if variant == "patched" else f"{name}-{variant}", **given, **paths, "python": python,
            "arguments": arguments, "axes": axes}


# Flags of the public trainers that the harness sets itself from protocol, scene and axes; then those that would change
# the split, the start, the background or the number of steps.
SET_BY_THE_HARNESS = ("-s", "--source_path", "-m", "--model_path", "-r", "--resolution", "-i", "--images", "--eval",
                      "-w", "--white_background", "--iterations", "--blend_mode", "--background_gate",
                      "--densify_grad_threshold", "--test_iterations", "--save_iterations",
                      *(f"--{name}" for name in RECIPE),
                      "--train_test_exp", "--llffhold", "--lod", "--start_checkpoint", "--init_type",
                      "--random_background", "--warmup", "--load_iteration", "--output_vq")
# Taming's published recipe sets the first, which is a part of the method there; neither is short for another flag.
OWN_FLAGS = {"taming": ("--densification_interval", "--mode")}


def _no_protocol_among(arguments: Sequence[str], name: str, where: str) -> None:
    """Refuses those flags, also as argparse takes them: --res for --resolution, -r4 for -r 4."""
    for word in arguments:
        flag = word.partition("=")[0]
        shortened = flag.startswith("--") and any(known.startswith(flag) for known in SET_BY_THE_HARNESS)
        if (shortened or word[:2] in SET_BY_THE_HARNESS) and flag not in OWN_FLAGS.get(name, ()):
            raise BenchError(f"{where}.arguments: {word} is the same for all methods of a suite, which would mix "
                             "protocols otherwise; it belongs to protocol, scenes or the axes")


def _can_follow(protocol: Dict[str, Any], name: str, where: str) -> None:
    """Raises BenchError where a checkout cannot follow the protocol."""
    if protocol["principal_point"] != "centre":
        raise BenchError(f"protocol.principal_point: is 'scene', but the loader of {name} ({where}) moves it to the "
                         "image centre; it must be 'centre', or the figures would not be comparable")
    if protocol["device"] != "cuda":
        raise BenchError(f"protocol.device: is {protocol['device']!r}, but {name} ({where}) trains on CUDA alone")
    if protocol["options"].get("sh_degree_interval", 1000) != 1000 or protocol["scale_recipe"]:
        raise BenchError(f"protocol: {name} ({where}) raises the SH degree every 1000 steps, whatever the recipe: "
                         "scale_recipe and options.sh_degree_interval are for the native trainer alone")
    for option, value in protocol["options"].items():
        if option in LACKS[name] and value is not False:
            raise BenchError(f"protocol.options.{option}: {name} ({where}) has no such option, or means something else "
                             "by it: its recipe could not be the protocol's")


def _can_train(content: Dict[str, Any], scene: Dict[str, Any], method: Dict[str, Any]) -> None:
    """Raises BenchError where a checkout cannot train a scene as the suite says."""
    what = f"scenes: {scene['name']}, methods: {method['label']}"
    if scene["background"] == "white" and "steady" in _values("schedules", content, scene, method):
        raise BenchError(f"{what}: {scene['name']} is white, where 3DGS resets opacities once more: a checkout's "
                         "schedule cannot be `steady` there")
    if scene["init_points"]:
        raise BenchError(f"{what}: init_points is {scene['init_points']}, but checkouts start from all points")
    if LEARNED in _values("background_gates", content, scene, method) and method["variant"] != "unpatched":
        raise BenchError(f"{what}: background_gates: {LEARNED!r} is for the native trainer alone; it must be a number")
    thresholds = _values("densify_grad_thresholds", content, scene, method)
    if method["name"] in COUNTED_BY and len(thresholds) > 1:
        raise BenchError(f"{what}: {method['name']} has no threshold ({COUNTED_BY[method['name']]} stands for it): "
                         f"{len(thresholds)} of them would be the same training over again; give the method "
                         "densify_grad_thresholds of one value, which names its cells")


def _values(axis: str, content: Dict[str, Any], scene: Dict[str, Any], method: Dict[str, Any]) -> List[Any]:
    """The values of an axis: the method's own, else the scene's, else the suite's."""
    return {**content, **scene["axes"], **method["axes"]}[axis]


def _can_divide(content: Dict[str, Any], protocol: Dict[str, Any], scene: Dict[str, Any],
                method: Dict[str, Any]) -> None:
    """Raises BenchError where the method cannot train on batches of views or on several GPUs, as the protocol says."""
    for field in ("batch", "gpus"):
        if protocol.get(field, 1) == 1:
            continue
        what = f"protocol.{field} is {protocol[field]}"
        if method["name"] != NATIVE:
            raise BenchError(f"{what}, but method {method['label']} knows none; only {NATIVE} does")
        for schedule in _values("schedules", content, scene, method):
            if schedule not in BATCHED:
                raise BenchError(f"{what}, but schedule {schedule} knows none; only {' and '.join(BATCHED)} do")
    if protocol.get("gpus", 1) > 1 and protocol["device"] != "cuda":
        raise BenchError(f"protocol.gpus is {protocol['gpus']}; it needs protocol.device: cuda")


def _cells(content: Dict[str, Any], protocol: Dict[str, Any], scene: Dict[str, Any],
           method: Dict[str, Any]) -> List[Dict[str, Any]]:
    """Every combination of the axes; headline cells also with `headline_seeds`."""
    values = [_values(axis, content, scene, method) for axis in AXIS_OF]
    made = [_cell(content, protocol, scene, method, dict(zip(AXIS_OF.values(), chosen)))
            for chosen in dict.fromkeys(itertools.starmap(_gated, itertools.product(*values)))]
    for cell in [cell for cell in made if cell["headline"] and cell["seed"] == values[-1][0]]:
        chosen = {name: cell[name] for name in AXIS_OF.values()}
        made += [_cell(content, protocol, scene, method, {**chosen, "seed": seed})
                 for seed in content["headline_seeds"] if seed not in values[-1]]
    return made


def _gated(blend_mode: str, gate: Any, *rest: Any) -> Tuple[Any, ...]:
    """A combination of the axes with the gate that is its mode's: those of the axis are for `smoe` alone."""
    own = gate if blend_mode == "smoe" else resolve_background_gate(blend_mode, None)
    return (blend_mode, own if own == LEARNED else float(own), *rest)


def _cell(content: Dict[str, Any], protocol: Dict[str, Any], scene: Dict[str, Any], method: Dict[str, Any],
          values: Dict[str, Any]) -> Dict[str, Any]:
    plain_method, plain_scene = ({key: value for key, value in item.items() if key != "axes"}
                                 for item in (method, scene))
    cell = {"suite": content["name"], "method": plain_method, "scene": plain_scene, **values, "protocol": protocol,
            "images": content["images"], "keep_models": content["keep_models"]}
    headline = content["headline"]
    cell["headline"] = headline is not None and all(
        values[AXIS_OF[axis]] in (*wanted, None) for axis, wanted in headline.items())
    return {"id": cell_id(cell), **cell}


def cell_id(cell: Dict[str, Any]) -> str:
    """A readable name, and a checksum of everything that decides the figures: another protocol is another cell."""
    blend = blend_of(cell)
    identity = {**{key: cell[key] for key in ("densify_grad_threshold", "schedule", "seed", "protocol")},
                "blend_mode": blend}
    for key in ("method", "scene"):
        identity[key] = {name: value for name, value in cell[key].items() if name not in NOT_IN_THE_IDENTITY}
    checksum = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:6]
    threshold = re.sub(r"\.?0+$", "", f"{cell['densify_grad_threshold']:.7f}")
    return "_".join([cell["method"]["label"], cell["scene"]["name"], blend.replace(" ", "-"),
                     cell["schedule"] or "own", threshold, f"s{cell['seed']}", checksum])


def _paths(given: Dict[str, Any], where: str, folder: str) -> Dict[str, Any]:
    """The paths of a scene or a method as absolute ones, with environment variables put in.

    Where a variable is not set, `unset` says which: it matters to those who run a cell that needs it.
    """
    found: Dict[str, Any] = {}
    for field, value in given.items():
        paths = []
        for text in [value] if isinstance(value, str) else value:
            path = os.path.expanduser(os.path.expandvars(text))
            variable = re.search(r"\$\{?(\w+)", path)
            if variable:
                found.setdefault("unset", f"{where}.{field}: ${variable.group(1)} is not set; it is a part of {text!r}")
            else:  # a variable is of the shell, in the folder at hand
                path = os.path.normpath(os.path.join(os.getcwd() if text.startswith("$") else folder, path))
            paths.append(path)
        found[field] = paths[0] if isinstance(value, str) else paths
    return found


def _one_downscaler(scenes: List[Dict[str, Any]]) -> None:
    """Supplied reductions (images_4) and reductions by the loader give figures that differ by half a decibel."""
    supplied = [scene["name"] for scene in scenes if re.search(r"_\d+$", scene["images"])]
    resized = [scene["name"] for scene in scenes if scene["resolution"] not in (-1, 1)]
    if supplied and resized:
        raise BenchError(f"scenes: {supplied[-1]} takes images as they were reduced by others, {resized[-1]} is "
                         "reduced by the loader: two downscalers in one suite, whose figures do not compare")
