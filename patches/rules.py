"""The rules of a patch: what each puts into a file.

A rule edits a Source. It raises Misfit where what it looks for is not there, or in a form that it does not know.
"""
from __future__ import annotations

import ast
import re
from functools import partial
from typing import Any, Callable, FrozenSet, Iterator, List, NamedTuple, Tuple

from .source import MARK, Misfit, Source
from .trainers import ARGUMENTS, GR, INTEGRATIONS, PACKAGE, RASTERIZER, RUNTIME, Entry, Trainer

SETTINGS = "GaussianRasterizationSettings"
OPTIONS = ("fuse", "modernise")  # each a module here, whose start() a script calls first, the last one first


class Rule(NamedTuple):
    name: str
    file: str
    says: str  # what it looks for
    edit: Callable[[Source], None]


def rules_of(trainer: Trainer) -> List[Rule]:
    """The rules of a trainer; each has to match."""
    return [
        Rule("import-rasterizer", GR, f"`from {RASTERIZER} import ...`", partial(import_rasterizer, trainer=trainer)),
        Rule("settings-blend-mode", GR, f"a call of {SETTINGS} by keyword, in a function whose pipeline argument it "
             "names in `debug=pipe.debug`", settings_blend),
        # Of the groups of options only ModelParams is saved in cfg_args.
        Rule("model-parameter", ARGUMENTS, "a class ModelParams whose __init__ has the statement "
             "`super().__init__(...)`", model_options),
        *(Rule("pipe-blend-mode", entry.file, f"a function {entry.function} with the parameters {entry.dataset} and "
               f"{entry.pipe}", partial(pipe_blend, entry=entry)) for entry in trainer.entries)]


def import_rasterizer(source: Source, trainer: Trainer) -> None:
    """`from diff_gaussian_rasterization import ...` takes the names from this package."""
    found = [node for node in source.nodes(ast.ImportFrom) if (node.module, node.level) == (RASTERIZER, 0)]
    for node in found:
        source.put(f"{MARK} {trainer.name}: {RASTERIZER}", node)
        above, line = source.lines[node.lineno - 1].split(source.newline, 1)
        ours = f"{INTEGRATIONS}.{trainer.flavour}".encode()
        source.lines[node.lineno - 1] = above + source.newline + line.replace(RASTERIZER.encode(), ours, 1)
    if not found:
        raise Misfit("no match")


def settings_blend(source: Source) -> None:
    """The settings call gets `**chosen_blend(pipe)`; `pipe` is the parameter that its `debug=pipe.debug` names."""
    calls = list(_settings_calls(source.tree))
    if not calls:
        raise Misfit("no match")
    misfits = 0
    for call, parameters in reversed(calls):
        given = {keyword.arg: keyword.value for keyword in call.keywords}
        debug = given.get("debug")
        pipe = getattr(getattr(debug, "value", None), "id", "")
        is_known = pipe in parameters and getattr(debug, "attr", "") == "debug"
        if call.args or {None, "blend_mode"} & set(given) or not is_known:
            misfits += 1
            continue
        name, value = str(call.keywords[0].arg), call.keywords[0].value
        line, indent = source.lines[value.lineno - 1], source.indent(value.lineno)
        place = line.rfind(name.encode(), 0, value.col_offset)
        if place < 0:
            raise Misfit(f"line {value.lineno} has no {name}")
        text = f"**chosen_blend({pipe}),  {MARK}".encode() + source.newline + indent + b"    " * (place > len(indent))
        source.lines[value.lineno - 1] = line[:place] + text + line[place:]
    if misfits:
        raise Misfit(f"{misfits} that look alike")
    _import(source, "chosen_blend")


def _settings_calls(node: ast.AST, parameters: FrozenSet[str] = frozenset()
                    ) -> Iterator[Tuple[ast.Call, FrozenSet[str]]]:
    """Yields the settings calls, and what the functions around them have as parameters."""
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
        parameters |= _parameters(node)
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == SETTINGS:
        yield node, parameters
    for child in ast.iter_child_nodes(node):
        yield from _settings_calls(child, parameters)


def _parameters(function: Any) -> FrozenSet[str]:
    return frozenset(node.arg for node in ast.walk(function.args) if isinstance(node, ast.arg))


def _import(source: Source, name: str) -> None:
    source.put_on_top(f"from {RUNTIME} import {name}  {MARK}")


def model_options(source: Source) -> None:
    """ModelParams gets a statement that makes the options --blend_mode and --background_gate of two attributes."""
    lines = [line for model in source.nodes(ast.ClassDef) if model.name == "ModelParams"
             for init in model.body if getattr(init, "name", "") == "__init__" for line in init.body]
    for line in lines:
        if re.match(r"super\(.*\)\.__init__\(", source.text(line)):
            source.put(f"self.blend_mode, self.background_gate = default_blend()  {MARK}", line)
            return _import(source, "default_blend")
    raise Misfit("no match")


def pipe_blend(source: Source, entry: Entry) -> None:
    """The function that gets both groups begins with `pipe.blend = blend_of(dataset)`."""
    for node in source.nodes(ast.FunctionDef):
        if node.name == entry.function and {entry.dataset, entry.pipe} <= _parameters(node):
            first = node.body[int(ast.get_docstring(node) is not None and len(node.body) > 1)]
            source.put(f"{entry.pipe}.blend = {entry.blend}({entry.dataset})  {MARK}", first)
            return _import(source, entry.blend)
    raise Misfit("no match")


def start(source: Source, option: str) -> None:
    """A script begins with the option's start()."""
    source.put_on_top(f"from {PACKAGE}.patches import {option}; {option}.start()  {MARK}")
