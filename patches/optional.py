"""Rules that a patch has on request only. One that matches nothing is skipped.

--modernise: what a trainer needs to start on today's torch, CUDA and Python. --fuse: the same results by fewer kernels.
"""
from __future__ import annotations

from functools import partial
from typing import Callable, List, NamedTuple, Tuple

import libcst as cst
import libcst.matchers as m

from . import codemods
from .codemods import Found, call_of_ours, decorated, each_line, each_node, keywords_of, named, renamed_import
from .trainers import INTEGRATIONS, PACKAGE, RUNTIME


def weights_only(tree: cst.Module, found: Found) -> cst.Module:
    def change(_, call: cst.Call) -> cst.Call:
        if not call.args or "weights_only" in keywords_of(call):
            return call
        found.pending += 1
        *before, last = call.args
        more = cst.parse_expression("f(weights_only=False)").args[0].with_changes(
            comma=last.comma, whitespace_after_arg=last.whitespace_after_arg)
        last = last.with_changes(comma=cst.Comma(whitespace_after=cst.SimpleWhitespace(" ")),
                                 whitespace_after_arg=cst.SimpleWhitespace(""))
        return call.with_changes(args=[*before, last, more])

    return each_node(tree, m.Call(func=named("torch.load")), change)


def unsigned_bytes(tree: cst.Module, found: Found) -> cst.Module:
    """`dtype=np.byte` becomes `dtype=np.uint8`."""
    def change(_, argument: cst.Arg) -> cst.Arg:
        found.pending += 1
        return argument.with_changes(value=argument.value.with_changes(attr=cst.Name("uint8")))

    return each_node(tree, m.Arg(keyword=m.Name("dtype"), value=named("np.byte", "numpy.byte")), change)


def builtin_types(tree: cst.Module, found: Found) -> cst.Module:
    """`np.int` becomes `int`."""
    def change(_, name: cst.Attribute) -> cst.Name:
        found.pending += 1
        return name.attr

    old = m.OneOf(*map(m.Name, ("int", "float", "bool", "object")))
    return each_node(tree, m.Attribute(value=named("np", "numpy"), attr=old), change)


def optional_import(tree: cst.Module, found: Found, names: Tuple[str, ...]) -> cst.Module:
    """`import wandb` at the top of a module becomes `wandb = optional_import("wandb")`."""
    def change(line: cst.SimpleStatementLine) -> List[cst.SimpleStatementLine]:
        found.pending += 1
        name = line.body[0].names[0].evaluated_name
        return after_import(line, "optional_import", f'{name} = optional_import("{name}")')

    alias = m.ImportAlias(name=m.OneOf(*map(m.Name, names)), asname=None)
    return each_line(tree, m.SimpleStatementLine(body=[m.Import(names=[alias])]), change)


def lpips_when_used(tree: cst.Module, found: Found) -> cst.Module:
    """`name = lpips.LPIPS(...)...` at the top of a module is made when it is called first."""
    def change(line: cst.SimpleStatementLine) -> List[cst.SimpleStatementLine]:
        found.pending += 1
        made = cst.parse_expression("nan_without_network(deferred(lambda: None))")
        made = made.with_deep_changes(made.args[0].value.args[0].value, body=line.body[0].value)
        first, second = after_import(line, "deferred, nan_without_network", "pass")
        return [first, second.with_changes(body=[line.body[0].with_changes(value=made)])]

    value = network = m.Call(func=named("lpips.LPIPS"))
    for _ in range(2):  # .to('cuda'), .eval()
        network = m.Call(func=m.Attribute(value=network))
        value |= network
    return each_line(tree, m.SimpleStatementLine(body=[m.Assign(value=value)]), change)


def after_import(line: cst.SimpleStatementLine, names: str, new: str) -> List[cst.SimpleStatementLine]:
    """Returns an import from runtime.py and a new line for one; the comments above it stay above both."""
    return [codemods.statement(f"from {RUNTIME} import {names}").with_changes(leading_lines=line.leading_lines),
            line.with_changes(leading_lines=[], body=codemods.statement(new).body)]


def without_standard(tree: cst.Module, found: Found) -> cst.Module:
    """The flag goes: torch gives the compiler the standard that it needs itself where nobody does."""
    def change(_, flags: cst.List) -> cst.List:
        kept: List[cst.BaseElement] = []
        for flag in flags.elements:
            if not m.matches(flag.value, m.SimpleString()) or flag.value.evaluated_value != "-std=c++14":
                kept.append(flag)
                continue
            found.pending += 1
            if kept:  # what follows the flag, comma and line break, follows the word before it then
                kept[-1] = kept[-1].with_changes(comma=flag.comma)
        return flags.with_changes(elements=kept)

    return each_node(tree, m.List(), change)


class Optional(NamedTuple):
    """A rule on request."""

    name: str
    reason: str
    hints: Tuple[str, ...]  # a file without any of these words cannot match and is not parsed
    codemod: Callable[[cst.Module, Found], cst.Module]

    def looks_at(self, data: bytes) -> bool:
        return any(hint.encode() in data for hint in self.hints)


NEVER_NEEDED = ("lpips", "wandb", "websockets")
UNIQUE = ("sorted", "return_inverse", "return_counts", "dim")
OPTIONS = {
    "modernise": (
        Optional("checkpoint-load",
                 "torch 2.6 and later load tensors alone unless told otherwise; checkpoints hold numpy numbers too",
                 ("torch.load",), weights_only),
        Optional("simple-knn", "distCUDA2 is in this package, for CUDA and CPU: one extension less to compile",
                 ("simple_knn",), partial(renamed_import, foreign="simple_knn._C", ours=PACKAGE, names=["distCUDA2"])),
        Optional("fused-ssim", "fused_ssim is in this package: one extension less to compile",
                 ("fused_ssim",), partial(renamed_import, foreign="fused_ssim", ours=PACKAGE, names=["fused_ssim"])),
        Optional("torch-scatter",
                 "torch_scatter has no builds for new torch releases, and torch has what is used of it",
                 ("torch_scatter",), partial(renamed_import, foreign="torch_scatter", names=["scatter", "scatter_max"],
                                             ours=f"{INTEGRATIONS}.torch_scatter")),
        Optional("weighted-distance", "torch finds the nearest row of a codebook too: one extension less to compile",
                 ("weighted_distance",), partial(renamed_import, foreign="weighted_distance._C",
                                                 ours=f"{INTEGRATIONS}.weighted_distance", names=["weightedDistance"])),
        Optional("optional-import",
                 "every run imports wandb, websockets or lpips, but only an option or a metric uses them",
                 NEVER_NEEDED, partial(optional_import, names=NEVER_NEEDED)),
        Optional("lpips-when-used",
                 "the network of LPIPS was built, and its weights downloaded, when the script was imported",
                 ("lpips.LPIPS",), lpips_when_used),
        Optional("lpips-offline",
                 "where the weights of LPIPS could not be downloaded, a measurement ended the training",
                 ("def lpips",), partial(decorated, function="lpips", decorator="nan_without_network")),
        Optional("blender-images", "new Pillow releases take no signed bytes for a picture",
                 ("np.byte", "numpy.byte"), unsigned_bytes),
        Optional("numpy-types", "NumPy 1.24 and later have no np.int, np.float, np.bool and np.object",
                 ("np.", "numpy."), builtin_types),
        Optional("eigh-in-parts",
                 "cuSOLVER of CUDA 12.8 and later fails on the many covariances that c3dgs gives it at once",
                 ("linalg.eigh", "eigh_in_parts"), partial(call_of_ours, foreign="torch.linalg.eigh",
                                                           ours="eigh_in_parts", positional=2, keywords=("UPLO",))),
        Optional("unique-rows",
                 "torch.unique(dim=0) can fail on CUDA where processes share a GPU: its merge sort has a race",
                 ("torch.unique", "unique_rows"), partial(
                     call_of_ours, foreign="torch.unique", ours="unique_rows", positional=5, keywords=UNIQUE,
                     fits=lambda given: m.matches(given.get("dim", cst.Name("None")), m.Integer("0")))),
        Optional("cpp-standard", "C++14 was asked for; torch 2.1 needs C++17, 2.13 C++20, and asks for it itself",
                 ("c++14",), without_standard)),
    "fuse": (
        Optional("fused-loss", "the five convolutions of SSIM and their gradients are two kernels here",
                 ("def ssim",), partial(decorated, function="ssim", decorator="fused_where_equal")),
        Optional("fused-adam", "a step of Adam reads and writes every Gaussian once instead of a dozen times",
                 ("torch.optim.Adam", "FusedAdam"), partial(
                     call_of_ours, foreign="torch.optim.Adam", ours="FusedAdam", source=PACKAGE, positional=4,
                     keywords=("lr", "betas", "eps")))),
}
