"""How each kind of rule changes a syntax tree (LibCST keeps all that it does not touch: comments, blanks, quotes).

A codemod walks the tree once and counts where its rule still has to be applied and where it has been already. To write
another: take a kind of node, say in `leave_...` what it becomes, count, and add the class to CODEMODS.
"""
from __future__ import annotations

from typing import Dict, List, NamedTuple, Sequence, Tuple

import libcst as cst
from libcst.helpers import get_full_name_for_node

from .rules import INTEGRATIONS, RASTERIZER, RUNTIME, ImportRasterizer, ModelParameter, PipeBlendMode, SettingsBlendMode


class Outcome(NamedTuple):
    """What a rule found in a file."""

    tree: cst.Module  # with the rule applied
    pending: int  # matches that were not patched yet
    done: int  # matches that were
    misfits: int  # what has to be patched, but has another form than the rule knows


def run(rule, tree: cst.Module) -> Outcome:
    """Applies a rule to a tree."""
    return CODEMODS[type(rule)](rule).applied_to(tree)


def statement(text: str) -> cst.SimpleStatementLine:
    """Returns the tree of one line."""
    return cst.parse_statement(text)


class Codemod(cst.CSTTransformer):
    def __init__(self, rule) -> None:
        super().__init__()
        self.rule, self.pending, self.done, self.misfits = rule, 0, 0, 0
        self.within: List[cst.CSTNode] = []  # the classes and functions around the node, outermost first

    def applied_to(self, tree: cst.Module) -> Outcome:
        """Walks the tree, once in this object's life."""
        changed = tree.visit(self)
        return Outcome(changed, self.pending, self.done, self.misfits)

    def visit_ClassDef(self, node: cst.ClassDef) -> None:
        self.within.append(node)

    def visit_FunctionDef(self, node: cst.FunctionDef) -> None:
        self.within.append(node)

    def leave_ClassDef(self, original_node: cst.ClassDef, updated_node: cst.ClassDef) -> cst.ClassDef:
        self.within.pop()
        return updated_node

    def leave_FunctionDef(self, original_node: cst.FunctionDef, updated_node: cst.FunctionDef) -> cst.FunctionDef:
        self.within.pop()
        return self.changed_function(updated_node)

    def changed_function(self, function: cst.FunctionDef) -> cst.FunctionDef:
        return function

    def insert(self, block, index: int, line: str):
        """Returns the block with one more statement, and counts it."""
        self.pending += 1
        return block.with_changes(body=[*block.body[:index], statement(line), *block.body[index:]])


class _ImportRasterizer(Codemod):
    def leave_ImportFrom(self, original_node: cst.ImportFrom, updated_node: cst.ImportFrom) -> cst.ImportFrom:
        ours = f"{INTEGRATIONS}.{self.rule.flavour}"
        module = get_full_name_for_node(updated_node.module) if updated_node.module else None
        if module == ours and not updated_node.relative:
            self.done += 1
        elif module == RASTERIZER and not updated_node.relative:
            self.pending += 1
            return updated_node.with_changes(module=cst.parse_expression(ours))
        return updated_node


class _SettingsBlendMode(Codemod):
    def leave_Call(self, original_node: cst.Call, updated_node: cst.Call) -> cst.Call:
        if not is_name(updated_node.func, "GaussianRasterizationSettings"):
            return updated_node
        arguments = {argument.keyword.value: argument.value for argument in updated_node.args if argument.keyword}
        pipe = self.pipe_of(arguments)
        wanted = cst.parse_expression(f"{pipe}.blend") if pipe else None
        if wanted is not None and any(one.star == "**" and one.value.deep_equals(wanted) for one in updated_node.args):
            self.done += 1
            return updated_node
        if wanted is None or "blend_mode" in arguments or len(arguments) != len(updated_node.args):
            self.misfits += 1
            return updated_node
        self.pending += 1
        # Before the last one: then every comma, comment and closing parenthesis stays where it is.
        *before, last = updated_node.args
        more = cst.Arg(wanted, star="**", comma=comma_after(before))
        return updated_node.with_changes(args=[*before, more, last])

    def pipe_of(self, arguments):
        """Returns the name in `debug=name.debug` if it is a parameter of a function around the call."""
        debug = arguments.get("debug")
        if not isinstance(debug, cst.Attribute) or not isinstance(debug.value, cst.Name) or debug.attr.value != "debug":
            return None
        parameters = [name for node in self.within if isinstance(node, cst.FunctionDef) for name in parameters_of(node)]
        return debug.value.value if debug.value.value in parameters else None


class _ModelParameter(Codemod):
    LINE = "self.blend_mode, self.background_gate = default_blend()"

    def changed_function(self, function: cst.FunctionDef) -> cst.FunctionDef:
        is_it = (function.name.value == "__init__" and isinstance(function.body, cst.IndentedBlock)
                 and len(self.within) == 1 and isinstance(self.within[0], cst.ClassDef)
                 and self.within[0].name.value == "ModelParams")
        if not is_it:
            return function
        lines = function.body.body
        if has_line(lines, self.LINE):
            self.done += 1
            return function
        supers = [index for index, line in enumerate(lines) if is_super_init(line)]
        for index in reversed(supers):
            function = function.with_changes(body=self.insert(function.body, index, self.LINE))
        return function

    def leave_Module(self, original_node: cst.Module, updated_node: cst.Module) -> cst.Module:
        return with_import(updated_node, RUNTIME, "default_blend") if self.pending else updated_node


class _PipeBlendMode(Codemod):
    def changed_function(self, function: cst.FunctionDef) -> cst.FunctionDef:
        rule, block = self.rule, function.body
        parameters = parameters_of(function)
        is_it = (not self.within and function.name.value == rule.function and rule.dataset in parameters
                 and rule.pipe in parameters and isinstance(block, cst.IndentedBlock))
        if not is_it:
            return function
        line = f"{rule.pipe}.blend = blend_of({rule.dataset})"
        if has_line(block.body, line):
            self.done += 1
            return function
        return function.with_changes(body=self.insert(block, int(is_docstring(block.body[0])), line))

    def leave_Module(self, original_node: cst.Module, updated_node: cst.Module) -> cst.Module:
        return with_import(updated_node, RUNTIME, "blend_of") if self.pending else updated_node


class CallOfOurs(Codemod):
    """`FOREIGN(...)` becomes `OURS(...)`, imported from SOURCE, where it has no other arguments than these.

    Nothing changes in a module where something else has that name.
    """

    foreign = ours = ""
    source = RUNTIME
    positional = 1  # at most
    keywords: Tuple[str, ...] = ()
    is_taken = False

    def visit_ImportFrom(self, node: cst.ImportFrom) -> bool:
        return node.module is None or get_full_name_for_node(node.module) != self.source  # ours are not looked into

    def visit_ImportAlias(self, node: cst.ImportAlias) -> None:
        self.is_taken |= self.ours == (node.evaluated_alias or node.evaluated_name)

    def visit_ClassDef(self, node: cst.ClassDef) -> None:
        super().visit_ClassDef(node)
        self.is_taken |= is_name(node.name, self.ours)

    def visit_FunctionDef(self, node: cst.FunctionDef) -> None:
        super().visit_FunctionDef(node)
        self.is_taken |= is_name(node.name, self.ours)

    def visit_AssignTarget(self, node: cst.AssignTarget) -> None:
        self.is_taken |= is_name(node.target, self.ours)

    def visit_AnnAssign(self, node: cst.AnnAssign) -> None:
        self.is_taken |= is_name(node.target, self.ours)

    def fits(self, given: Dict[str, cst.BaseExpression]) -> bool:
        """Whether a call with these values of its keywords is one to change."""
        return True

    def leave_Call(self, original_node: cst.Call, updated_node: cst.Call) -> cst.Call:
        given = {argument.keyword.value: argument.value for argument in updated_node.args if argument.keyword}
        self.done += is_name(updated_node.func, self.ours)
        if (get_full_name_for_node(updated_node.func) != self.foreign or not set(given) <= set(self.keywords)
                or len(updated_node.args) - len(given) > self.positional
                or any(argument.star for argument in updated_node.args) or not self.fits(given)):
            return updated_node
        self.pending += 1
        return updated_node.with_changes(func=cst.Name(self.ours))

    def leave_Module(self, original_node: cst.Module, updated_node: cst.Module) -> cst.Module:
        if self.is_taken:
            self.pending = self.done = 0
            return original_node
        return with_import(updated_node, self.source, self.ours) if self.pending else updated_node


class Decorated(Codemod):
    """A function at the top of a module that has no decorator gets one of runtime.py."""

    function = decorator = ""

    def changed_function(self, function: cst.FunctionDef) -> cst.FunctionDef:
        if self.within or function.name.value != self.function:
            return function
        self.done += any(is_name(decorator.decorator, self.decorator) for decorator in function.decorators)
        if function.decorators:
            return function
        self.pending += 1
        return function.with_changes(decorators=[cst.Decorator(cst.Name(self.decorator))])

    def leave_Module(self, original_node: cst.Module, updated_node: cst.Module) -> cst.Module:
        return with_import(updated_node, RUNTIME, self.decorator) if self.pending else updated_node


CODEMODS = {ImportRasterizer: _ImportRasterizer, SettingsBlendMode: _SettingsBlendMode, ModelParameter: _ModelParameter,
            PipeBlendMode: _PipeBlendMode}


def is_name(node: cst.CSTNode, name: str) -> bool:
    return isinstance(node, cst.Name) and node.value == name


def parameters_of(function: cst.FunctionDef) -> List[str]:
    groups = function.params
    return [parameter.name.value for parameter in (*groups.posonly_params, *groups.params, *groups.kwonly_params)]


def has_line(lines: Sequence[cst.CSTNode], text: str) -> bool:
    """Whether one of the lines is that statement, whatever the comments around it."""
    wanted = statement(text).body[0]
    return any(isinstance(line, cst.SimpleStatementLine) and len(line.body) == 1 and line.body[0].deep_equals(wanted)
               for line in lines)


def is_docstring(line: cst.CSTNode) -> bool:
    return (isinstance(line, cst.SimpleStatementLine) and isinstance(line.body[0], cst.Expr)
            and isinstance(line.body[0].value, (cst.SimpleString, cst.ConcatenatedString)))


def is_super_init(line: cst.CSTNode) -> bool:
    if not isinstance(line, cst.SimpleStatementLine) or not isinstance(line.body[0], cst.Expr):
        return False
    call = line.body[0].value
    return (isinstance(call, cst.Call) and isinstance(call.func, cst.Attribute) and call.func.attr.value == "__init__"
            and isinstance(call.func.value, cst.Call) and is_name(call.func.value.func, "super"))


def comma_after(arguments: Sequence[cst.Arg]) -> cst.Comma:
    """Returns a comma as the last of the arguments has it, line break and indent, without its comment."""
    if not arguments or not isinstance(arguments[-1].comma, cst.Comma):
        return cst.Comma(whitespace_after=cst.SimpleWhitespace(" "))
    comma = arguments[-1].comma
    if isinstance(comma.whitespace_after, cst.ParenthesizedWhitespace):
        return cst.Comma(whitespace_after=cst.ParenthesizedWhitespace(indent=comma.whitespace_after.indent,
                                                                      last_line=comma.whitespace_after.last_line))
    return comma


def with_import(module: cst.Module, source: str, name: str) -> cst.Module:
    """Returns the module with `from source import name` after the imports at its top, unless it is there."""
    line = f"from {source} import {name}"
    if has_line(module.body, line):
        return module
    place = int(bool(module.body) and is_docstring(module.body[0]))
    for index, node in enumerate(module.body):
        if isinstance(node, (cst.FunctionDef, cst.ClassDef, cst.If)):
            break
        if isinstance(node, cst.SimpleStatementLine) and isinstance(node.body[0], (cst.Import, cst.ImportFrom)):
            place = index + 1
    return module.with_changes(body=[*module.body[:place], statement(line), *module.body[place:]])
