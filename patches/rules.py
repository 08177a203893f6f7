"""The rules of a patch: how each changes a syntax tree (LibCST keeps comments, blanks and quotes as they are).

A change takes a tree. It returns the tree that the rule makes of it; the same tree where that is done already; None
where it has nothing of what the rule looks for.
"""
from __future__ import annotations

from functools import partial
from typing import Callable, Collection, Dict, List, NamedTuple, Optional, Sequence, Tuple

import libcst as cst
import libcst.matchers as m
from libcst.codemod import CodemodContext
from libcst.codemod.visitors import AddImportsVisitor, ImportItem
from libcst.helpers import get_full_name_for_node
from libcst.metadata import MetadataWrapper, ScopeProvider

from .trainers import ARGUMENTS, GR, INTEGRATIONS, PACKAGE, RASTERIZER, RUNTIME, Entry, Trainer

Changed = Optional[cst.Module]


class Misfit(Exception):
    """What has to be patched is there in a form that the rule does not know."""


class Rule(NamedTuple):
    name: str
    says: str  # what it looks for; of a rule on request why it does
    change: Callable[[cst.Module], Changed]
    file: str = ""  # in which it has to match; a rule on request looks at all files
    hints: Tuple[str, ...] = ()  # of which such a file has one


def rules_of(trainer: Trainer) -> List[Rule]:
    """The rules of a trainer; each has to match."""
    return [
        Rule("import-rasterizer", f"`from {RASTERIZER} import ...`",
             partial(rasterizer_import, flavour=trainer.flavour), GR),
        Rule("settings-blend-mode", "a call of GaussianRasterizationSettings by keyword, in a function whose pipeline "
             "argument it names in `debug=pipe.debug`", settings_blend, GR),
        # Of the groups of options only ModelParams is saved in cfg_args.
        Rule("model-parameter", "a class ModelParams whose __init__ has the statement `super().__init__(...)`",
             model_options, ARGUMENTS),
        *(Rule("pipe-blend-mode", f"a function {entry.function} with the parameters {entry.dataset} and {entry.pipe}",
               partial(pipe_blend, entry=entry), entry.file) for entry in trainer.entries)]


class _Each(cst.CSTTransformer):
    """Gives each node that matches to change(original, updated)."""

    def __init__(self, matcher: m.BaseMatcherNode, change: Callable, on_top: bool) -> None:
        super().__init__()
        self.kind, self.matcher, self.change, self.on_top = type(matcher).__name__, matcher, change, on_top
        self.has_matched = self.has_changed = False

    def on_visit(self, node: cst.CSTNode) -> bool:
        return not (self.on_top and isinstance(node, (cst.FunctionDef, cst.ClassDef, cst.Try)))

    def on_leave(self, original_node: cst.CSTNode, updated_node: cst.CSTNode):
        if type(original_node).__name__ != self.kind or not m.matches(original_node, self.matcher):
            return updated_node
        changed = self.change(original_node, updated_node)
        self.has_matched |= changed is not None
        self.has_changed |= changed not in (None, updated_node)
        return updated_node if changed is None else changed


def each(tree, matcher: m.BaseMatcherNode, change: Callable, on_top: bool = False):
    """Changes each node that matches; what change returns means what the result of a rule means.

    on_top: no nodes that are inside of functions, classes and `try`.
    """
    transformer = _Each(matcher, change, on_top)
    changed = tree.visit(transformer)
    return changed if transformer.has_changed else tree if transformer.has_matched else None


def named(*names: str) -> m.MatchIfTrue:
    """Matches one of these names with dots in them, and calls of it."""
    return m.MatchIfTrue(lambda node: get_full_name_for_node(node) in names)


def one_of(*names: str) -> m.OneOf:
    return m.OneOf(*map(m.Name, names))


def with_import(new: Changed, old: cst.Module, source: str, name: str) -> Changed:
    """Returns a tree with `from source import name` at its top, where it is not the old one."""
    if new in (None, old):
        return new
    return AddImportsVisitor(CodemodContext(), [ImportItem(source, name)]).transform_module(new)


def with_line(function: cst.FunctionDef, place: int, text: str) -> cst.FunctionDef:
    """Returns a function with one more statement, or as it is where it has that."""
    line, lines = cst.parse_statement(text), function.body.body
    if any(m.matches(other, m.SimpleStatementLine()) and other.body[0].deep_equals(line.body[0]) for other in lines):
        return function
    return function.with_deep_changes(function.body, body=[*lines[:place], line, *lines[place:]])


def keywords_of(call: cst.Call) -> Dict[str, cst.BaseExpression]:
    return {argument.keyword.value: argument.value for argument in call.args if argument.keyword}


def renamed_import(tree: cst.Module, foreign: str, ours: str, names: Collection[str] = ()) -> Changed:
    """`from FOREIGN import NAMES` takes the names from OURS, where it has all of them (none given: it has)."""
    def change(_, node: cst.ImportFrom) -> Optional[cst.ImportFrom]:
        if names and (isinstance(node.names, cst.ImportStar)
                      or not {alias.evaluated_name for alias in node.names} <= set(names)):
            return None
        return node.with_changes(module=cst.parse_expression(ours))

    return each(tree, m.ImportFrom(module=named(foreign), relative=[]), change)


def rasterizer_import(tree: cst.Module, flavour: str) -> Changed:
    ours = f"{INTEGRATIONS}.{flavour}"
    done = tree if m.findall(tree, m.ImportFrom(module=named(ours), relative=[])) else None
    return renamed_import(tree, RASTERIZER, ours) or done


def settings_blend(tree: cst.Module) -> Changed:
    """The settings call gets `**pipe.blend`; `pipe` is the parameter that its `debug=pipe.debug` names."""
    wrapper = MetadataWrapper(tree)
    scopes = wrapper.resolve(ScopeProvider)
    misfits = 0

    def change(original: cst.Call, call: cst.Call) -> cst.Call:
        nonlocal misfits
        given = keywords_of(call)
        debug = given.get("debug")
        pipe = debug.value.value if m.matches(debug, m.Attribute(value=m.Name(), attr=m.Name("debug"))) else ""
        is_parameter = any(isinstance(getattr(known, "node", None), cst.Param) for known in scopes[original][pipe])
        blend = m.Arg(star="**", value=named(f"{pipe}.blend"))
        if is_parameter and any(m.matches(argument, blend) for argument in call.args):
            return call
        if not is_parameter or "blend_mode" in given or len(given) != len(call.args):
            misfits += 1
            return call
        first = cst.Arg(cst.parse_expression(f"{pipe}.blend"), star="**", comma=comma_before(call))
        return call.with_changes(args=[first, *call.args])

    changed = each(wrapper.module, m.Call(func=m.Name("GaussianRasterizationSettings")), change)
    if misfits:
        raise Misfit(f"{misfits} that look alike")
    return tree if changed is wrapper.module else changed


def comma_before(call: cst.Call) -> cst.Comma:
    """Returns a comma with the line break and the indent that are before the arguments of a call, without a comment."""
    blank = call.whitespace_before_args
    if isinstance(blank, cst.ParenthesizedWhitespace):
        return cst.Comma(whitespace_after=cst.ParenthesizedWhitespace(indent=blank.indent, last_line=blank.last_line))
    return cst.Comma(whitespace_after=cst.SimpleWhitespace(" "))


def model_options(tree: cst.Module) -> Changed:
    """ModelParams gets a statement that makes the options --blend_mode and --background_gate of two attributes."""
    super_init = m.SimpleStatementLine(body=[m.Expr(m.Call(func=m.Attribute(
        value=m.Call(func=m.Name("super")), attr=m.Name("__init__")))), m.ZeroOrMore()])

    def in_init(_, init: cst.FunctionDef) -> Optional[cst.FunctionDef]:
        place = next((place for place, line in enumerate(init.body.body) if m.matches(line, super_init)), None)
        return place if place is None else with_line(
            init, place, "self.blend_mode, self.background_gate = default_blend()")

    def in_class(_, model: cst.ClassDef) -> Optional[cst.ClassDef]:
        body = each(model.body, m.FunctionDef(name=m.Name("__init__"), body=m.IndentedBlock()), in_init, on_top=True)
        return model if body is model.body else body and model.with_changes(body=body)

    changed = each(tree, m.ClassDef(name=m.Name("ModelParams"), body=m.IndentedBlock()), in_class, on_top=True)
    return with_import(changed, tree, RUNTIME, "default_blend")


def pipe_blend(tree: cst.Module, entry: Entry) -> Changed:
    """The function that gets both groups begins with `pipe.blend = blend_of(dataset)`."""
    docstring = m.SimpleStatementLine(body=[m.Expr(m.SimpleString() | m.ConcatenatedString()), m.ZeroOrMore()])

    def change(_, function: cst.FunctionDef) -> Optional[cst.FunctionDef]:
        parameters = {node.name.value for node in m.findall(function.params, m.Param())}
        if not {entry.dataset, entry.pipe} <= parameters:
            return None
        place = int(m.matches(function.body.body[0], docstring))
        return with_line(function, place, f"{entry.pipe}.blend = {entry.blend}({entry.dataset})")

    function = m.FunctionDef(name=m.Name(entry.function), body=m.IndentedBlock())
    return with_import(each(tree, function, change, on_top=True), tree, RUNTIME, entry.blend)


# Rules on request.

def call_of_ours(tree: cst.Module, foreign: str, ours: str, positional: int, keywords: Collection[str],
                 source: str = RUNTIME, dim: Optional[str] = None) -> Changed:
    """`FOREIGN(...)` becomes `OURS(...)`, imported from SOURCE, where it has no other arguments than these.

    positional: how many at most. dim: the value of this keyword. Nothing changes in a module where something else has
    that name.
    """
    scopes = set(MetadataWrapper(tree).resolve(ScopeProvider).values()) - {None}
    if {known.name for scope in scopes for known in scope.get_qualified_names_for(ours)} - {f"{source}.{ours}"}:
        return None

    def change(_, call: cst.Call) -> Optional[cst.Call]:
        given = keywords_of(call)
        if (set(given) - set(keywords) or len(call.args) - len(given) > positional
                or any(argument.star for argument in call.args)
                or dim is not None and not m.matches(given.get("dim"), m.Integer(dim))):
            return None
        return call.with_changes(func=cst.Name(ours))

    return with_import(each(tree, m.Call(func=named(foreign)), change), tree, source, ours)


def decorated(tree: cst.Module, function: str, decorator: str) -> Changed:
    """A function at the top of a module that has no decorator gets one of runtime.py."""
    def change(_, node: cst.FunctionDef) -> Optional[cst.FunctionDef]:
        return None if node.decorators else node.with_changes(decorators=[cst.Decorator(cst.Name(decorator))])

    return with_import(each(tree, m.FunctionDef(name=m.Name(function)), change, on_top=True), tree, RUNTIME, decorator)


def weights_only(tree: cst.Module) -> Changed:
    def change(_, call: cst.Call) -> Optional[cst.Call]:
        if not call.args or "weights_only" in keywords_of(call):
            return None
        *before, last = call.args
        more = cst.parse_expression("f(weights_only=False)").args[0].with_changes(
            comma=last.comma, whitespace_after_arg=last.whitespace_after_arg)
        last = last.with_changes(comma=cst.Comma(whitespace_after=cst.SimpleWhitespace(" ")),
                                 whitespace_after_arg=cst.SimpleWhitespace(""))
        return call.with_changes(args=[*before, last, more])

    return each(tree, m.Call(func=named("torch.load")), change)


def unsigned_bytes(tree: cst.Module) -> Changed:
    """`dtype=np.byte` becomes `dtype=np.uint8`."""
    return each(tree, m.Arg(keyword=m.Name("dtype"), value=named("np.byte", "numpy.byte")),
                lambda _, argument: argument.with_deep_changes(argument.value, attr=cst.Name("uint8")))


def builtin_types(tree: cst.Module) -> Changed:
    """`np.int` becomes `int`."""
    old = m.Attribute(value=named("np", "numpy"), attr=one_of("int", "float", "bool", "object"))
    return each(tree, old, lambda _, name: name.attr)


def optional_import(tree: cst.Module, names: Sequence[str]) -> Changed:
    """`import wandb` at the top of a module becomes `wandb = optional_import("wandb")`."""
    def change(_, line: cst.SimpleStatementLine) -> cst.FlattenSentinel:
        name = line.body[0].names[0].evaluated_name
        return after_import(line, "optional_import", cst.parse_statement(f'{name} = optional_import("{name}")').body)

    alias = m.ImportAlias(name=one_of(*names), asname=None)
    return each(tree, m.SimpleStatementLine(body=[m.Import(names=[alias])]), change, on_top=True)


def lpips_when_used(tree: cst.Module) -> Changed:
    """`name = lpips.LPIPS(...)...` at the top of a module is made when it is called first."""
    def change(_, line: cst.SimpleStatementLine) -> cst.FlattenSentinel:
        made = cst.parse_expression("nan_without_network(deferred(lambda: None))")
        made = made.with_deep_changes(made.args[0].value.args[0].value, body=line.body[0].value)
        return after_import(line, "deferred, nan_without_network", [line.body[0].with_changes(value=made)])

    value = network = m.Call(func=named("lpips.LPIPS"))
    for _ in range(2):  # .to('cuda'), .eval()
        network = m.Call(func=m.Attribute(value=network))
        value |= network
    return each(tree, m.SimpleStatementLine(body=[m.Assign(value=value)]), change, on_top=True)


def after_import(line: cst.SimpleStatementLine, names: str, body: Sequence[cst.BaseSmallStatement]):
    """Returns an import from runtime.py and the line with another body; the comments above it stay above both."""
    return cst.FlattenSentinel([
        cst.parse_statement(f"from {RUNTIME} import {names}").with_changes(leading_lines=line.leading_lines),
        line.with_changes(leading_lines=[], body=body)])


def without_standard(tree: cst.Module) -> Changed:
    """The flag goes: torch gives the compiler the standard that it needs itself where nobody does."""
    def change(_, flags: cst.List) -> Optional[cst.List]:
        kept: List[cst.BaseElement] = []
        for flag in flags.elements:
            if not m.matches(flag.value, m.SimpleString()) or flag.value.evaluated_value != "-std=c++14":
                kept.append(flag)
            elif kept:  # what follows the flag, comma and line break, follows the word before it then
                kept[-1] = kept[-1].with_changes(comma=flag.comma)
        return None if len(kept) == len(flags.elements) else flags.with_changes(elements=kept)

    return each(tree, m.List(), change)


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
             partial(decorated, function="lpips", decorator="nan_without_network"), hints=("def lpips",)),
        Rule("blender-images", "new Pillow releases take no signed bytes for a picture", unsigned_bytes,
             hints=("np.byte", "numpy.byte")),
        Rule("numpy-types", "NumPy 1.24 and later have no np.int, np.float, np.bool and np.object", builtin_types,
             hints=("np.", "numpy.")),
        Rule("eigh-in-parts", "cuSOLVER of CUDA 12.8 and later fails on the many covariances that c3dgs gives it at "
             "once", partial(call_of_ours, foreign="torch.linalg.eigh", ours="eigh_in_parts", positional=2,
                             keywords=("UPLO",)), hints=("linalg.eigh",)),
        Rule("unique-rows", "torch.unique(dim=0) can fail on CUDA where processes share a GPU: its merge sort has a "
             "race", partial(call_of_ours, foreign="torch.unique", ours="unique_rows", positional=5, dim="0",
                             keywords=("sorted", "return_inverse", "return_counts", "dim")), hints=("torch.unique",)),
        Rule("cpp-standard", "C++14 was asked for; torch 2.1 needs C++17, 2.13 C++20, and asks for it itself",
             without_standard, hints=("c++14",))),
    "fuse": (
        Rule("fused-loss", "the five convolutions of SSIM and their gradients are two kernels here",
             partial(decorated, function="ssim", decorator="fused_where_equal"), hints=("def ssim",)),
        Rule("fused-adam", "a step of Adam reads and writes every Gaussian once instead of a dozen times",
             partial(call_of_ours, foreign="torch.optim.Adam", ours="FusedAdam", source=PACKAGE, positional=4,
                     keywords=("lr", "betas", "eps")), hints=("torch.optim.Adam",))),
}
