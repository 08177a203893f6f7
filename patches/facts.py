"""What a checkout imports and calls, from which it is told which rasterizer's API it calls."""
from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any, Iterator, List, Mapping, Optional, Sequence, Set, Tuple

from diff_smoe_rasterization.integrations import contracts
from diff_smoe_rasterization.integrations.contracts import ARGUMENTS, CONTRACTS, NAMES, RASTERIZER, RESULTS, Contract
from diff_smoe_rasterization.settings import GaussianRasterizationSettings

from .source import PatchError, tree_of
from .trainers import GR, INTEGRATIONS, TRAINERS, Trainer

PATCHED = "imports from " + INTEGRATIONS
FOLDER = GR.partition("/")[0]
LOOKED_AT = (GR, "scene/__init__.py", "scene/gaussian_model.py", "train.py", "render.py")
OTHER_RASTERIZER = re.compile(r"diff_(gauss|surfel)\w*")
USES = {"sets ": "its GaussianRasterizationSettings have", "takes ": "its rasterizer is called with",
        "needs ": "it imports", "asks ": "its rasterizer has a method"}
MODULES = {contract.module: contract for contract in CONTRACTS if contract.module != RASTERIZER}


def of_checkout(files: Mapping[str, bytes]) -> Set[str]:
    """Returns the facts of a checkout like that of 3DGS: of its files, and of renderers that they import."""
    looked_at = {name: files[name] for name in LOOKED_AT if name in files}
    beside = {f"{FOLDER}/{module}.py" for module in those(of_files(looked_at), "imports ")}
    return of_files({**looked_at, **{name: files[name] for name in beside if name in files}})


def of_files(files: Mapping[str, bytes]) -> Set[str]:
    """Returns facts such as "imports GaussianRasterizer", "sets antialiasing", "returns color, radii".

    files: those of a checkout, by name. One that is no Python shows nothing: a rule will say so.
    """
    facts: Set[str] = set()
    for data in files.values():
        try:
            nodes = list(ast.walk(tree_of(data)))
        except PatchError:
            continue
        in_try = {id(node) for outer in nodes if isinstance(outer, ast.Try) and outer.handlers
                  for line in outer.body for node in ast.walk(line)}
        facts.update(_of_rasterizers(nodes))
        for node in nodes:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                facts.update(_of_import(node, id(node) in in_try))
            elif isinstance(node, ast.ClassDef) and node.name in NAMES:
                facts.add("defines " + node.name)
            elif isinstance(node, ast.Attribute) and node.attr == "invdepthmap":
                facts.add("reads invdepthmap")
            elif isinstance(node, ast.Call):
                called = getattr(node.func, "attr", getattr(node.func, "id", ""))  # the last part of the name
                settings = node.keywords if called == "GaussianRasterizationSettings" else ()
                facts.update([f"calls {called}", *(f"sets {keyword.arg}" for keyword in settings if keyword.arg)])
    return facts


def _of_import(node: Any, may_fail: bool) -> Iterator[str]:
    names = [alias.name for alias in node.names]
    is_whole = isinstance(node, ast.Import)
    for module in names if is_whole else [node.module or ""]:
        package, is_ours = module.partition(".")[0], module.startswith(INTEGRATIONS + ".")
        is_theirs = package == RASTERIZER or package in MODULES
        yield "imports " + module.rpartition(".")[2]
        if is_ours:
            yield PATCHED
        elif is_theirs:
            yield "from " + package
        elif OTHER_RASTERIZER.fullmatch(package):
            yield "uses " + package
        if not is_whole and (is_ours or is_theirs or module in ("", FOLDER)):
            yield from (f"imports {name}" for name in names)
        if not is_whole and is_theirs and package != "gsplat" and not may_fail:
            prefix = "" if module == package else module + "."
            yield from (f"needs {prefix}{name}" for name in names if name != "*")


def _of_rasterizers(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Calls of objects, rasterizer(...) and GaussianRasterizer(...)(...) by whatever names, and of their methods."""
    classes = {alias.asname or alias.name for node in nodes if isinstance(node, ast.ImportFrom)
               for alias in node.names if alias.name.startswith("GaussianRasterizer")}
    calls = [node for node in nodes if isinstance(node, ast.Call)]
    made = [call for call in calls if getattr(call.func, "id", "") in classes]
    assigned = [node for node in nodes if isinstance(node, ast.Assign)]
    objects = {getattr(target, "id", "") for node in assigned if node.value in made for target in node.targets}
    objects |= {"rasterizer"} if classes else set()
    owners = [*made, *(node for node in nodes if getattr(node, "id", None) in objects)]
    for call in calls:
        keywords = [keyword.arg for keyword in call.keywords if keyword.arg]  # without **pipe.blend
        if call.func in owners and "means3D" in keywords:  # else it may be another `rasterizer`, such as pytorch3d's
            yield from (f"takes {name}" for name in keywords)
        elif isinstance(call.func, ast.Attribute) and call.func.value in owners:
            yield "asks " + call.func.attr
    for node in assigned:
        results = getattr(node.targets[0], "elts", ())
        is_plain = results and not any(isinstance(one, ast.Starred) for one in results)
        if is_plain and getattr(node.value, "func", None) in owners:
            yield "returns " + ", ".join(getattr(one, "id", "_") for one in results)


def contract_of(facts: Set[str]) -> Tuple[Optional[Contract], str]:
    """Returns the rasterizer whose API is called and "", or None and why it is none that is known."""
    foreign = sorted(those(facts, "uses "))
    if foreign:
        return None, f"it imports {', '.join(foreign)}, another rasterizer, which would render in this one's place"
    others = [contract for name, contract in MODULES.items() if "from " + name in facts]
    if facts.isdisjoint("imports " + name for name in NAMES):
        return (others[0], "") if others else (
            None, f"nothing imports GaussianRasterizationSettings from {RASTERIZER} or {INTEGRATIONS}")
    used = {kind + name for kind in USES for name in those(facts, kind)}
    for kind, text in USES.items():
        names = those(used - set().union(*map(_known, CONTRACTS)), kind)
        if names:
            return None, (f"{text} {', '.join(sorted(names))}, which no rasterizer has that is known here "
                          f"({', '.join(sorted(contract.name for contract in CONTRACTS))})")
    shown = others or [contract for contract in CONTRACTS if contract.module == RASTERIZER
                       and (not contract.signs or facts & set(contract.signs))]
    fitting = [contract for contract in shown if used <= _known(contract)]
    returned = sorted(those(facts, "returns "))
    for contract in fitting:
        if all(_fits(found, contract) for found in returned):
            return contract, ""
    nearest = (fitting or shown)[0]
    found = next((found for found in returned if not _fits(found, nearest)), "")
    return None, (f"its rasterizer returns {len(found.split(', '))} results ({found}); that of {nearest.name}, which "
                  f"it resembles, returns {len(nearest.results)} ({', '.join(nearest.results)})")


def those(facts: Set[str], kind: str) -> Set[str]:
    return {fact[len(kind):] for fact in facts if fact.startswith(kind)}


def _known(contract: Contract) -> Set[str]:
    """The facts by which a caller may use a rasterizer."""
    ours = set(GaussianRasterizationSettings._fields[len(contracts.SETTINGS) + 1:]) - {"clamp_color"}
    return {*(f"sets {name}" for name in (*contracts.SETTINGS, *contract.settings, *ours)),
            *(f"takes {name}" for name in (*ARGUMENTS, *contract.arguments)),
            *(f"needs {name}" for name in (*NAMES, *contract.names)),
            *(f"asks {name}" for name in (*contracts.METHODS, *contract.methods))}


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


def of_one_name(root: Path) -> List[str]:
    """Says which rasterizers of one name a checkout brings, such as one for each kind of lens."""
    own = sorted(path.parent.name for path in root.glob(f"submodules/*/{RASTERIZER}"))
    return [f"the checkout has {', '.join(own)}, all called {RASTERIZER}: this package's takes the place of each, and "
            "renders pinhole cameras alone"] if len(own) > 1 else []
