"""What a checkout imports and calls, from which it is told which rasterizer's API it calls."""
from __future__ import annotations

import ast
import contextlib
import re
from collections import Counter
from pathlib import Path
from typing import Any, Dict, Iterator, List, Mapping, Optional, Sequence, Set, Tuple

from diff_smoe_rasterization.integrations import contracts
from diff_smoe_rasterization.integrations.contracts import (
    ARGUMENTS,
    CONTRACTS,
    FEATURES,
    NAMES,
    NO_MEANING,
    RASTERIZER,
    REFUSED,
    RESULTS,
    WORDS,
    Contract,
)
from diff_smoe_rasterization.settings import GaussianRasterizationSettings

from . import callers
from .callers import MODULES, OF_GSPLAT, OTHER, OURS, RENAMED, THEIRS, those
from .source import PatchError, tree_of
from .trainers import GR, INTEGRATIONS, TRAINERS, Trainer

PATCHED = "imports from " + INTEGRATIONS
FOLDER = GR.partition("/")[0]
LOOKED_AT = (GR, "scene/__init__.py", "scene/gaussian_model.py", "train.py", "render.py")
IMPORTS_RASTERIZER = re.compile(rb"(?m)^\s*((from|import) (\w*diff_(gauss|surfel|plane)|gsplat\b)"
                                rb"|from (?!diff_smoe_)\w+ import .*GaussianRasteriz)")
CALLS_BY_TEXT = re.compile(rb"\bglobals\(|(?<![.\w])eval\(|\bgetattr\((\w|\.)+, *\w")  # by a made-up name
SPARSE_ADAM, ASKS_FOR_SPARSE_ADAM = "SparseGaussianAdam", "sparse_adam"
BY_DEFAULT = re.compile(rb"\boptimizer_type\s*(:\s*\w+\s*)?=\s*['\"]" + ASKS_FOR_SPARSE_ADAM.encode())
USES = {"sets ": "its GaussianRasterizationSettings have", "takes ": "its rasterizer is called with",
        "needs ": "it imports", "asks ": "its rasterizer has a method"}
# What names of a result may say: these must say it, and others may say nothing.
CALLED_SO = {"depth": ("depth",), "alpha": ("alpha",), "opacity": ("alpha",), "median_depth": ("median_depth",),
             "inverse_depth": ("", "inverse_depth", "depth"), "language_feature": ("", "language_feature",
                                                                                   "feature_map")}
SAID = {result for result, _ in WORDS} | set(CALLED_SO)
OF_ONE = (*USES, "returns ", "keeps results")  # kinds of facts that are about one rasterizer
STILL = "this package would not blend so; --trainer NAME takes it all the same, such as --trainer inria"
OF_ALL = "integrations/README.md lists all, and `dsmoe run --trainer list` their names"


def of_checkout(files: Mapping[str, bytes], script: str = "") -> Set[str]:
    """Returns the facts of a checkout: of its trainer and renderer, if it is like 3DGS, and of what they import of it.

    script: the file that is run, in place of trainer and renderer. If they reach no rasterizer, as by a name that is
    made up while they run, every file that imports one counts.
    """
    scripts = [name for name, data in files.items() if "/" not in name and b"def training(" in data]
    used = reached(files, [script] if script in files else [*LOOKED_AT, *scripts] * (GR in files))
    found = of_files(used, used)
    others = {name: data for name, data in files.items() if IMPORTS_RASTERIZER.search(data)}
    return found if calls_some(found) else found | of_files(others, files)


def calls_some(facts: Set[str]) -> bool:
    """Whether a rasterizer is imported, of whatever kind."""
    return bool(PATCHED in facts or those(facts, "from ") or those(facts, "uses ") or those(facts, "renamed "))


def packages(facts: Set[str]) -> Set[str]:
    """Returns the packages that are imported as a rasterizer of Inria's kind."""
    return (those(facts, "from ") | those(facts, "renamed ")) - {OF_GSPLAT}


def reached(files: Mapping[str, bytes], start: Sequence[str]) -> Dict[str, bytes]:
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


def of_files(files: Mapping[str, bytes], callers_of: Mapping[str, bytes]) -> Set[str]:
    """Returns facts such as "imports GaussianRasterizer", "sets antialiasing", "returns color, radii".

    files: those of a checkout, by name. One that is not Python shows nothing: a rule will say so. callers_of: the files
    that may call what is in them; a function that nothing names shows nothing.
    """
    return set().union(*_of_each(files, callers_of).values())


def importers(files: Mapping[str, bytes]) -> List[str]:
    """Returns the files that import a rasterizer, of whatever kind."""
    return [name for name, facts in _of_each(files, files).items() if calls_some(facts)]


def _without_dead(tree: ast.Module, words: Mapping[bytes, int]) -> ast.Module:
    """Returns a file without the functions that are named once, where they begin."""
    tree.body = [line for line in tree.body if not isinstance(line, ast.FunctionDef)
                 or line.decorator_list or words[line.name.encode()] > 1]
    return tree


def _of_each(files: Mapping[str, bytes], callers_of: Mapping[str, bytes]) -> Dict[str, Set[str]]:
    by_text = any(map(CALLS_BY_TEXT.search, callers_of.values()))
    words = Counter(word for data in callers_of.values() for word in re.findall(rb"\w+", data) * (1 + by_text))
    local = {name.partition("/")[0].partition(".")[0] for name in files}
    facts: Dict[str, Set[str]] = {}
    for file, data in files.items():
        try:
            tree = _without_dead(tree_of(data), words)
        except PatchError:
            continue
        nodes = list(ast.walk(tree))
        in_try = {id(node) for outer in nodes if isinstance(outer, ast.Try) and outer.handlers
                  for line in outer.body for node in ast.walk(line)}
        later = in_try | {id(node) for outer in nodes if isinstance(outer, (ast.FunctionDef, ast.If))
                          for node in ast.walk(outer)}
        shown = facts[file] = {*callers.of_rasterizers(tree, local), *_of_gsplat(nodes)}
        for node in nodes:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                shown.update(_of_import(node, id(node) in in_try, id(node) in later, local))
            elif isinstance(node, ast.ClassDef) and node.name in NAMES:
                shown.add("defines " + node.name)
            elif isinstance(node, ast.Attribute) and node.attr == "invdepthmap":
                shown.add("reads invdepthmap")
            elif isinstance(node, ast.Call):
                shown.add(f"calls {callers.last_name(node.func)}")
    return facts


def _of_import(node: Any, may_fail: bool, later: bool, local: Set[str]) -> Iterator[str]:
    """may_fail: it is in a `try`. later: it is run only if its branch or function is."""
    names = [alias.name for alias in node.names]
    is_whole = isinstance(node, ast.Import)
    for module in names if is_whole else [node.module or ""]:
        package, kind = module.partition(".")[0], callers.kind_of(node, module, local)
        yield "imports " + module.rpartition(".")[2]
        if kind == OURS:
            yield PATCHED
        elif kind == OTHER:
            yield f"{'may use' if later else 'uses'} {package}"
        elif kind:
            yield f"{kind} {package}"
            yield f"{'perhaps' if later else 'always'} {package}"
        elif package == OF_GSPLAT:
            yield "has gsplat"
        is_rasterizer = kind in (THEIRS, RENAMED)
        if not is_whole and (kind and kind != OTHER or module in ("", FOLDER)):
            yield from (f"imports {name}" for name in names)
        if not is_whole and is_rasterizer and not may_fail:
            prefix = "" if module == package else module + "."
            yield from (text for name in names if name != "*"
                        for text in callers.tagged(package, f"needs {prefix}{name}"))


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


def contract_of(facts: Set[str]) -> Tuple[Optional[Contract], str]:
    """Returns the rasterizer whose API is called and "", or None and why it is unknown.

    Of several, the package named RASTERIZER, else the first.
    """
    foreign = sorted(those(facts, "uses "))
    if foreign:
        return None, f"it imports {', '.join(foreign)}, another rasterizer, which would render in this one's place"
    if "from " + OF_GSPLAT in facts:
        strange = sorted(those(facts, "passes ") - {*contracts.GSPLAT, *contracts.OF_LATER_GSPLAT})
        if strange:
            return None, f"it calls gsplat's rasterization with {', '.join(strange)}, which this package's has not"
        beside, reason = contract_of(facts - {"from " + OF_GSPLAT})
        is_beside = not facts.isdisjoint("imports " + name for name in NAMES)
        return (None, reason) if is_beside and not beside else (contracts.contract_of(OF_GSPLAT), "")
    others = [contract for name, contract in MODULES.items() if "from " + name in facts]
    if facts.isdisjoint("imports " + name for name in NAMES) and not others:
        called, later = (", ".join(sorted(those(facts, kind))) for kind in ("calls gsplat's ", "may use "))
        return None, ("it imports gsplat and does not call its rasterization" + f"; it calls {called}" * bool(called)
                      if "has gsplat" in facts else f"it imports {later}, another rasterizer, and none that is known"
                      if later else f"nothing imports {NAMES[0]} from {RASTERIZER} or {INTEGRATIONS}")
    found, reason = contracts_of(facts)
    return next(iter(found.values()), None), reason


def contracts_of(facts: Set[str]) -> Tuple[Dict[str, Contract], str]:
    """Returns for each package that is imported as a rasterizer which one it is, and "".

    If one of them is unknown: {} and why. Left out is a package of unknown name that is imported only in a branch or a
    function, beside one that is always imported: see `blocked`.
    """
    imported = sorted(packages(facts), key=lambda name: (name != RASTERIZER, name)) or [RASTERIZER]
    found, reasons = {}, {}
    for package in imported:
        own = callers.of_package(facts, package, OF_ONE) if len(imported) > 1 else facts
        contract, reason = _contract_of(package, own)
        if contract:
            found[package] = contract
        else:
            reasons[package] = f"{package}: {reason}" if len(imported) > 1 else reason
    always = those(facts, "always ")
    needed = [reason for package, reason in reasons.items()
              if package in always or package in MODULES or always.isdisjoint(found)]
    return ({}, needed[0]) if needed else (found, "")


def not_offered(facts: Set[str], package: str, contract: Contract) -> List[str]:
    """Returns what is imported from a package, come what may, and a rasterizer has not."""
    own = callers.of_package(facts, package, OF_ONE)
    return sorted(those(own, "needs ") - {*NAMES, *contract.names})


def blocked(facts: Set[str]) -> Set[str]:
    """Returns the packages of other rasterizers that are imported only in a branch or a function."""
    return those(facts, "may use ") | (packages(facts) - set(contracts_of(facts)[0]))


def _contract_of(package: str, facts: Set[str]) -> Tuple[Optional[Contract], str]:
    """Returns what `contract_of` does, for the facts of one package."""
    refused = next((reason for sign, reason in REFUSED.items() if sign in facts), None)
    if refused:
        return None, refused
    used = {kind + name for kind in USES for name in those(facts, kind)}
    free = contracts.ordered(("color", "radii"))
    unknown = used - set().union(*map(_known, (*CONTRACTS, free)))
    seen, brought = those(facts, "returns "), those(facts, f"brings {package}: ")
    returned = sorted(brought if brought and all(_agree(*brought, found, facts) for found in seen) else seen)
    if unknown:
        return None, _told(unknown) + ", which no rasterizer has that is known here"
    if not returned and ("keeps results" in facts or package not in (RASTERIZER, *MODULES)):
        return None, (f"it imports {package}, and what a call returns is not seen: if it has the API of a rasterizer "
                      f"that is known here, name that one by --trainer; {OF_ALL}")
    named = [MODULES[package]] if package in MODULES else []  # its name may be one rasterizer's, and its API another's
    shown = named + [contract for contract in CONTRACTS if contract.module == RASTERIZER
                     and (not contract.signs or facts & set(contract.signs))] * bool(returned or not named)
    fitting = [contract for contract in shown if used <= _known(contract)]
    for contract in fitting:
        if all(_fits(found, contract) for found in returned):
            return contract, ""
    orders = {_order(found, facts) for found in returned}
    if len(orders) == 1 and None not in orders and used <= _known(free):
        return contracts.ordered(*orders), ""  # type: ignore[arg-type]
    return None, _clash(returned, facts, used - _known(free), (fitting or shown)[0])


def _agree(brought: str, found: str, facts: Set[str]) -> bool:
    """Whether names that callers give results can be those of the rasterizer that the checkout brings."""
    names = [one.split(", ") for one in (brought, found)]
    return len(names[0]) == len(names[1]) and all(
        not meant or _meaning(name, facts) in ("", *CALLED_SO.get(meant, (meant,)))
        for meant, name in zip((_meaning(one, facts) for one in names[0]), names[1]))


def _clash(returned: Sequence[str], facts: Set[str], whole: Set[str], nearest: Contract) -> str:
    """Says which facts do not go together. whole: what only comes with the results of one rasterizer."""
    found = next((found for found in returned if not _fits(found, nearest)), "")
    if not found:
        return f"{_told(whole)}, which no rasterizer has together that is known here"
    blind = next((name for name in found.split(", ") if not _meaning(name, facts)), "")
    whose = next((contract for contract in CONTRACTS if blind in contract.results), None)
    others = " or ".join(f"({other})" for other in returned if other != found)
    why = (f"{_told(whole)}, which come only with the results of a rasterizer that is known here" if whole else
           f"{blind} comes only in the results of {whose.name}: {', '.join(whose.results)}" if whose else
           f"what {blind} is, no name or argument says" if blind else f"other calls return {others}" if others else
           "a name comes twice, or color or radii are not among them")
    return (f"its rasterizer returns {len(found.split(', '))} results ({found}); that of {nearest.name}, which it "
            f"resembles, returns {len(nearest.results)} ({', '.join(nearest.results)}); {why}")


def _told(used: Set[str]) -> str:
    """Returns "its settings have X; its rasterizer is called with Y"."""
    return "; ".join(f"{text} {', '.join(sorted(those(used, kind)))}" for kind, text in USES.items()
                     if those(used, kind))


def _order(found: str, facts: Set[str]) -> Optional[Tuple[str, ...]]:
    """Returns what results are, by what callers name them; None if a name does not say it, or two say the same."""
    try:
        return contracts.ordered(tuple(_meaning(name, facts) for name in found.split(", "))).results
    except KeyError:
        return None


def _meaning(name: str, facts: Set[str]) -> str:
    """Returns which result a name says, "" where it says none.

    Features and normals are results only where the rasterizer is given some: else it computes them in its own way.
    """
    bare = re.sub(NO_MEANING, "", name.lower())
    said = "" if name.startswith("_") else next((result for result, words in WORDS if re.fullmatch(
        f"({words})s?", bare)), "")
    given = [result for argument, (result, _) in FEATURES.items() if "takes " + argument in facts]
    if said not in {result for result, _ in FEATURES.values()} or said in given:
        return said
    others = [result for result in given if result != "normal"]
    return others[0] if said != "normal" and len(others) == 1 else ""


def _known(contract: Contract) -> Set[str]:
    """The facts by which a caller may use a rasterizer."""
    ours = set(GaussianRasterizationSettings._fields[len(contracts.SETTINGS) + 1:]) - {"clamp_color"}
    return {*(f"sets {name}" for name in (*contracts.SETTINGS, *contract.settings, *ours)),
            *(f"takes {name}" for name in (*ARGUMENTS, *contract.arguments)),
            *(f"needs {name}" for name in (*NAMES, *contract.names)),
            *(f"asks {name}" for name in (*contracts.METHODS, *contract.methods))}


def _fits(found: str, contract: Contract) -> bool:
    """Whether what a caller names its results by can be those of a rasterizer."""
    names, taken = found.split(", "), {f"takes {name}" for name in contract.arguments}
    return any(len(names) == len(results) and all(
        name.startswith("_") or RESULTS.get(result, ("", ""))[1] in name.lower()
        and (result not in SAID or _meaning(name, taken) in CALLED_SO.get(result, ("", result)))
        for name, result in zip(names, results)) for results in (contract.results, *contract.other_results))


def recognise(facts: Set[str]) -> Tuple[Optional[Trainer], str]:
    """Returns the trainer and "", or None and why it is unknown."""
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


def below(root: Path, remedy: str = "name") -> List[str]:
    """Says which folders of a folder are checkouts, if it is none. remedy: what to do with one of them."""
    if (root / GR).is_file():
        return []
    found = sorted({path.parent.parent.relative_to(root).as_posix() for pattern in ("*/", "*/*/")
                    for path in root.glob(pattern + GR)})
    return [f"there is no {GR} in it, but in {', '.join(found[:3])}{' and others' * (len(found) > 3)}: {remedy} "
            f"{'that folder' if len(found) == 1 else 'one of these'}"] if found else []
