"""What a checkout imports and calls, from which it is told which rasterizer's API it calls."""
from __future__ import annotations

import ast
import contextlib
import itertools
import re
from pathlib import Path
from typing import Any, Dict, Iterator, List, Mapping, Optional, Sequence, Set, Tuple

from diff_smoe_rasterization.integrations import contracts
from diff_smoe_rasterization.integrations.contracts import (
    ARGUMENTS,
    CONTRACTS,
    NAMES,
    RASTERIZER,
    REFUSED,
    RESULTS,
    WORDS,
    Contract,
)
from diff_smoe_rasterization.settings import GaussianRasterizationSettings

from .source import PatchError, tree_of
from .trainers import GR, INTEGRATIONS, TRAINERS, Trainer

PATCHED = "imports from " + INTEGRATIONS
FOLDER = GR.partition("/")[0]
LOOKED_AT = (GR, "scene/__init__.py", "scene/gaussian_model.py", "train.py", "render.py")
OTHER_RASTERIZER = re.compile(r"diff_(gauss|surfel|plane)")
IMPORTS_RASTERIZER = re.compile(rb"(?m)^\s*((from|import) (\w*diff_(gauss|surfel|plane)|gsplat\b)"
                                rb"|from (?!diff_smoe_)\w+ import .*GaussianRasteriz)")
FOREIGN = re.compile("|".join(contracts.FOREIGN))
SPARSE_ADAM, ASKS_FOR_SPARSE_ADAM = "SparseGaussianAdam", "sparse_adam"
BY_DEFAULT = re.compile(rb"\boptimizer_type\s*(:\s*\w+\s*)?=\s*['\"]" + ASKS_FOR_SPARSE_ADAM.encode())
USES = {"sets ": "its GaussianRasterizationSettings have", "takes ": "its rasterizer is called with",
        "needs ": "it imports", "asks ": "its rasterizer has a method"}
OF_GSPLAT = "gsplat"
FOUR_COLUMNS = "means2D of four columns"
MODULES = {contract.module: contract for contract in CONTRACTS if contract.module not in (RASTERIZER, OF_GSPLAT)}
STILL = "this package would not blend so; --trainer NAME takes it all the same, such as --trainer inria"
OF_ALL = "integrations/README.md lists all, and `dsmoe run --trainer list` their names"


def of_checkout(files: Mapping[str, bytes], script: str = "") -> Set[str]:
    """Returns the facts of a checkout: of its trainer and renderer, if it is like 3DGS, and of what they import of it.

    script: the file that is run, in place of trainer and renderer. If they reach no rasterizer, as by a name that is
    made up while they run, every file that imports one counts.
    """
    scripts = [name for name, data in files.items() if "/" not in name and b"def training(" in data]
    found = of_files(_reached(files, [script] if script in files else [*LOOKED_AT, *scripts] * (GR in files)))
    others = {name: data for name, data in files.items() if IMPORTS_RASTERIZER.search(data)}
    return found if calls_some(found) else found | of_files(others)


def calls_some(facts: Set[str]) -> bool:
    """Whether a rasterizer is imported, of whatever kind."""
    return bool(PATCHED in facts or those(facts, "from ") or those(facts, "uses ") or those(facts, "renamed "))


def packages(facts: Set[str]) -> Set[str]:
    """Returns the packages that are imported as a rasterizer of Inria's kind."""
    return those(facts, "from ") | those(facts, "renamed ")


def _reached(files: Mapping[str, bytes], start: Sequence[str]) -> Dict[str, bytes]:
    """Returns the files that those of `start` import, and they themselves. Packages bring their __init__.py."""
    reached: Dict[str, bytes] = {}
    waiting, folders = list(start), {"", *(name.rpartition("/")[0] for name in start)}  # for a script's imports
    while waiting:
        name = waiting.pop()
        if name not in files or name in reached:
            continue
        reached[name] = files[name]
        with contextlib.suppress(PatchError):
            for node in ast.walk(tree_of(files[name])):
                for level, module in _modules(node):
                    for folder in ["/".join(name.split("/")[:-level])] if level else folders:
                        parts = [*filter(None, folder.split("/")), *module.split(".")]
                        paths = ["/".join(parts[:end]) for end in range(1, len(parts) + 1)]
                        waiting += [path + end for path in paths for end in (".py", "/__init__.py")]
    return reached


def _modules(node: ast.AST) -> List[Tuple[int, str]]:
    """Returns the modules that an import may load, each with the number of dots before it."""
    if isinstance(node, ast.Import):
        return [(0, alias.name) for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        return [(node.level, f"{node.module or ''}.{alias.name}".strip(".")) for alias in node.names]
    return []


def of_files(files: Mapping[str, bytes]) -> Set[str]:
    """Returns facts such as "imports GaussianRasterizer", "sets antialiasing", "returns color, radii".

    files: those of a checkout, by name. One that is no Python shows nothing: a rule will say so.
    """
    return set().union(*_of_each(files).values())


def importers(files: Mapping[str, bytes]) -> List[str]:
    """Returns the files that import a rasterizer, of whatever kind."""
    return [name for name, facts in _of_each(files).items() if calls_some(facts)]


def _of_each(files: Mapping[str, bytes]) -> Dict[str, Set[str]]:
    local = {name.partition("/")[0].partition(".")[0] for name in files}
    facts: Dict[str, Set[str]] = {}
    for file, data in files.items():
        try:
            nodes = list(ast.walk(tree_of(data)))
        except PatchError:
            continue
        in_try = {id(node) for outer in nodes if isinstance(outer, ast.Try) and outer.handlers
                  for line in outer.body for node in ast.walk(line)}
        shown = facts[file] = {*_of_rasterizers(nodes), *_of_gsplat(nodes)}
        settings_names = {alias.asname for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names
                          if alias.name == NAMES[0]} | {NAMES[0]}
        for node in nodes:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                shown.update(_of_import(node, id(node) in in_try, local))
            elif isinstance(node, ast.ClassDef) and node.name in NAMES:
                shown.add("defines " + node.name)
            elif isinstance(node, ast.Attribute) and node.attr == "invdepthmap":
                shown.add("reads invdepthmap")
            elif isinstance(node, ast.Assign) and _has_four_columns(node):
                shown.add(FOUR_COLUMNS)
            elif isinstance(node, ast.Call):
                called = getattr(node.func, "attr", getattr(node.func, "id", ""))  # the last part of the name
                settings = node.keywords if called in settings_names else ()
                shown.update([f"calls {called}", *(f"sets {keyword.arg}" for keyword in settings if keyword.arg)])
    return facts


def _has_four_columns(node: ast.Assign) -> bool:
    """Whether it makes the points on the screen with two columns more, for sums of absolute gradients (AbsGS)."""
    shapes = (one.elts[-1] if isinstance(one, ast.Tuple) else one for call in ast.walk(node.value)
              if isinstance(call, ast.Call) and getattr(call.func, "attr", "") == "zeros" for one in call.args[-1:])
    return bool(re.search("screenspace|viewspace|means2D", getattr(node.targets[0], "id", ""))
                and any(getattr(size, "value", None) == 4 for size in shapes))


def _of_import(node: Any, may_fail: bool, local: Set[str]) -> Iterator[str]:
    names = [alias.name for alias in node.names]
    is_whole = isinstance(node, ast.Import)
    for module in names if is_whole else [node.module or ""]:
        package, is_ours = module.partition(".")[0], module.startswith(INTEGRATIONS + ".")
        is_theirs = package == RASTERIZER or package in MODULES
        brings = not is_whole and not node.level and not {*names}.isdisjoint(NAMES[:2])
        is_other = not is_ours and not is_theirs and package not in local and bool(
            brings or OTHER_RASTERIZER.search(package))
        is_renamed = is_other and "gauss" in package and not FOREIGN.search(package)
        yield "imports " + module.rpartition(".")[2]
        if is_ours:
            yield PATCHED
        elif is_theirs:
            yield "from " + package
        elif is_renamed:
            yield "renamed " + package
        elif is_other:
            yield "uses " + package
        elif package == OF_GSPLAT:
            yield "has gsplat"
        if not is_whole and (is_ours or is_theirs or is_renamed or module in ("", FOLDER)):
            yield from (f"imports {name}" for name in names)
        if not is_whole and (is_theirs or is_renamed) and not may_fail:
            prefix = "" if module == package else module + "."
            yield from (f"needs {prefix}{name}" for name in names if name != "*")


def _of_gsplat(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """What gsplat's functions are called, by whatever names. Its strategies and formats may be all that is used."""
    names = {alias.asname or alias.name.partition(".")[0]: alias.name for node in nodes
             if isinstance(node, (ast.Import, ast.ImportFrom)) for alias in node.names
             if (getattr(node, "module", None) or alias.name).partition(".")[0] == OF_GSPLAT
             and not getattr(node, "level", 0)}
    names = {"rasterization" if name == "*" else name: "rasterization" if of == "*" else of
             for name, of in names.items()}
    called = {id(node.func): node for node in nodes if isinstance(node, ast.Call)}
    for node in nodes:
        root: Any = node
        while isinstance(root, ast.Attribute):
            root = root.value
        if getattr(root, "id", None) not in names or not isinstance(getattr(root, "ctx", None), ast.Load):
            continue
        function = node.attr if isinstance(node, ast.Attribute) else names[root.id]
        if function == "rasterization":
            yield "from " + OF_GSPLAT
            yield from (f"passes {keyword.arg}" for keyword in getattr(called.get(id(node)), "keywords", ())
                        if keyword.arg)
        elif id(node) in called and re.match("rasteri[sz]e|rasterization|project_gauss", function):
            yield "calls gsplat's " + function


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
    for function in (node for node in nodes if isinstance(node, ast.FunctionDef)):  # out = rasterizer(...); a, b = out
        lines = [node for node in ast.walk(function) if isinstance(node, ast.Assign)]
        kept = {getattr(line.targets[0], "id", "") for line in lines if getattr(line.value, "func", None) in owners}
        for line in lines:
            results = getattr(line.targets[0], "elts", ())
            if results and getattr(line.value, "id", None) in kept - {""}:  # it may depend on len(out)
                yield "may return " + ", ".join(getattr(one, "id", "_") for one in results)


def contract_of(facts: Set[str]) -> Tuple[Optional[Contract], str]:
    """Returns the rasterizer whose API is called and "", or None and why it is none that is known."""
    foreign = sorted(those(facts, "uses "))
    if foreign:
        return None, f"it imports {', '.join(foreign)}, another rasterizer, which would render in this one's place"
    if "from " + OF_GSPLAT in facts:
        strange = sorted(those(facts, "passes ") - arguments_of_gsplat())
        if strange:
            return None, f"it calls gsplat's rasterization with {', '.join(strange)}, which this package's has not"
        beside, reason = contract_of(facts - {"from " + OF_GSPLAT})
        is_beside = not facts.isdisjoint("imports " + name for name in NAMES)
        return (None, reason) if is_beside and not beside else (contracts.contract_of(OF_GSPLAT), "")
    others = [contract for name, contract in MODULES.items() if "from " + name in facts]
    if facts.isdisjoint("imports " + name for name in NAMES):
        called = sorted(those(facts, "calls gsplat's "))
        instead = f"; it calls {', '.join(called)}" if called else ""
        return (others[0], "") if others else (None, f"it imports gsplat and does not call its rasterization{instead}"
                                               if "has gsplat" in facts else f"nothing imports {NAMES[0]} from "
                                               f"{RASTERIZER} or {INTEGRATIONS}")
    refused = next((reason for sign, reason in REFUSED.items() if sign in facts), None)
    if refused:
        return None, refused
    used = {kind + name for kind in USES for name in those(facts, kind)}
    for kind, text in USES.items():
        names = those(used - set().union(*map(_known, CONTRACTS)), kind)
        if names:
            return None, f"{text} {', '.join(sorted(names))}, which no rasterizer has that is known here"
    shown = others or [contract for contract in CONTRACTS if contract.module == RASTERIZER
                       and (not contract.signs or facts & set(contract.signs))]
    fitting = [contract for contract in shown if used <= _known(contract)]
    returned, perhaps = sorted(those(facts, "returns ")), sorted(those(facts, "may return "))
    if those(facts, "renamed ") and not returned + perhaps:
        return None, (f"it imports {', '.join(sorted(those(facts, 'renamed ')))}, and what a call returns is not seen: "
                      f"if it has the API of a rasterizer that is known here, name that one by --trainer; {OF_ALL}")
    longest = sorted(perhaps, key=lambda found: -found.count(",")) or [""]  # the most that code takes
    for kept, contract in itertools.product(longest, fitting):
        if all(_fits(found, contract) for found in returned) and (not kept or _fits(kept, contract)):
            has_columns = contract.name == "inria" and FOUR_COLUMNS in facts  # which the package's own API has not
            return contracts.ordered(("color", "radii")) if has_columns else contract, ""
    if others and "from " + RASTERIZER not in facts:  # its name is that of one, and its API another's
        names = {contract.module for contract in others}
        contract = contract_of(facts - {"from " + name for name in names} | {"renamed " + name for name in names})[0]
        if contract:
            return contract, ""
    orders = {_order(found) for found in returned}
    if len(orders) == 1 and None not in orders and not others:
        contract = contracts.ordered(*orders)  # type: ignore[arg-type]
        if used <= _known(contract):
            return contract, ""
    nearest = (fitting or shown)[0]
    found = next((found for found in [*returned, *perhaps] if not _fits(found, nearest)), "")
    return None, (f"its rasterizer returns {len(found.split(', '))} results ({found}); that of {nearest.name}, which "
                  f"it resembles, returns {len(nearest.results)} ({', '.join(nearest.results)})")


def arguments_of_gsplat() -> Set[str]:
    """Returns the names of what gsplat's `rasterization` may be given here.

    They are read from the module's text, since importing it takes the compiled extension.
    """
    text = Path(contracts.__file__).with_name("gsplat.py").read_bytes()
    for node in tree_of(text).body:
        if isinstance(node, ast.FunctionDef) and node.name == "rasterization":
            taken = {argument.arg for argument in node.args.args}
        elif isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "OF_LATER_VERSIONS":
            later = {key.value for key in node.value.keys}  # type: ignore[attr-defined]
    return taken | later


def _order(found: str) -> Optional[Tuple[str, ...]]:
    """Returns what results are, by what callers name them; None if a name does not say it, or two say the same."""
    results = tuple(next((result for result, word in WORDS if re.search(word, name.lower())), "")
                    for name in found.split(", "))
    try:
        return contracts.ordered(results).results
    except KeyError:
        return None


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
            "renders only pinhole cameras"] if len(own) > 1 else []


def is_for_sparse_adam(root: Path, files: Mapping[str, bytes], facts: Set[str]) -> bool:
    """Whether a checkout was written for SparseGaussianAdam: it cannot do without, has it as its default, or brings it.

    Others import it in a `try`, as 3DGS of 2024 does. If they find it, they render with `dc`.
    """
    return ("needs " + SPARSE_ADAM in facts or any(BY_DEFAULT.search(data) for data in files.values())
            or any(SPARSE_ADAM.encode() in path.read_bytes()
                   for path in root.glob(f"submodules/*/{RASTERIZER}/__init__.py")))


def below(root: Path) -> List[str]:
    """Says which folders of a folder are checkouts, if it is none."""
    if (root / GR).is_file():
        return []
    found = sorted({path.parent.parent.relative_to(root).as_posix() for pattern in ("*/", "*/*/")
                    for path in root.glob(pattern + GR)})
    return [f"there is no {GR} in it, but in {', '.join(found[:3])}{' and others' * (len(found) > 3)}: name "
            f"{'that folder' if len(found) == 1 else 'one of these'}, or a script in it"] if found else []
