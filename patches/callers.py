"""What a Python file calls its rasterizers with: which objects are rasterizers, by what is imported where.

A file may have several rasterizers, each imported in a function of its own. So a fact about one is given twice: as it
is, and as "of PACKAGE: FACT". Where it is not seen from which package an object is, that is "of : FACT".
"""
from __future__ import annotations

import ast
import re
from typing import Any, Dict, Iterator, List, Optional, Sequence, Set, Tuple

from diff_smoe_rasterization.integrations import contracts
from diff_smoe_rasterization.integrations.contracts import CONTRACTS, NAMES, RASTERIZER

from .trainers import INTEGRATIONS

OURS, THEIRS, RENAMED, OTHER = "ours", "from", "renamed", "uses"  # kinds of packages; the facts begin so
OF_GSPLAT = "gsplat"
OTHER_RASTERIZER = re.compile(r"diff_(gauss|surfel|plane)")
FOREIGN = re.compile("|".join(contracts.FOREIGN))
MODULES = {contract.module: contract for contract in CONTRACTS if contract.module not in (RASTERIZER, OF_GSPLAT)}
SETTINGS, CLASS = NAMES[:2]
Scope = Optional[ast.AST]  # a function; None: the file


def kind_of(node: Any, module: str, local: Set[str]) -> str:
    """Returns of which kind the module of an import is, "" where it is not a rasterizer.

    local: the names of modules in the checkout.
    """
    package, names = module.partition(".")[0], {alias.name for alias in node.names}
    brings = isinstance(node, ast.ImportFrom) and not node.level and not names.isdisjoint(NAMES[:2])
    if module.startswith(INTEGRATIONS + "."):
        return OURS
    if package == RASTERIZER or package in MODULES:
        return THEIRS
    if package in local or not (brings or OTHER_RASTERIZER.search(package)):
        return ""
    return RENAMED if "gauss" in package and not FOREIGN.search(package) else OTHER


def tagged(package: Optional[str], fact: str) -> Tuple[str, str]:
    """Returns a fact about a rasterizer, and the same with its package, "" where that is not seen."""
    return fact, f"of {package or ''}: {fact}"


def last_name(function: Any) -> str:
    """Returns the last part of a function's name."""
    return getattr(function, "attr", getattr(function, "id", ""))


def of_rasterizers(tree: ast.Module, local: Set[str]) -> Iterator[str]:
    """Yields what settings are made with, what rasterizers are called with, and what their results are named.

    Calls are those of objects, rasterizer(...) and GaussianRasterizer(...)(...) by whatever names, and of methods.
    """
    file = _File(tree, local)
    for call in file.all(ast.Call):
        keywords = [keyword.arg for keyword in call.keywords if keyword.arg]  # without **pipe.blend
        for package in file.made_of(call.func, SETTINGS, call):
            yield from (fact for name in keywords for fact in tagged(package, f"sets {name}"))
        if "means3D" in keywords:  # else it may be another `rasterizer`, such as pytorch3d's
            yield from (fact for package in file.owners(call.func, call) for name in keywords
                        for fact in tagged(package, f"takes {name}"))
        if isinstance(call.func, ast.Attribute):
            yield from (fact for package in file.owners(call.func.value, call)
                        for fact in tagged(package, f"asks {call.func.attr}"))
    for line in file.all(ast.Assign):
        if isinstance(line.value, ast.Call):
            results = getattr(line.targets[0], "elts", ())
            is_seen = results and not any(isinstance(one, ast.Starred) for one in results)
            named = "returns " + ", ".join(getattr(one, "id", "_") for one in results) if is_seen else "keeps results"
            yield from (fact for package in file.owners(line.value.func, line) for fact in tagged(package, named))


class _File:
    """The names of a file, each in the function where it is bound."""

    def __init__(self, tree: ast.Module, local: Set[str]) -> None:
        self.scope: Dict[int, ast.AST] = {}  # of a node: the innermost function around it
        self.nodes: List[ast.AST] = []
        self._note(tree, None)
        self.bound: Dict[Tuple[int, str], Set[Tuple[str, str]]] = {}  # names that were imported: package, what
        self.made: Dict[Tuple[int, str], Set[str]] = {}  # names of rasterizers: their packages
        self.open = False  # names may come from where they are not seen
        defined = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
        for node in self.all(ast.Import, ast.ImportFrom):
            self._import(node, local)
        self.has_classes = any(what.startswith(CLASS) for found in self.bound.values() for _, what in found)
        for name in {SETTINGS, CLASS} - defined:
            if self.open:
                self.bound.setdefault((0, name), {("", name)})
        for line in self.all(ast.Assign):
            value = line.value
            packages = set(self.made_of(value.func, CLASS, line)) if isinstance(value, ast.Call) else set()
            called = getattr(value.func, "id", "") if isinstance(value, ast.Call) else ""
            is_other = called in defined or called.startswith(CLASS)  # that is imported nowhere
            for target in filter(None, map(_path, line.targets)):
                if packages or is_other:  # of a class of the file's own, or of none
                    self.made.setdefault(self._key(target, line), set()).update(packages)

    def _note(self, node: ast.AST, scope: Scope) -> None:
        waiting: List[Tuple[ast.AST, Scope]] = [(node, scope)]
        while waiting:
            node, scope = waiting.pop()
            self.nodes.append(node)
            if scope is not None:
                self.scope[id(node)] = scope
            inside = node if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) else scope
            waiting += [(child, inside) for child in ast.iter_child_nodes(node)]

    def all(self, *kinds: type) -> Iterator[Any]:
        return (node for node in self.nodes if isinstance(node, kinds))

    def _import(self, node: Any, local: Set[str]) -> None:
        for alias in node.names:
            module = alias.name if isinstance(node, ast.Import) else node.module or ""
            kind, package = kind_of(node, module, local), module.partition(".")[0]
            if isinstance(node, ast.Import):
                if kind:
                    self._bind(node, alias.asname or package, package, "module")
            elif alias.name == "*":
                self.open |= not kind
                for name in NAMES if kind else ():
                    self._bind(node, name, package, name)
            elif alias.name == SETTINGS or alias.name.startswith(CLASS):
                self._bind(node, alias.asname or alias.name, package if kind else "", alias.name)

    def _bind(self, node: ast.AST, name: str, package: str, what: str) -> None:
        self.bound.setdefault(self._key(name, node), set()).add((package, what))

    def _key(self, name: str, node: ast.AST) -> Tuple[int, str]:
        """Attributes, such as those of self, belong to the whole file."""
        scope = self.scope.get(id(node))
        return (0 if scope is None or "." in name else id(scope)), name

    def _found(self, names: Dict[Tuple[int, str], Any], name: str, node: ast.AST) -> Any:
        """Returns what a name is where the node is; None where it is nothing that is known."""
        scope: Scope = self.scope.get(id(node))
        while scope is not None:
            if (id(scope), name) in names:
                return names[id(scope), name]
            scope = self.scope.get(id(scope))
        return names.get((0, name))

    def made_of(self, function: Any, kind: str, node: ast.AST) -> List[str]:
        """Returns the packages of the class that is called, if it is of this kind: SETTINGS or CLASS."""
        path, name = _path(function), last_name(function)
        if isinstance(function, ast.Attribute):  # of a module
            found = self._found(self.bound, path.rpartition(".")[0], node) or ()
            return sorted(package for package, what in found if what == "module" and name.startswith(kind))
        return sorted(package for package, what in self._found(self.bound, path, node) or () if what.startswith(kind))

    def owners(self, function: Any, node: ast.AST) -> List[str]:
        """Returns the packages of a rasterizer; [] where it is none."""
        if isinstance(function, ast.Call):  # GaussianRasterizer(...)(...)
            return self.made_of(function.func, CLASS, node)
        path = _path(function)
        made = self._found(self.made, path, node)
        if made is None and path == "rasterizer" and self.has_classes:  # that a caller brought
            return [""]
        return sorted(made or ())


def _path(node: Any) -> str:
    """Returns a name with its attributes, such as self.rasterizer; "" for any other expression."""
    parts: List[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


def of_package(facts: Set[str], package: str, kinds: Sequence[str]) -> Set[str]:
    """Returns the facts without those about other rasterizers than a package's.

    kinds: the beginnings of facts that are about one rasterizer.
    """
    own = {fact.partition(": ")[2] for fact in facts if fact.startswith((f"of {package}: ", "of : "))}
    packages = {f"{kind} {name}" for kind in (THEIRS, RENAMED) for name in those(facts, kind + " ") - {package}}
    return {fact for fact in facts - packages if not fact.startswith(("of ", *kinds))} | own


def those(facts: Set[str], kind: str) -> Set[str]:
    return {fact[len(kind):] for fact in facts if fact.startswith(kind)}
