"""What a trainer needs to start on today's torch, CUDA and Python, and has nothing to do with blending: --modernise.

Each rule is a LibCST codemod as those in codemods.py. One that matches nothing is skipped.
"""
from __future__ import annotations

from typing import Dict, Tuple

import libcst as cst
from libcst.helpers import get_full_name_for_node

from .codemods import CallOfOurs, Codemod, Decorated, statement
from .optional import Rule
from .rules import INTEGRATIONS, RUNTIME


class _ImportFrom(Codemod):
    """`from FOREIGN import NAMES` takes the names from OURS, where it has all of them."""

    foreign = ours = ""
    names: Tuple[str, ...] = ()

    def leave_ImportFrom(self, original_node: cst.ImportFrom, updated_node: cst.ImportFrom) -> cst.ImportFrom:
        if updated_node.relative or isinstance(updated_node.names, cst.ImportStar) or updated_node.module is None:
            return updated_node
        if (get_full_name_for_node(updated_node.module) != self.foreign
                or not {get_full_name_for_node(alias.name) for alias in updated_node.names} <= set(self.names)):
            return updated_node
        self.pending += 1
        return updated_node.with_changes(module=cst.parse_expression(self.ours))


class _SimpleKnn(_ImportFrom):
    foreign, ours, names = "simple_knn._C", "diff_smoe_rasterization", ("distCUDA2",)


class _FusedSsim(_ImportFrom):
    foreign, ours, names = "fused_ssim", "diff_smoe_rasterization", ("fused_ssim",)


class _TorchScatter(_ImportFrom):
    foreign, ours, names = "torch_scatter", f"{INTEGRATIONS}.torch_scatter", ("scatter", "scatter_max")


class _WeightedDistance(_ImportFrom):
    foreign, ours = "weighted_distance._C", f"{INTEGRATIONS}.weighted_distance"
    names = ("weightedDistance",)


class _WeightsOnly(Codemod):
    def leave_Call(self, original_node: cst.Call, updated_node: cst.Call) -> cst.Call:
        given = [argument.keyword.value if argument.keyword else None for argument in updated_node.args]
        if get_full_name_for_node(updated_node.func) != "torch.load" or "weights_only" in given or not given:
            return updated_node
        self.pending += 1
        *before, last = updated_node.args
        more = cst.Arg(cst.Name("False"), cst.Name("weights_only"), comma=last.comma,
                       whitespace_after_arg=last.whitespace_after_arg,
                       equal=cst.AssignEqual(cst.SimpleWhitespace(""), cst.SimpleWhitespace("")))
        last = last.with_changes(comma=cst.Comma(whitespace_after=cst.SimpleWhitespace(" ")),
                                 whitespace_after_arg=cst.SimpleWhitespace(""))
        return updated_node.with_changes(args=[*before, last, more])


class _NumpyByte(Codemod):
    """`dtype=np.byte` becomes `dtype=np.uint8`."""

    def leave_Arg(self, original_node: cst.Arg, updated_node: cst.Arg) -> cst.Arg:
        is_dtype = updated_node.keyword is not None and updated_node.keyword.value == "dtype"
        if not is_dtype or get_full_name_for_node(updated_node.value) not in ("np.byte", "numpy.byte"):
            return updated_node
        self.pending += 1
        return updated_node.with_changes(value=updated_node.value.with_changes(attr=cst.Name("uint8")))


class _OptionalImport(Codemod):
    """`import wandb` becomes `wandb = optional_import("wandb")`."""

    names = ("lpips", "wandb", "websockets")

    def visit_Try(self, node: cst.Try) -> None:
        self.within.append(node)  # who tries it expects that it may fail

    def leave_Try(self, original_node: cst.Try, updated_node: cst.Try) -> cst.Try:
        self.within.pop()
        return updated_node

    def leave_SimpleStatementLine(self, original_node: cst.SimpleStatementLine,
                                  updated_node: cst.SimpleStatementLine):
        only = updated_node.body[0]
        if len(updated_node.body) != 1 or not isinstance(only, cst.Import) or len(only.names) != 1:
            return updated_node
        name = get_full_name_for_node(only.names[0].name)
        if name not in self.names or only.names[0].asname or self.within:
            return updated_node
        self.pending += 1
        return with_line_before(updated_node, f"from {RUNTIME} import optional_import",
                                body=statement(f'{name} = optional_import("{name}")').body)


class _LpipsWhenUsed(Codemod):
    """`name = lpips.LPIPS(...)...` at the top of a module is made when it is called first."""

    def leave_SimpleStatementLine(self, original_node: cst.SimpleStatementLine,
                                  updated_node: cst.SimpleStatementLine):
        only = updated_node.body[0]
        if self.within or len(updated_node.body) != 1 or not isinstance(only, cst.Assign):
            return updated_node
        call = only.value
        while isinstance(call, cst.Call) and isinstance(call.func, cst.Attribute) and get_full_name_for_node(
                call.func) != "lpips.LPIPS":
            call = call.func.value  # from .to('cuda') or .cuda() inwards
        if not isinstance(call, cst.Call) or get_full_name_for_node(call.func) != "lpips.LPIPS":
            return updated_node
        self.pending += 1
        value = cst.parse_expression("nan_without_network(deferred(lambda: None))")
        value = value.with_deep_changes(value.args[0].value.args[0].value, body=only.value)
        return with_line_before(updated_node, f"from {RUNTIME} import deferred, nan_without_network",
                                body=[only.with_changes(value=value)])


class _LpipsOffline(Decorated):
    """Of lpipsPyTorch."""

    function, decorator = "lpips", "nan_without_network"


class _EighInParts(CallOfOurs):
    foreign, ours, keywords, positional = "torch.linalg.eigh", "eigh_in_parts", ("UPLO",), 2


class _UniqueRows(CallOfOurs):
    foreign, ours, positional = "torch.unique", "unique_rows", 5
    keywords = ("sorted", "return_inverse", "return_counts", "dim")

    def fits(self, given: Dict[str, cst.BaseExpression]) -> bool:
        return isinstance(given.get("dim"), cst.Integer) and given["dim"].evaluated_value == 0


class _CppStandard(Codemod):
    """The flag goes: torch gives the compiler the standard that it needs itself where nobody does."""

    def leave_List(self, original_node: cst.List, updated_node: cst.List) -> cst.List:
        kept = []
        for element in updated_node.elements:
            if not isinstance(element.value, cst.SimpleString) or element.value.raw_value != "-std=c++14":
                kept.append(element)
                continue
            self.pending += 1
            if kept:  # what follows the flag, comma and line break, follows the word before it then
                kept[-1] = kept[-1].with_changes(comma=element.comma)
        return updated_node.with_changes(elements=kept)


def with_line_before(line: cst.SimpleStatementLine, before: str, **changes) -> cst.FlattenSentinel:
    """Returns two lines for one; the comments above it stay above both."""
    return cst.FlattenSentinel([statement(before).with_changes(leading_lines=line.leading_lines),
                                line.with_changes(leading_lines=[], **changes)])


RULES = (
    Rule("checkpoint-load",
         "torch 2.6 and later load tensors alone unless told otherwise; checkpoints hold numpy numbers too",
         _WeightsOnly, ("torch.load",)),
    Rule("simple-knn", "distCUDA2 is in this package, for CUDA and CPU: one extension less to compile",
         _SimpleKnn, ("simple_knn",)),
    Rule("fused-ssim", "fused_ssim is in this package: one extension less to compile",
         _FusedSsim, ("fused_ssim",)),
    Rule("torch-scatter", "torch_scatter has no builds for new torch releases, and torch has what is used of it",
         _TorchScatter, ("torch_scatter",)),
    Rule("weighted-distance", "torch finds the nearest row of a codebook too: one extension less to compile",
         _WeightedDistance, ("weighted_distance",)),
    Rule("optional-import", "every run imports wandb, websockets or lpips, but only an option or a metric uses them",
         _OptionalImport, _OptionalImport.names),
    Rule("lpips-when-used", "the network of LPIPS was built, and its weights downloaded, when the script was imported",
         _LpipsWhenUsed, ("lpips.LPIPS",)),
    Rule("lpips-offline", "where the weights of LPIPS could not be downloaded, a measurement ended the training",
         _LpipsOffline, ("def lpips",)),
    Rule("blender-images", "new Pillow releases take no signed bytes for a picture",
         _NumpyByte, ("np.byte", "numpy.byte")),
    Rule("eigh-in-parts", "cuSOLVER of CUDA 12.8 and later fails on the many covariances that c3dgs gives it at once",
         _EighInParts, ("linalg.eigh", "eigh_in_parts")),
    Rule("unique-rows", "torch.unique(dim=0) can fail on CUDA where processes share a GPU: its merge sort has a race",
         _UniqueRows, ("torch.unique", "unique_rows")),
    Rule("cpp-standard", "C++14 was asked for; torch 2.1 needs C++17, 2.13 C++20, and asks for it itself",
         _CppStandard, ("c++14",)),
)
