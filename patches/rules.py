"""The rules of a patch: what each puts into a file.

A rule edits a Source. It raises PatchError if what it looks for is not there, or in a form that it does not know.
"""
from __future__ import annotations

import ast
import contextlib
import re
from functools import partial
from typing import Callable, Dict, List, Mapping, NamedTuple, Sequence, Tuple

from .facts import SPARSE_ADAM
from .source import MARK, PatchError, Source, digest, marked
from .trainers import ARGUMENTS, GR, INTEGRATIONS, PATCHES, RASTERIZER, RUNTIME, Entry, Trainer

SETTINGS = "GaussianRasterizationSettings"
OPTIONS = ("fuse", "modernise")  # each a module here, whose start() a script calls first, the last one first


class Rule(NamedTuple):
    name: str
    file: str
    says: str  # what it looks for
    edit: Callable[[Source], None]


def rules_of(trainer: Trainer, files: Mapping[str, bytes], sparse_adam: bool) -> List[Rule]:
    """The rules of a trainer; each has to match.

    files: of the checkout: a function may be in another script. sparse_adam: it was written for SparseGaussianAdam.
    """
    return [
        Rule("import-rasterizer", GR, f"`from {RASTERIZER} import ...`", partial(
            import_rasterizer, trainer=trainer, sparse_adam=sparse_adam)),
        Rule("settings-blend-mode", GR, f"a call of {SETTINGS} by keyword, with `debug=pipe.debug`", settings_blend),
        # Of the groups of options only ModelParams is saved in cfg_args.
        Rule("model-parameter", ARGUMENTS, "a class ModelParams whose __init__ has the statement "
             "`super().__init__(...)`", partial(model_options, default=trainer.default)),
        *(Rule("pipe-blend-mode", entry.file, f"a function {entry.function} with the parameters {entry.dataset} and "
               f"{entry.pipe}", partial(pipe_blend, entry=entry)) for entry in entries_in(files, trainer.entries))]


def entries_in(files: Mapping[str, bytes], entries: Sequence[Entry]) -> List[Entry]:
    """Returns the entries with the files of their functions: a file of that name, and any script beside it.

    One that renders may be nowhere. If a file is there without its function, the rule will say so.
    """
    found: Dict[Tuple[str, str], Entry] = {}
    for entry in entries:
        scripts = {name for name, data in files.items() if "/" not in name and _functions(data, entry)}
        if entry.file in files or not scripts and not entry.renders:
            scripts.add(entry.file)
        found.update({(name, entry.function): entry._replace(file=name) for name in sorted(scripts)})
    return list(found.values())


def _functions(data: bytes, entry: Entry) -> List[ast.FunctionDef]:
    """Returns the functions of a file that are given both groups of options."""
    if f"def {entry.function}".encode() not in data:
        return []
    with contextlib.suppress(PatchError):
        return _of_entry(Source(data), entry)
    return []


def _of_entry(source: Source, entry: Entry) -> List[ast.FunctionDef]:
    return [node for node in source.nodes(ast.FunctionDef) if node.name == entry.function
            and {entry.dataset, entry.pipe} <= {node.arg for node in ast.walk(node.args) if isinstance(node, ast.arg)}]


def import_rasterizer(source: Source, trainer: Trainer, sparse_adam: bool) -> None:
    """`from diff_gaussian_rasterization import ...` takes the names from this package."""
    in_try = {line for outer in source.nodes(ast.Try) for line in outer.body}
    found = [node for node in source.nodes(ast.ImportFrom) if (node.module, node.level) == (RASTERIZER, 0)]
    for node in found:
        is_sparse_adam = [alias.name for alias in node.names] == [SPARSE_ADAM] and node in in_try
        on_request = is_sparse_adam and not sparse_adam and trainer.flavour == "inria_2024"
        ours = (f"{PATCHES}.sparse_adam" if on_request else f"{INTEGRATIONS}.{trainer.flavour}").encode()
        source.put(f"{MARK} {trainer.name}: {RASTERIZER} {digest(ours)}", node)
        above, line = source.lines[node.lineno - 1].split(source.newline, 1)
        source.lines[node.lineno - 1] = above + source.newline + line.replace(RASTERIZER.encode(), ours, 1)
    if not found:
        raise PatchError("no match")


def _import(source: Source, name: str, found: Sequence[ast.AST]) -> None:
    """A rule's file gets the import of what the rule put in. Raises PatchError if it found nothing."""
    if not found:
        raise PatchError("no match")
    source.put_on_top(marked(f"from {RUNTIME} import {name}"))


def settings_blend(source: Source) -> None:
    """The settings call gets `**chosen_blend(pipe)`; `pipe` is what its `debug=pipe.debug` names."""
    calls = [call for call in source.nodes(ast.Call) if getattr(call.func, "id", "") == SETTINGS]
    for call in sorted(calls, key=lambda call: call.lineno, reverse=True):
        given = {keyword.arg: keyword.value for keyword in call.keywords}
        pipe = getattr(getattr(given.get("debug"), "value", None), "id", "")
        misfit = PatchError(f"the call in line {call.lineno} is another")
        if call.args or {None, "blend_mode"} & set(given) or not pipe or getattr(given["debug"], "attr", "") != "debug":
            raise misfit
        name, value = str(call.keywords[0].arg), call.keywords[0].value
        line, indent = source.lines[value.lineno - 1], source.indent(value.lineno)
        place = line.rfind(name.encode(), 0, value.col_offset)
        if place < 0:
            raise misfit
        text = marked(f"**chosen_blend({pipe}),").encode() + source.newline + indent + b"    " * (place > len(indent))
        source.lines[value.lineno - 1] = line[:place] + text + line[place:]
    _import(source, "chosen_blend", calls)


def model_options(source: Source, default: str) -> None:
    """ModelParams gets a statement that makes the options --blend_mode and --background_gate of two attributes."""
    found = [line for model in source.nodes(ast.ClassDef) if model.name == "ModelParams"
             for init in model.body if getattr(init, "name", "") == "__init__" for line in init.body
             if re.match(rb"\s*super\(.*\)\.__init__\(", source.lines[line.lineno - 1])]
    for line in found[:1]:
        source.put(marked(f"self.blend_mode, self.background_gate = {default}()"), line)
    _import(source, default, found)


def pipe_blend(source: Source, entry: Entry) -> None:
    """The function that gets both groups begins with `pipe.blend = blend_of(dataset)`, or what the entry names."""
    found = _of_entry(source, entry)
    for node in found:
        first = node.body[int(ast.get_docstring(node) is not None and len(node.body) > 1)]
        source.put(marked(f"{entry.pipe}.blend = {entry.blend}({entry.dataset})"), first)
    _import(source, entry.blend, found)


def start(source: Source, option: str) -> None:
    """A script begins with the option's start()."""
    source.put_on_top(marked(f"from {PATCHES} import {option}; {option}.start()"))
