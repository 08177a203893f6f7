"""The rules of a patch: how each changes the text of a file.

A rule takes a Source and yields edits of it: DONE where one is there already, nothing where it does not match.
"""
from __future__ import annotations

import ast
import re
from functools import partial
from typing import Callable, Collection, FrozenSet, Iterator, List, NamedTuple, Optional, Tuple

from .source import DONE, Edit, Source, dotted, keywords_of, on_top
from .trainers import ARGUMENTS, GR, INTEGRATIONS, PACKAGE, RASTERIZER, RUNTIME, Entry, Trainer


class Misfit(Exception):
    """What has to be patched is there in a form that the rule does not know."""


class Rule(NamedTuple):
    name: str
    says: str  # what it looks for; of a rule on request why it does
    edits: Callable[[Source], Iterator[Edit]]
    file: str = ""  # in which it has to match; a rule on request looks at all files
    hints: Tuple[str, ...] = ()  # of which such a file has one
    imports: Tuple[str, ...] = ()  # module and name that its edits need

    def change(self, source: Source) -> Optional[bytes]:
        """Returns what the file becomes, the same where it is that; None where nothing matches."""
        edits = list(self.edits(source))
        if set(edits) - {DONE} and self.imports:
            edits = [*source.import_of(*self.imports), *edits]
        return source.edited(edits) if edits else None


def rules_of(trainer: Trainer) -> List[Rule]:
    """The rules of a trainer; each has to match."""
    return [
        Rule("import-rasterizer", f"`from {RASTERIZER} import ...`",
             partial(rasterizer_import, flavour=trainer.flavour), GR),
        Rule("settings-blend-mode", "a call of GaussianRasterizationSettings by keyword, in a function whose pipeline "
             "argument it names in `debug=pipe.debug`", settings_blend, GR),
        # Of the groups of options only ModelParams is saved in cfg_args.
        Rule("model-parameter", "a class ModelParams whose __init__ has the statement `super().__init__(...)`",
             model_options, ARGUMENTS, imports=(RUNTIME, "default_blend")),
        *(Rule("pipe-blend-mode", f"a function {entry.function} with the parameters {entry.dataset} and {entry.pipe}",
               partial(pipe_blend, entry=entry), entry.file, imports=(RUNTIME, entry.blend))
          for entry in trainer.entries)]


def renamed_import(source: Source, foreign: str, ours: str, names: Collection[str] = ()) -> Iterator[Edit]:
    """`from FOREIGN import NAMES` takes the names from OURS, where it has all of them (none given: it has)."""
    for node in source.nodes(ast.ImportFrom):
        place = source.text.find(foreign.encode(), *source.span(node))
        if (node.module, node.level) == (foreign, 0) and place >= 0 and (
                not names or {alias.name for alias in node.names} <= set(names)):
            yield Edit(place, place + len(foreign), ours)


def rasterizer_import(source: Source, flavour: str) -> Iterator[Edit]:
    ours = f"{INTEGRATIONS}.{flavour}"
    yield from renamed_import(source, RASTERIZER, ours)
    if any(node.module == ours for node in source.nodes(ast.ImportFrom)):
        yield DONE


def settings_blend(source: Source) -> Iterator[Edit]:
    """The settings call gets `**pipe.blend`; `pipe` is the parameter that its `debug=pipe.debug` names."""
    misfits = 0
    for call, parameters in _settings_calls(source.tree):
        given = keywords_of(call)
        pipe, _, attribute = dotted(given.get("debug")).partition(".")
        if attribute == "debug" and pipe in parameters and dotted(given.get(None)) == f"{pipe}.blend":
            yield DONE
        elif attribute != "debug" or pipe not in parameters or call.args or {None, "blend_mode"} & set(given):
            misfits += 1
        else:
            bracket = source.text.index(b"(", source.span(call.func)[1]) + 1
            first = re.compile(rb"(\s|#.*)*").match(source.text, bracket).end()
            # The line break and the indent that are before the arguments, without a comment.
            _, line_break, indent = source.text[bracket:first].decode().rpartition("\n")
            yield Edit(first, first, f"**{pipe}.blend,{source.newline + indent if line_break else ' '}")
    if misfits:
        raise Misfit(f"{misfits} that look alike")


def _settings_calls(node: ast.AST, parameters: FrozenSet[str] = frozenset()
                    ) -> Iterator[Tuple[ast.Call, FrozenSet[str]]]:
    """Yields the settings calls, and what the functions around them have as parameters."""
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
        parameters |= _parameters(node)
    if isinstance(node, ast.Call) and dotted(node.func) == "GaussianRasterizationSettings":
        yield node, parameters
    for child in ast.iter_child_nodes(node):
        yield from _settings_calls(child, parameters)


def _parameters(function: ast.AST) -> FrozenSet[str]:
    return frozenset(node.arg for node in ast.walk(function.args) if isinstance(node, ast.arg))


def _with_line(source: Source, body: List[ast.stmt], place: int, line: str) -> Iterator[Edit]:
    """A function's body with one more statement, where it has not that."""
    wanted = ast.dump(ast.parse(line).body[0])
    is_there = any(ast.dump(statement) == wanted for statement in body)
    yield from [DONE] if is_there else source.line_before(body, place, line)


def model_options(source: Source) -> Iterator[Edit]:
    """ModelParams gets a statement that makes the options --blend_mode and --background_gate of two attributes."""
    for model in on_top(source.tree):
        for init in on_top(model) if isinstance(model, ast.ClassDef) and model.name == "ModelParams" else ():
            for place, line in enumerate(init.body if getattr(init, "name", "") == "__init__" else ()):
                call = getattr(getattr(line, "value", None), "func", None)
                if getattr(call, "attr", "") == "__init__" and dotted(getattr(call.value, "func", None)) == "super":
                    yield from _with_line(source, init.body, place,
                                          "self.blend_mode, self.background_gate = default_blend()")
                    break


def pipe_blend(source: Source, entry: Entry) -> Iterator[Edit]:
    """The function that gets both groups begins with `pipe.blend = blend_of(dataset)`."""
    for node in on_top(source.tree):
        if (isinstance(node, ast.FunctionDef) and node.name == entry.function
                and {entry.dataset, entry.pipe} <= _parameters(node)):
            place = int(ast.get_docstring(node) is not None and len(node.body) > 1)
            yield from _with_line(source, node.body, place, f"{entry.pipe}.blend = {entry.blend}({entry.dataset})")


# Rules on request.

def call_of_ours(source: Source, foreign: str, ours: str, positional: int, keywords: Collection[str],
                 dim: Optional[int] = None) -> Iterator[Edit]:
    """`FOREIGN(...)` becomes `OURS(...)` where it has no other arguments than these.

    positional: how many at most. dim: the value of this keyword. Nothing changes in a module where anything has that
    name already.
    """
    for field in ("id", "name", "asname"):
        if any(getattr(node, field, None) == ours for node in ast.walk(source.tree)):
            return
    for call in source.calls(foreign):
        given = keywords_of(call)
        if (set(given) <= set(keywords) and len(call.args) <= positional
                and not any(isinstance(argument, ast.Starred) for argument in call.args)
                and (dim is None or getattr(given.get("dim"), "value", None) == dim)):
            yield Edit(*source.span(call.func), ours)


def decorated(source: Source, function: str, decorator: str) -> Iterator[Edit]:
    """A function at the top of a module that has no decorator gets one."""
    for node in on_top(source.tree):
        if isinstance(node, ast.FunctionDef) and node.name == function and not node.decorator_list:
            start, _ = source.span(node)
            yield Edit(start, start, f"@{decorator}{source.newline}{source.indent(node)}")


def weights_only(source: Source) -> Iterator[Edit]:
    for call in source.calls("torch.load"):
        given = [*call.args, *keywords_of(call).values()]
        if given and "weights_only" not in keywords_of(call):
            _, end = source.span(call)
            _, last = max(map(source.span, given), key=lambda span: span[1])
            last = re.compile(rb"(\s*\))*").match(source.text, last, end - 1).end()  # behind its parentheses
            yield Edit(last, last, ", weights_only=False")


def unsigned_bytes(source: Source) -> Iterator[Edit]:
    """`dtype=np.byte` becomes `dtype=np.uint8`."""
    for node in source.nodes(ast.keyword):
        if node.arg == "dtype" and dotted(node.value) in ("np.byte", "numpy.byte") and source.is_placed(node.value):
            _, end = source.span(node.value)
            yield Edit(end - len("byte"), end, "uint8")


def builtin_types(source: Source) -> Iterator[Edit]:
    """`np.int` becomes `int`."""
    for node in source.nodes(ast.Attribute):
        if re.fullmatch(r"(np|numpy)\.(int|float|bool|object)", dotted(node)) and source.is_placed(node):
            yield Edit(*source.span(node), node.attr)


def optional_import(source: Source, names: Collection[str]) -> Iterator[Edit]:
    """`import wandb` at the top of a module becomes `wandb = optional_import("wandb")`."""
    for line in on_top(source.tree):
        if isinstance(line, ast.Import) and len(line.names) == 1 and not line.names[0].asname:
            name = line.names[0].name
            if name in names:
                yield from _behind_import(source, line, "optional_import")
                yield Edit(*source.span(line), f'{name} = optional_import("{name}")')


def lpips_when_used(source: Source) -> Iterator[Edit]:
    """`name = lpips.LPIPS(...)...` at the top of a module is made when it is called first."""
    for line in on_top(source.tree):
        made = getattr(line, "value", None)
        while isinstance(made, ast.Call) and isinstance(made.func, ast.Attribute) and isinstance(
                made.func.value, ast.Call):  # .to('cuda'), .eval()
            made = made.func.value
        if isinstance(line, ast.Assign) and isinstance(made, ast.Call) and dotted(made.func) == "lpips.LPIPS":
            start, end = source.span(line.value)
            yield from _behind_import(source, line, "deferred, nan_without_network")
            yield Edit(start, start, "nan_without_network(deferred(lambda: ")
            yield Edit(end, end, "))")


def _behind_import(source: Source, line: ast.stmt, names: str) -> Iterator[Edit]:
    """An import from runtime.py above a line, and below the comments above it."""
    start, _ = source.span(line)
    indent = source.indent(line)
    between = "; " if indent.strip() else f"{source.newline}{indent}"  # such as behind `else:`
    yield Edit(start, start, f"from {RUNTIME} import {names}{between}")


def without_standard(source: Source) -> Iterator[Edit]:
    """The flag goes: torch gives the compiler the standard that it needs itself where nobody does."""
    for flags in source.nodes(ast.List):
        spans = [source.span(flag) for flag in flags.elts]
        for place, flag in enumerate(flags.elts):
            if getattr(flag, "value", None) == "-std=c++14":
                start, end = spans[place]
                if place:  # with the comma before it, else with that behind it
                    start = spans[place - 1][1]
                elif len(spans) > 1:
                    end = spans[1][0]
                yield Edit(start, end, "")


NEVER_NEEDED = ("lpips", "wandb", "websockets")
ON_REQUEST = {  # by option
    "modernise": (
        Rule("checkpoint-load",
             "torch 2.6 and later load tensors alone unless told otherwise; checkpoints hold numpy numbers too",
             weights_only, hints=("torch.load",)),
        *(Rule(name, reason, partial(renamed_import, foreign=foreign, ours=ours, names=names),
               hints=(foreign.partition(".")[0],))
          for name, foreign, ours, names, reason in (
              ("simple-knn", "simple_knn._C", PACKAGE, ["distCUDA2"],
               "distCUDA2 is in this package, for CUDA and CPU: one extension less to compile"),
              ("fused-ssim", "fused_ssim", PACKAGE, ["fused_ssim"],
               "fused_ssim is in this package: one extension less to compile"),
              ("torch-scatter", "torch_scatter", f"{INTEGRATIONS}.torch_scatter", ["scatter", "scatter_max"],
               "torch_scatter has no builds for new torch releases, and torch has what is used of it"),
              ("weighted-distance", "weighted_distance._C", f"{INTEGRATIONS}.weighted_distance", ["weightedDistance"],
               "torch finds the nearest row of a codebook too: one extension less to compile"))),
        Rule("optional-import", "every run imports wandb, websockets or lpips, but only an option or a metric uses "
             "them", partial(optional_import, names=NEVER_NEEDED), hints=NEVER_NEEDED),
        Rule("lpips-when-used",
             "the network of LPIPS was built, and its weights downloaded, when the script was imported",
             lpips_when_used, hints=("lpips.LPIPS",)),
        Rule("lpips-offline", "where the weights of LPIPS could not be downloaded, a measurement ended the training",
             partial(decorated, function="lpips", decorator="nan_without_network"), hints=("def lpips",),
             imports=(RUNTIME, "nan_without_network")),
        Rule("blender-images", "new Pillow releases take no signed bytes for a picture", unsigned_bytes,
             hints=("np.byte", "numpy.byte")),
        Rule("numpy-types", "NumPy 1.24 and later have no np.int, np.float, np.bool and np.object", builtin_types,
             hints=("np.", "numpy.")),
        Rule("eigh-in-parts", "cuSOLVER of CUDA 12.8 and later fails on the many covariances that c3dgs gives it at "
             "once", partial(call_of_ours, foreign="torch.linalg.eigh", ours="eigh_in_parts", positional=2,
                             keywords=("UPLO",)), hints=("linalg.eigh",), imports=(RUNTIME, "eigh_in_parts")),
        Rule("unique-rows", "torch.unique(dim=0) can fail on CUDA where processes share a GPU: its merge sort has a "
             "race", partial(call_of_ours, foreign="torch.unique", ours="unique_rows", positional=5, dim=0,
                             keywords=("sorted", "return_inverse", "return_counts", "dim")), hints=("torch.unique",),
             imports=(RUNTIME, "unique_rows")),
        Rule("cpp-standard", "C++14 was asked for; torch 2.1 needs C++17, 2.13 C++20, and asks for it itself",
             without_standard, hints=("c++14",))),
    "fuse": (
        Rule("fused-loss", "the five convolutions of SSIM and their gradients are two kernels here",
             partial(decorated, function="ssim", decorator="fused_where_equal"), hints=("def ssim",),
             imports=(RUNTIME, "fused_where_equal")),
        Rule("fused-adam", "a step of Adam reads and writes every Gaussian once instead of a dozen times",
             partial(call_of_ours, foreign="torch.optim.Adam", ours="FusedAdam", positional=4,
                     keywords=("lr", "betas", "eps")), hints=("torch.optim.Adam",), imports=(PACKAGE, "FusedAdam"))),
}
