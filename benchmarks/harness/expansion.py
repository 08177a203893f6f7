"""Suites: a YAML file that says what is trained on what, checked and expanded to cells, in one protocol."""
from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
from dataclasses import dataclass
from typing import Any, Dict, List, Optional, Sequence, Tuple

import yaml

from diff_smoe_rasterization.settings import GATED_MODES, PAPER, PAPER_PROGRAM, resolve_background_gate

from ..errors import ConfigError
from ..options.config import LEARNED
from . import schema
from .errors import BenchError
from .names import (
    AXIS_OF,
    CHECKOUTS,
    COUNTED_BY,
    LACKS,
    NATIVE,
    NEEDS,
    OF_NATIVE_ALONE,
    RECIPE,
    SCENES,
    SHIPPED,
    UNSAID,
    WITHOUT_STRATEGY,
    blend_of,
    is_paper,
)
from .protocol import config_of

Values = Dict[str, Any]
Axes = Dict[str, List[Any]]
# Paths change no figure.
NOT_IN_THE_IDENTITY = ("path", "base", "python", "pythonpath", "commit", "base_commit", "unset")


@dataclass(frozen=True)
class Suite:
    name: str
    protocol: Values
    scenes: List[Values]
    methods: List[Values]
    cells: List[Values]


def find_suite(name: str) -> str:
    """The path of a suite: a file, or the name of one that is shipped. Raises BenchError."""
    is_file = os.path.isfile(name)
    refuse(not is_file and name not in SHIPPED,
           f"{name}: no such file, and no suite that is shipped ({', '.join(sorted(SHIPPED))})")
    return name if is_file else SHIPPED[name]


def load_suite(path: str, device: Optional[str] = None, iterations: Optional[int] = None,
               scenes: Optional[str] = None, methods: Sequence[str] = ()) -> Suite:
    """`expand` of a file. scenes: a file of scenes to use instead of the suite's, or the name of a shipped one."""
    content, folder = read_yaml(path), os.path.dirname(os.path.abspath(path))
    if scenes is not None and isinstance(content, dict):
        found = scenes if os.path.isfile(scenes) else SCENES.get(scenes)
        refuse(found is None, f"--scenes {scenes}: no such file, and no scenes that are shipped "
                              f"({', '.join(sorted(SCENES))})")
        content = {**content, "scenes": os.path.abspath(str(found))}
    try:
        return expand(content, folder, device, iterations, methods)
    except BenchError as error:
        raise BenchError(f"{path}: {error}") from error


def expand(content: Any, folder: str, device: Optional[str] = None, iterations: Optional[int] = None,
           methods: Sequence[str] = ()) -> Suite:
    """A suite from what its file says; relative paths are taken from `folder`. Raises BenchError.

    device: in place of protocol.device; `auto` becomes the device of this machine. iterations: in place of
    protocol.iterations, with the recipe squeezed into them. methods: the labels of the only ones that are wanted; the
    others need not be able to follow the protocol.
    """
    if isinstance(content, dict) and isinstance(content.get("scenes"), str):
        path = os.path.join(folder, content["scenes"])
        refuse(not os.path.isfile(path), f"scenes: {path}: no such file")
        content = {**content, "scenes": read_yaml(path)}
        refuse(not isinstance(content["scenes"], list), f"{path}: it must hold a list of scenes")
    schema.check(content)
    content = {**schema.defaults(schema.Axes), **schema.defaults(schema.SuiteFile), **content}
    protocol = {**schema.defaults(schema.Protocol), **(content["protocol"] or {})}
    protocol = {name: value for name, value in protocol.items() if value is not None}
    protocol["device"] = device or protocol["device"]
    if iterations is not None:
        protocol.update(iterations=iterations, scale_recipe=True)
    if protocol["device"] == "auto":
        from ..system.device import chosen_device  # it loads torch, which a suite does without

        protocol["device"] = chosen_device()
    scenes = [_scene(scene, f"scenes[{index}]", protocol, folder) for index, scene in enumerate(content["scenes"])]
    wanted = [(index, method) for index, method in enumerate(content["methods"])
              if not methods or label_of(method).lower() in map(str.lower, methods)]
    refuse(not wanted, f"--only method={' '.join(methods)}: the suite has "
                       f"{', '.join(map(label_of, content['methods']))}")
    trained = [_method(method, f"methods[{index}]", protocol, folder) for index, method in wanted]
    for field, key, items in (("scenes", "name", scenes), ("methods", "label", trained)):
        names = [item[key] for item in items]
        for index, name in enumerate(names):
            refuse(name in names[:index], f"{field}[{index}].{key}: {name!r} is there already")
    supplied = [scene["name"] for scene in scenes if re.search(r"_\d+$", scene["images"])]
    resized = [scene["name"] for scene in scenes if scene["resolution"] not in (-1, 1)]
    refuse(supplied and resized,  # their figures differ by half a decibel
           f"scenes: {''.join(supplied[-1:])} takes images as they were reduced by others, {''.join(resized[-1:])} is "
           "reduced by the loader: two downscalers in one suite, whose figures do not compare")
    cells: List[Values] = []
    for scene, method in itertools.product(scenes, trained):
        axes = {axis: {**content, **scene["axes"], **method["axes"]}[axis] for axis in AXIS_OF}
        if method["name"] != NATIVE:
            _can_train(scene, method, axes)
        _can_divide(protocol, method)
        cells += _cells(content, protocol, scene, method, axes)
    for cell in cells:
        try:
            config_of(cell)
        except (ConfigError, TypeError) as error:
            raise BenchError(f"cell {cell['id']}: {error}") from error
    return Suite(content["name"], protocol, scenes, trained, cells)


def refuse(wrong: Any, words: str) -> None:
    if wrong:
        raise BenchError(words)


def read_yaml(path: str) -> Any:
    """What a YAML file says. Raises BenchError."""
    class Loader(yaml.SafeLoader):
        """Refuses a key that is there twice: YAML would keep the last one silently."""

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


def _scene(scene: Values, where: str, protocol: Values, folder: str) -> Values:
    """A scene with its defaults; under `axes` the axes that it has values of its own for."""
    refuse(("path" in scene) == ("synthetic" in scene), f"{where}: give either `path` or `synthetic`")
    given, axes = _apart(scene)
    usual = {**schema.defaults(schema.Scene), "background": protocol["background"]}
    if "synthetic" not in given:
        del usual["synthetic"]
    return {**usual, **given, **_paths(given, ("path",), where, folder), "axes": axes}


def _apart(part: Values) -> Tuple[Values, Axes]:
    return ({key: value for key, value in part.items() if key not in AXIS_OF},
            {axis: part[axis] for axis in AXIS_OF if axis in part})


def label_of(method: Values) -> str:
    """What rows call a method of a suite file."""
    usual = "patched" if CHECKOUTS.get(method["name"]) else "unpatched"
    variant = method.get("variant", usual)
    plain = method["name"] == NATIVE or variant == "patched"
    return str(method.get("label", method["name"] if plain else f"{method['name']}-{variant}"))


def _method(method: Values, where: str, protocol: Values, folder: str) -> Values:
    """The method with its defaults, and under `axes` the axes that it has values of its own for."""
    name = method["name"]
    given, axes = _apart(method)
    refuse("budget" in given and name not in COUNTED_BY,
           f"{where}.budget: is for {' and '.join(COUNTED_BY)}, which are given a number of primitives; {name} has "
           "densify_grad_thresholds")
    if name == NATIVE:
        wrong = [key for key in ("variant", "arguments", *NOT_IN_THE_IDENTITY)
                 if key in given and (key, given[key]) != ("variant", NATIVE)]
        refuse(wrong, f"{where}.{''.join(wrong[:1])}: is for checkouts; the native trainer's recipe stands in "
                      "protocol.options")
        return {"label": label_of(method), "variant": "native", **given, "axes": axes}
    refuse("path" not in given, f"{where}.path: is missing; it names the checkout's folder")
    refuse((name == "c3dgs") != ("base" in given),
           f"{where}.base: c3dgs, and nothing else, needs it: a 3DGS checkout that trains what it compresses")
    arguments = [str(word) for word in given.get("arguments", [])]
    for word in arguments:  # also as argparse takes flags: --res for --resolution, -r4 for -r 4
        flag = word.partition("=")[0]
        shortened = flag.startswith("--") and any(known.startswith(flag) for known in SET_BY_THE_HARNESS)
        refuse((shortened or word[:2] in SET_BY_THE_HARNESS) and flag not in OWN_FLAGS.get(name, ()),
               f"{where}.arguments: {word} is the same for all methods of a suite, which would mix protocols "
               "otherwise; it belongs to protocol, scenes or the axes")
    can_be_patched = CHECKOUTS[name]
    variant = given.setdefault("variant", "patched" if can_be_patched else "unpatched")
    refuse(variant == "native" or (variant != "unpatched" and not can_be_patched),
           f"{where}.variant: is {variant!r}; {name} can be "
           + ("unpatched, patched or fused" if can_be_patched else "unpatched only"))
    if variant == "unpatched":
        refuse(axes.setdefault("blend_modes", ["alpha"]) != ["alpha"],
               f"{where}.blend_modes: an unpatched checkout has only its own blending, `alpha`")
    refuse(name in NEEDS and NEEDS[name] not in arguments,
           f"{where}.arguments: {name} needs {NEEDS.get(name)} N in place of a threshold")
    if "budget" in given:
        wanted = {COUNTED_BY[name]: str(given["budget"])}
        if name == "taming":
            wanted["--mode"] = "final_count"  # else its number is a multiple of the first points'
        refuse(not wanted.items() <= dict(zip(arguments, arguments[1:])).items(),
               f"{where}.budget: is {given['budget']}; {name} is told so by its arguments, among which must be "
               f"{' '.join(itertools.chain(*wanted.items()))}")
    if name in WITHOUT_STRATEGY:
        refuse("strategies" in axes, f"{where}.strategies: {name} has a strategy of its own; leave them out")
        axes["strategies"] = [None]
    _can_follow(protocol, name, where)
    python = os.path.expanduser(os.path.expandvars(given["python"])) if "python" in given else None
    given.setdefault("pythonpath", [])
    return {"label": label_of(method), **given,
            **_paths(given, ("path", "base", "pythonpath"), where, folder),
            "python": python, "arguments": arguments, "axes": axes}


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


def _can_follow(protocol: Values, name: str, where: str) -> None:
    refuse(protocol["principal_point"] != "centre",
           f"protocol.principal_point: is 'scene', but the loader of {name} ({where}) moves it to the image centre; it "
           "must be 'centre', or the figures would not be comparable")
    refuse(protocol["device"] != "cuda",
           f"protocol.device: is {protocol['device']!r}, but {name} ({where}) trains only on CUDA")
    refuse(protocol["options"].get("sh_degree_interval", 1000) != 1000 or protocol["scale_recipe"],
           f"protocol: {name} ({where}) raises the SH degree every 1000 steps, whatever the recipe: scale_recipe and "
           "options.sh_degree_interval are only for the native trainer")
    for option, value in protocol["options"].items():
        refuse(option in (*LACKS[name], *OF_NATIVE_ALONE) and value is not False,
               f"protocol.options.{option}: {name} ({where}) has no such option, or means something else by it: its "
               "recipe could not be the protocol's")


def _can_train(scene: Values, method: Values, axes: Axes) -> None:
    name, thresholds = method["name"], axes["densify_grad_thresholds"]
    what = f"scenes: {scene['name']}, methods: {method['label']}"
    refuse(scene["background"] == "white" and "steady" in axes["strategies"],
           f"{what}: {scene['name']} is white, where 3DGS resets opacities once more: a checkout's strategy cannot be "
           "`steady` there")
    refuse(scene["init_points"],
           f"{what}: init_points is {scene['init_points']}, but checkouts start from all points")
    refuse(axes["budgets"] != [0], f"{what}: budgets: are only for the native trainer; leave them out")
    refuse(name in COUNTED_BY and len(thresholds) > 1,
           f"{what}: {name} has no threshold ({COUNTED_BY.get(name)} stands for it): {len(thresholds)} of them would "
           "be the same training over again; give the method densify_grad_thresholds of one value, which names its "
           "cells")


def _can_divide(protocol: Values, method: Values) -> None:
    for field in ("batch", "gpus"):
        if protocol.get(field, 1) == 1:
            continue
        what = f"protocol.{field} is {protocol[field]}"
        refuse(method["name"] != NATIVE, f"{what}, but method {method['label']} knows none; only {NATIVE} does")
    refuse(protocol.get("gpus", 1) > 1 and protocol["device"] != "cuda",
           f"protocol.gpus is {protocol.get('gpus')}; it needs protocol.device: cuda")


def _cells(content: Values, protocol: Values, scene: Values, method: Values, axes: Axes) -> List[Values]:
    """Every combination of the axes; headline cells also with `headline_seeds`."""
    wanted = content["headline"]
    plain = {name: {key: value for key, value in part.items() if key != "axes"}
             for name, part in (("method", method), ("scene", scene))}

    def cell(values: Values) -> Values:
        values = {name: value for name, value in values.items() if name not in UNSAID or value != UNSAID[name]}
        made = {"suite": content["name"], **plain, **values, "protocol": protocol, "images": content["images"],
                "keep_models": content["keep_models"], "headline": wanted is not None and all(
                    said_of(values, AXIS_OF[axis]) in (*chosen, None) for axis, chosen in wanted.items())}
        return {"id": cell_id(made), **made}

    first, *_ = seeds = axes["seeds"]
    combined = dict.fromkeys(itertools.starmap(_gated, itertools.product(*axes.values())))
    made = [cell(dict(zip(AXIS_OF.values(), chosen))) for chosen in combined]
    return made + [cell({**{name: one.get(name, UNSAID.get(name)) for name in AXIS_OF.values()}, "seed": seed})
                   for one in made if one["headline"] and one["seed"] == first
                   for seed in content["headline_seeds"] if seed not in seeds]


def said_of(cell: Values, field: str) -> Any:
    """A cell's value of a field, by the field's name in a suite."""
    return PAPER if field == "blend_mode" and is_paper(cell) else cell.get(field, UNSAID.get(field))


def _gated(blend_mode: str, gate: Any, faint: Optional[float], *rest: Any) -> Tuple[Any, ...]:
    """A combination of the axes with what is its mode's: gates and faint_belows are only for GATED_MODES."""
    if blend_mode == PAPER:
        return (*PAPER_PROGRAM.values(), *rest)
    faint = faint if blend_mode in GATED_MODES else None
    own = gate if blend_mode in GATED_MODES else resolve_background_gate(blend_mode, None)
    return (blend_mode, own if own == LEARNED else float(own), faint, *rest)


def cell_id(cell: Values) -> str:
    """A readable name, and a checksum of everything that decides the figures: another protocol is another cell."""
    blend = blend_of(cell)
    named = ("faint_below", "strategy", "densify_grad_threshold", "budget", "seed", "protocol")
    identity = {**{key: cell[key] for key in named if key in cell}, "blend_mode": blend}
    for key in ("method", "scene"):
        identity[key] = {name: value for name, value in cell[key].items() if name not in NOT_IN_THE_IDENTITY}
    checksum = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:6]
    threshold = re.sub(r"\.?0+$", "", f"{cell['densify_grad_threshold']:.7f}")
    return "_".join([cell["method"]["label"], cell["scene"]["name"], blend.replace(" ", "-"),
                     cell["strategy"] or "own", threshold, *([f"n{cell['budget']}"] if "budget" in cell else []),
                     f"s{cell['seed']}", checksum])


def _paths(given: Values, fields: Sequence[str], where: str, folder: str) -> Values:
    """The paths among these fields as absolute ones; `unset` says which variable is not set, for whoever needs it."""
    found: Values = {}

    def absolute(text: str, field: str) -> str:
        path = os.path.expanduser(os.path.expandvars(text))
        variable = re.search(r"\$\{?(\w+)", path)
        if variable:
            found.setdefault("unset", f"{where}.{field}: ${variable.group(1)} is not set; it is a part of {text!r}")
            return path
        # A variable is of the shell, in the folder at hand.
        return os.path.normpath(os.path.join(os.getcwd() if text.startswith("$") else folder, path))

    for field in filter(given.__contains__, fields):
        value = given[field]
        found[field] = absolute(value, field) if isinstance(value, str) else [absolute(text, field) for text in value]
    return found
