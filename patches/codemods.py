"""How each kind of rule changes a syntax tree (LibCST keeps all that it does not touch: comments, blanks, quotes).

A codemod takes a tree and a Found, in which it counts. It returns the tree with the rule applied.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Collection, Dict, List, Optional

import libcst as cst
import libcst.matchers as m
from libcst.codemod import CodemodContext
from libcst.codemod.visitors import AddImportsVisitor, ImportItem
from libcst.helpers import get_full_name_for_node
from libcst.metadata import MetadataWrapper, ScopeProvider

from .trainers import INTEGRATIONS, RASTERIZER, RUNTIME, Entry

SETTINGS = m.Call(func=m.Name("GaussianRasterizationSettings"))
SUPER_INIT = m.SimpleStatementLine(body=[m.Expr(m.Call(func=m.Attribute(
    value=m.Call(func=m.Name("super")), attr=m.Name("__init__")))), m.ZeroOrMore()])
DOCSTRING = m.SimpleStatementLine(body=[m.Expr(m.SimpleString() | m.ConcatenatedString()), m.ZeroOrMore()])
MODEL_LINE = "self.blend_mode, self.background_gate = default_blend()"


@dataclass
class Found:
    """How often a rule matches in a file."""

    pending: int = 0  # where it was not applied yet
    done: int = 0  # where it was
    misfits: int = 0  # what has to be patched, but has another form than the rule knows


def named(*names: str) -> m.MatchIfTrue:
    """Matches one of these names with dots in them, and calls of it."""
    return m.MatchIfTrue(lambda node: get_full_name_for_node(node) in names)


class _EachNode(cst.CSTTransformer):
    def __init__(self, matcher: m.BaseMatcherNode, change: Callable, into=cst.CSTNode) -> None:
        super().__init__()
        self.kind, self.matcher, self.change, self.into = type(matcher).__name__, matcher, change, into

    def on_visit(self, node: cst.CSTNode) -> bool:
        return isinstance(node, self.into)

    def on_leave(self, original_node: cst.CSTNode, updated_node: cst.CSTNode) -> cst.CSTNode:
        if type(original_node).__name__ == self.kind and m.matches(original_node, self.matcher):
            return self.change(original_node, updated_node)
        return updated_node


def each_node(tree: cst.Module, matcher: m.BaseMatcherNode, change: Callable) -> cst.Module:
    """Returns the tree with change(original, updated) for each node that matches."""
    return tree.visit(_EachNode(matcher, change))


def each_line(block, matcher: m.BaseMatcherNode, change: Callable):
    """Returns a module or block with the list change(line) for each of its lines that matches, also under an `if`."""
    return block.visit(_EachNode(matcher, lambda _, line: cst.FlattenSentinel(change(line)),
                                 into=(cst.Module, cst.IndentedBlock, cst.If, cst.Else)))


def statement(text: str) -> cst.SimpleStatementLine:
    return cst.parse_statement(text)


def with_line(block: cst.IndentedBlock, place: int, text: str) -> cst.IndentedBlock:
    """Returns a block with one more statement."""
    return block.with_changes(body=[*block.body[:place], statement(text), *block.body[place:]])


def has_line(block: cst.IndentedBlock, text: str) -> bool:
    """Whether it has that statement, whatever the comments around it."""
    wanted = statement(text).body[0]
    return any(m.matches(line, m.SimpleStatementLine(body=[m.DoNotCare()])) and line.body[0].deep_equals(wanted)
               for line in block.body)


def with_import(module: cst.Module, source: str, name: str) -> cst.Module:
    """Returns the module with `from source import name` at its top, unless it is there."""
    return AddImportsVisitor(CodemodContext(), [ImportItem(source, name)]).transform_module(module)


def keywords_of(call: cst.Call) -> Dict[str, cst.BaseExpression]:
    return {argument.keyword.value: argument.value for argument in call.args if argument.keyword}


def renamed_import(tree: cst.Module, found: Found, foreign: str, ours: str,
                   names: Optional[Collection[str]] = None) -> cst.Module:
    """`from FOREIGN import NAMES` takes the names from OURS, where it has all of them (None: it has)."""
    def change(_, node: cst.ImportFrom) -> cst.ImportFrom:
        if names is not None and (isinstance(node.names, cst.ImportStar)
                                  or not {alias.evaluated_name for alias in node.names} <= set(names)):
            return node
        found.pending += 1
        return node.with_changes(module=cst.parse_expression(ours))

    return each_node(tree, m.ImportFrom(module=named(foreign), relative=[]), change)


def rasterizer_import(tree: cst.Module, found: Found, flavour: str) -> cst.Module:
    ours = f"{INTEGRATIONS}.{flavour}"
    found.done = len(m.findall(tree, m.ImportFrom(module=named(ours), relative=[])))
    return renamed_import(tree, found, RASTERIZER, ours)


def settings_blend(tree: cst.Module, found: Found) -> cst.Module:
    """The settings call gets `**pipe.blend`; `pipe` is the parameter that its `debug=pipe.debug` names."""
    wrapper = MetadataWrapper(tree)
    scopes = wrapper.resolve(ScopeProvider)

    def change(original: cst.Call, call: cst.Call) -> cst.Call:
        given = keywords_of(call)
        debug = m.extract(given.get("debug", cst.Name("None")),
                          m.Attribute(value=m.SaveMatchedNode(m.Name(), "pipe"), attr=m.Name("debug")))
        pipe = debug["pipe"].value if debug else ""
        is_parameter = any(isinstance(getattr(known, "node", None), cst.Param) for known in scopes[original][pipe])
        if is_parameter and any(m.matches(argument, m.Arg(star="**", value=named(f"{pipe}.blend")))
                                for argument in call.args):
            found.done += 1
        elif not is_parameter or "blend_mode" in given or len(given) != len(call.args):
            found.misfits += 1
        else:
            found.pending += 1
            first = cst.Arg(cst.parse_expression(f"{pipe}.blend"), star="**", comma=comma_before(call))
            return call.with_changes(args=[first, *call.args])
        return call

    return each_node(wrapper.module, SETTINGS, change)


def comma_before(call: cst.Call) -> cst.Comma:
    """Returns a comma with the line break and the indent that are before the arguments of a call, without a comment."""
    blank = call.whitespace_before_args
    if isinstance(blank, cst.ParenthesizedWhitespace):
        return cst.Comma(whitespace_after=cst.ParenthesizedWhitespace(indent=blank.indent, last_line=blank.last_line))
    return cst.Comma(whitespace_after=cst.SimpleWhitespace(" "))


def model_options(tree: cst.Module, found: Found) -> cst.Module:
    """ModelParams gets a statement that makes the options --blend_mode and --background_gate of two attributes."""
    def in_init(init: cst.FunctionDef) -> List[cst.FunctionDef]:
        if has_line(init.body, MODEL_LINE):
            found.done += 1
            return [init]
        places = [place for place, line in enumerate(init.body.body) if m.matches(line, SUPER_INIT)]
        found.pending += len(places)
        return [init.with_changes(body=with_line(init.body, places[0], MODEL_LINE)) if places else init]

    def in_class(model: cst.ClassDef) -> List[cst.ClassDef]:
        init = m.FunctionDef(name=m.Name("__init__"), body=m.IndentedBlock())
        return [model.with_changes(body=each_line(model.body, init, in_init))]

    tree = each_line(tree, m.ClassDef(name=m.Name("ModelParams"), body=m.IndentedBlock()), in_class)
    return with_import(tree, RUNTIME, "default_blend") if found.pending else tree


def pipe_blend(tree: cst.Module, found: Found, entry: Entry) -> cst.Module:
    """The function that gets both groups begins with `pipe.blend = blend_of(dataset)`."""
    line = f"{entry.pipe}.blend = {entry.blend}({entry.dataset})"

    def change(function: cst.FunctionDef) -> List[cst.FunctionDef]:
        parameters = {node.name.value for node in m.findall(function.params, m.Param())}
        if not {entry.dataset, entry.pipe} <= parameters:
            return [function]
        if has_line(function.body, line):
            found.done += 1
            return [function]
        found.pending += 1
        place = int(m.matches(function.body.body[0], DOCSTRING))
        return [function.with_changes(body=with_line(function.body, place, line))]

    tree = each_line(tree, m.FunctionDef(name=m.Name(entry.function), body=m.IndentedBlock()), change)
    return with_import(tree, RUNTIME, entry.blend) if found.pending else tree


def call_of_ours(tree: cst.Module, found: Found, foreign: str, ours: str, positional: int,
                 keywords: Collection[str] = (), source: str = RUNTIME,
                 fits: Callable[[Dict[str, cst.BaseExpression]], bool] = lambda given: True) -> cst.Module:
    """`FOREIGN(...)` becomes `OURS(...)`, imported from SOURCE, where it has no other arguments than these.

    positional: how many at most. fits: whether a call with these values of its keywords is one to change. Nothing
    changes in a module where something else has that name.
    """
    scopes = set(MetadataWrapper(tree).resolve(ScopeProvider).values()) - {None}
    if {known.name for scope in scopes for known in scope.get_qualified_names_for(ours)} - {f"{source}.{ours}"}:
        return tree

    def change(_, call: cst.Call) -> cst.Call:
        given = keywords_of(call)
        if (set(given) - set(keywords) or len(call.args) - len(given) > positional
                or any(argument.star for argument in call.args) or not fits(given)):
            return call
        found.pending += 1
        return call.with_changes(func=cst.Name(ours))

    found.done = len(m.findall(tree, m.Call(func=m.Name(ours))))
    tree = each_node(tree, m.Call(func=named(foreign)), change)
    return with_import(tree, source, ours) if found.pending else tree


def decorated(tree: cst.Module, found: Found, function: str, decorator: str) -> cst.Module:
    """A function at the top of a module that has no decorator gets one of runtime.py."""
    def change(node: cst.FunctionDef) -> List[cst.FunctionDef]:
        if node.decorators:
            found.done += any(m.matches(one, m.Decorator(m.Name(decorator))) for one in node.decorators)
            return [node]
        found.pending += 1
        return [node.with_changes(decorators=[cst.Decorator(cst.Name(decorator))])]

    tree = each_line(tree, m.FunctionDef(name=m.Name(function)), change)
    return with_import(tree, RUNTIME, decorator) if found.pending else tree
