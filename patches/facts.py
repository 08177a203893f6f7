"""What a checkout imports and calls, from which it is told which trainer it is. Needs no LibCST."""
from __future__ import annotations

import ast
from typing import Callable, Optional, Set, Tuple

from .rules import GR, INTEGRATIONS, RASTERIZER, Trainer
from .source import called_name, python_tree
from .trainers import TRAINERS

PATCHED = "imports from " + INTEGRATIONS
LOOKED_AT = (GR, "scene/gaussian_model.py", "train.py", "render.py")
BASE_SETTINGS = {"image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix",
                 "projmatrix", "sh_degree", "campos", "prefiltered", "debug"}
FURTHER_SETTINGS = {"antialiasing", "pixel_weights", "clamp_color", "blend_mode", "background_gate"}


def of_checkout(read: Callable[[str], Optional[bytes]]) -> Set[str]:
    """Returns facts such as "imports GaussianRasterizer", "sets antialiasing", "unpacks 2 results".

    read: the bytes of a file of the checkout, or None where there is no such file.
    """
    facts: Set[str] = set()
    for name in LOOKED_AT:
        data = read(name)
        if data is not None:
            tree = python_tree(data)  # where it is not Python, a rule that needs the file will say so
            rasterizers = {"rasterizer", *_assigned_rasterizers(tree)}
            for node in ast.walk(tree):
                facts |= _of_node(node) | _of_results(node, rasterizers)
    return facts


def _of_node(node: ast.AST) -> Set[str]:
    if isinstance(node, ast.ImportFrom) and node.module:
        if node.module == RASTERIZER or node.module.startswith(INTEGRATIONS + "."):
            imported = {f"imports {alias.name}" for alias in node.names}
            return imported if node.module == RASTERIZER else imported | {PATCHED}
        return {"imports " + node.module.rpartition(".")[2]}
    if isinstance(node, ast.Import):
        return {"imports " + alias.name.rpartition(".")[2] for alias in node.names}
    if isinstance(node, ast.Call):
        called = called_name(node)
        if called == "GaussianRasterizationSettings":
            return {f"sets {keyword.arg}" for keyword in node.keywords if keyword.arg}  # not **pipe.blend
        if called == "visible_filter":
            return {"calls visible_filter"}
    return {"reads invdepthmap"} if isinstance(node, ast.Attribute) and node.attr == "invdepthmap" else set()


def _assigned_rasterizers(tree: ast.AST) -> Set[str]:
    """Returns the names to which a GaussianRasterizer is assigned."""
    return {target.id for node in ast.walk(tree)
            if isinstance(node, ast.Assign) and _is_rasterizer(node.value)
            for target in node.targets if isinstance(target, ast.Name)}


def _of_results(node: ast.AST, rasterizers: Set[str]) -> Set[str]:
    """Says into how many variables the results of a rasterizer are unpacked: a, b = rasterizer(...)."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Call):
        return set()
    called, target = node.value.func, node.targets[0]
    if not (_is_rasterizer(called) or isinstance(called, ast.Name) and called.id in rasterizers):
        return set()
    if not isinstance(target, ast.Tuple) or any(isinstance(one, ast.Starred) for one in target.elts):
        return set()
    return {f"unpacks {len(target.elts)} results"}


def _is_rasterizer(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and getattr(node.func, "id", "") == "GaussianRasterizer"


def recognise(facts: Set[str]) -> Tuple[Optional[Trainer], str]:
    """Returns the trainer and "", or None and why it is none that is known."""
    if "imports GaussianRasterizationSettings" not in facts:
        return None, f"{GR} imports GaussianRasterizationSettings neither from {RASTERIZER} nor from {INTEGRATIONS}"
    foreign = sorted(fact[5:] for fact in facts if fact.startswith("sets ")
                     and fact[5:] not in BASE_SETTINGS | FURTHER_SETTINGS)
    if foreign:
        return None, (f"its GaussianRasterizationSettings have {', '.join(foreign)}, which no trainer has that is "
                      f"known here ({', '.join(names())})")
    nearest = next(trainer for trainer in TRAINERS
                   if any(facts.issuperset(sign.split(" and ")) for sign in trainer.signs))
    results = {int(fact.split()[1]) for fact in facts if fact.startswith("unpacks ")} - {nearest.results}
    if results:
        return None, (f"its rasterizer returns {min(results)} results; that of {nearest.name}, which it resembles, "
                      f"returns {nearest.results}")
    return nearest, ""


def names() -> Tuple[str, ...]:
    """The names of the trainers."""
    return tuple(sorted(trainer.name for trainer in TRAINERS))
