"""What a checkout imports and calls, from which it is told which trainer it is. Needs no LibCST."""
from __future__ import annotations

import ast
from typing import Callable, Iterator, Optional, Set, Tuple

from .source import called_name, python_tree
from .trainers import GR, INTEGRATIONS, RASTERIZER, TRAINERS, Trainer, names

PATCHED = "imports from " + INTEGRATIONS
LOOKED_AT = (GR, "scene/gaussian_model.py", "train.py", "render.py")
KNOWN_SETTINGS = {
    "image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
    "sh_degree", "campos", "prefiltered", "debug", "antialiasing", "pixel_weights", "clamp_color", "blend_mode",
    "background_gate"}


def of_checkout(read: Callable[[str], Optional[bytes]]) -> Set[str]:
    """Returns facts such as "imports GaussianRasterizer", "sets antialiasing", "unpacks 2 results".

    read: the bytes of a file of the checkout, or None where there is no such file.
    """
    facts: Set[str] = set()
    for name in LOOKED_AT:
        nodes = list(ast.walk(python_tree(read(name) or b"")))  # where it is not Python, a rule will say so
        rasterizers = {"rasterizer"} | {target.id for node in nodes if isinstance(node, ast.Assign)
                                        and _makes_rasterizer(node.value)
                                        for target in node.targets if isinstance(target, ast.Name)}
        for node in nodes:
            facts.update(_of_node(node, rasterizers))
    return facts


def _of_node(node: ast.AST, rasterizers: Set[str]) -> Iterator[str]:
    if isinstance(node, ast.ImportFrom) and node.module:
        is_ours = node.module.startswith(INTEGRATIONS + ".")
        if is_ours:
            yield PATCHED
        if is_ours or node.module == RASTERIZER:
            yield from (f"imports {alias.name}" for alias in node.names)
        else:
            yield "imports " + node.module.rpartition(".")[2]
    elif isinstance(node, ast.Import):
        yield from ("imports " + alias.name.rpartition(".")[2] for alias in node.names)
    elif isinstance(node, ast.Call) and called_name(node) == "GaussianRasterizationSettings":
        yield from (f"sets {keyword.arg}" for keyword in node.keywords if keyword.arg)  # not **pipe.blend
    elif isinstance(node, ast.Call) and called_name(node) == "visible_filter":
        yield "calls visible_filter"
    elif isinstance(node, ast.Attribute) and node.attr == "invdepthmap":
        yield "reads invdepthmap"
    elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and isinstance(node.targets[0], ast.Tuple):
        called, results = node.value.func, node.targets[0].elts
        if ((_makes_rasterizer(called) or getattr(called, "id", "") in rasterizers)
                and not any(isinstance(one, ast.Starred) for one in results)):
            yield f"unpacks {len(results)} results"


def _makes_rasterizer(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and getattr(node.func, "id", "") == "GaussianRasterizer"


def recognise(facts: Set[str]) -> Tuple[Optional[Trainer], str]:
    """Returns the trainer and "", or None and why it is none that is known."""
    if "imports GaussianRasterizationSettings" not in facts:
        return None, f"{GR} imports GaussianRasterizationSettings neither from {RASTERIZER} nor from {INTEGRATIONS}"
    foreign = sorted({fact[5:] for fact in facts if fact.startswith("sets ")} - KNOWN_SETTINGS)
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
