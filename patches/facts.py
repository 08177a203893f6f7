"""What a checkout imports and calls, from which it is told which rasterizer's API it calls."""
from __future__ import annotations

import ast
import re
from typing import Dict, Iterator, List, Mapping, Optional, Set, Tuple

from diff_smoe_rasterization.integrations.contracts import (
    ARGUMENTS,
    CONTRACTS,
    METHODS,
    NAMES,
    RASTERIZER,
    RESULTS,
    SETTINGS,
    Contract,
)
from diff_smoe_rasterization.settings import GaussianRasterizationSettings

from .source import PatchError, Source
from .trainers import GR, INTEGRATIONS, TRAINERS, Trainer

PATCHED = "imports from " + INTEGRATIONS
LOOKED_AT = (GR, "scene/__init__.py", "scene/gaussian_model.py", "train.py", "render.py")
OTHER_RASTERIZER = re.compile(r"diff_(gauss|surfel)\w*")
MODULES = {contract.module: contract for contract in CONTRACTS if contract.module != RASTERIZER}
RENDERERS = {"render", "prefilter_voxel", "*"}


def python_tree(data: bytes) -> ast.Module:
    """Returns the syntax tree of a file as Python's own parser has it; of one that cannot be parsed an empty one."""
    try:
        return Source("", data).tree
    except PatchError:
        return ast.Module(body=[], type_ignores=[])


def further_renderers(files: Mapping[str, bytes]) -> List[str]:
    """Returns the modules beside the renderer that these files import: they may render by another rasterizer."""
    folder = GR.rpartition("/")[0]
    found = set()
    for name, data in files.items():
        for node in ast.walk(python_tree(data)):
            if isinstance(node, ast.ImportFrom):
                beside = [folder] if node.level and name == GR else []
                module = ".".join([*beside, *filter(None, [node.module])])
                found |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
    return sorted(module.replace(".", "/") + ".py" for module in found if module.startswith(folder + "."))


def of_files(files: Mapping[str, bytes]) -> Set[str]:
    """Returns facts such as "imports GaussianRasterizer", "sets antialiasing", "returns color, radii".

    files: those of a checkout, by name. One that is no Python shows nothing: a rule will say so.
    """
    facts: Set[str] = set()
    for data in files.values():
        tree = python_tree(data)
        in_try = {id(node) for outer in ast.walk(tree) if isinstance(outer, ast.Try) and outer.handlers
                  for line in outer.body for node in ast.walk(line)}
        made, own = _names_of_rasterizers(tree), _calls_of_own_classes(tree)
        for node in ast.walk(tree):
            if id(node) in own or isinstance(node, ast.Assign) and id(node.value) in own:
                continue
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                facts.update(_of_import(node, id(node) in in_try))
            elif isinstance(node, ast.ClassDef) and node.name in NAMES:
                facts.add("defines " + node.name)
            elif isinstance(node, ast.Call):
                facts.update(_of_call(node, made))
            elif isinstance(node, ast.Attribute) and node.attr == "invdepthmap":
                facts.add("reads invdepthmap")
            elif isinstance(node, ast.Assign) and _renders(node.value, made) and isinstance(node.targets[0], ast.Tuple):
                results = [getattr(one, "id", "_") for one in node.targets[0].elts]
                if not any(isinstance(one, ast.Starred) for one in node.targets[0].elts):
                    facts.add("returns " + ", ".join(results))
    return facts


def _of_import(node: ast.AST, may_fail: bool) -> Iterator[str]:
    names = [alias.name for alias in node.names]
    is_whole = isinstance(node, ast.Import)
    for module in names if is_whole else [node.module or ""]:
        package, last = module.partition(".")[0], module.rpartition(".")[2]
        yield "imports " + last
        if package in MODULES:
            yield "from " + package
        elif package != RASTERIZER and OTHER_RASTERIZER.fullmatch(package):
            yield "uses " + package
        if package == RASTERIZER or package in MODULES:
            yield "keeps the original" if is_whole else "keeps the original by name"
        if module == "gaussian_renderer" and (is_whole or RENDERERS & set(names)):
            yield "renders"
        if module.startswith(INTEGRATIONS + "."):
            yield PATCHED
        if not is_whole and (package == RASTERIZER or package in MODULES or module.startswith(INTEGRATIONS + ".")):
            yield from (f"imports {name}" for name in names)
        if not is_whole and (package == RASTERIZER or package in MODULES and package != "gsplat") and not may_fail:
            prefix = "" if module == package else module + "."
            yield from (f"needs {prefix}{name}" for name in names if name != "*")


def _of_call(call: ast.Call, made: Set[str]) -> Iterator[str]:
    called = getattr(call.func, "attr", getattr(call.func, "id", ""))  # the last part of the name
    keywords = [keyword.arg for keyword in call.keywords]  # None: **pipe.blend
    if called == "GaussianRasterizationSettings":
        yield from (f"sets {name}" for name in keywords if name)
        yield "blends as it says" if {None, "blend_mode"} & set(keywords) else "blends by default"
    elif _renders(call, made) and "means3D" in keywords:  # else it may be another `rasterizer`, such as pytorch3d's
        yield from (f"takes {name}" for name in keywords if name)
    else:
        yield f"calls {called}"
        of = getattr(call.func, "value", None)
        if getattr(getattr(of, "func", of), "id", "") in made:
            yield f"asks {called}"


def _names_of_rasterizers(tree: ast.Module) -> Set[str]:
    """The names by which a file knows the class GaussianRasterizer and objects of it."""
    aliases = {alias.asname or alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
               for alias in node.names if alias.name.startswith("GaussianRasterizer")}
    objects = {target.id for node in ast.walk(tree) if isinstance(node, ast.Assign)
               and isinstance(node.value, ast.Call) and getattr(node.value.func, "id", "") in aliases
               for target in node.targets if isinstance(target, ast.Name)}
    return aliases | objects | ({"rasterizer"} if aliases else set())


def _calls_of_own_classes(tree: ast.Module) -> Set[int]:
    """The calls of classes that the file defines, and of what it makes of them: a renderer without an extension."""
    classes = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    calls = {id(node) for node in ast.walk(tree)
             if isinstance(node, ast.Call) and getattr(node.func, "id", "") in classes}
    for function in ast.walk(tree):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            nodes = list(ast.walk(function))
            made = {target.id for node in nodes if isinstance(node, ast.Assign) and id(node.value) in calls
                    for target in node.targets if isinstance(target, ast.Name)}
            calls |= {id(node) for node in nodes if isinstance(node, ast.Call) and getattr(node.func, "id", "") in made}
    return calls


def _renders(node: ast.AST, made: Set[str]) -> bool:
    """Whether it is a call of an object, rasterizer(...) or GaussianRasterizer(...)(...), and not of the class."""
    if not isinstance(node, ast.Call):
        return False
    called = node.func.func if isinstance(node.func, ast.Call) else node.func
    is_object = isinstance(node.func, ast.Call) or not any(
        keyword.arg == "raster_settings" for keyword in node.keywords)
    return is_object and getattr(called, "id", "") in made


def is_for_run_alone(facts: Set[str]) -> bool:
    """Whether the rasterizer has a name that no patch rewrites, or a class of its name lies beside it in the file."""
    return bool(those(facts, "from ") or those(facts, "defines "))


def contract_of(facts: Set[str]) -> Tuple[Optional[Contract], str]:
    """Returns the rasterizer whose API is called and "", or None and why it is none that is known."""
    foreign = sorted(those(facts, "uses "))
    if foreign:
        return None, f"it imports {', '.join(foreign)}, another rasterizer, which would render in this one's place"
    others = [contract for name, contract in MODULES.items() if "from " + name in facts]
    if others and facts.isdisjoint({"imports " + name for name in NAMES}):
        return others[0], ""
    if not facts & {f"imports {name}" for name in NAMES}:
        return None, f"nothing imports GaussianRasterizationSettings from {RASTERIZER} or {INTEGRATIONS}"
    known = {contract.name: _known(contract) for contract in CONTRACTS}
    said = {"sets": "its GaussianRasterizationSettings have {}", "takes": "its rasterizer is called with {}",
            "needs": "it imports {}", "asks": "its rasterizer has a method {}"}
    for kind, text in said.items():
        names = those(facts, kind + " ") - set().union(*(entry[kind] for entry in known.values()))
        if names:
            return None, (text.format(", ".join(sorted(names))) + ", which no rasterizer has that is known here "
                          f"({', '.join(sorted(known))})")
    shown = others or [contract for contract in CONTRACTS if contract.module == RASTERIZER
                       and (not contract.signs or facts & set(contract.signs))]
    fitting = [contract for contract in shown
               if all(those(facts, kind + " ") <= known[contract.name][kind] for kind in said)]
    for contract in fitting:
        if all(_fits(found, contract) for found in those(facts, "returns ")):
            return contract, ""
    nearest = (fitting or shown)[0]
    found = next((found for found in sorted(those(facts, "returns ")) if not _fits(found, nearest)), "")
    return None, (f"its rasterizer returns {len(found.split(', '))} results ({found}); that of {nearest.name}, which "
                  f"it resembles, returns {len(nearest.results)} ({', '.join(nearest.results)})")


def those(facts: Set[str], kind: str) -> Set[str]:
    return {fact[len(kind):] for fact in facts if fact.startswith(kind)}


def _known(contract: Contract) -> Dict[str, Set[str]]:
    ours = set(GaussianRasterizationSettings._fields[len(SETTINGS) + 1:]) - {"clamp_color"}
    return {"sets": {*SETTINGS, *contract.settings} | ours, "takes": {*ARGUMENTS, *contract.arguments},
            "needs": {*NAMES, *contract.names}, "asks": {*METHODS, *contract.methods}}


def _fits(found: str, contract: Contract) -> bool:
    """Whether what a caller names its results by can be those of a rasterizer."""
    names = found.split(", ")
    return any(len(names) == len(results) and all(
        name.startswith("_") or RESULTS.get(result, ("", ""))[1] in name.lower()
        and not (result == "depth" and re.search("inv|alpha", name.lower())) for name, result in zip(names, results))
        for results in (contract.results, *contract.other_results))


def recognise(facts: Set[str]) -> Tuple[Optional[Trainer], str]:
    """Returns the trainer and "", or None and why it is none that is known."""
    contract, reason = contract_of(facts)
    if contract is None:
        return None, reason
    return next((trainer for trainer in TRAINERS if trainer.flavour == contract.name
                 and facts.issuperset(trainer.signs)), Trainer(contract.name, contract.name, ())), ""
