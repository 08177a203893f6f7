"""What a trainer computes in many kernels, and this package in few with the same result but for rounding: --fuse.

Each rule is a LibCST codemod as those in codemods.py. One that matches nothing is skipped.
"""
from __future__ import annotations

from .codemods import CallOfOurs, Decorated
from .optional import Rule
from .rules import PACKAGE


class _Ssim(Decorated):
    function, decorator = "ssim", "fused_where_equal"


class _Adam(CallOfOurs):
    foreign, ours, source = "torch.optim.Adam", "FusedAdam", PACKAGE
    positional, keywords = 4, ("lr", "betas", "eps")


RULES = (
    Rule("fused-loss", "the five convolutions of SSIM and their gradients are two kernels here",
         _Ssim, ("def ssim",)),
    Rule("fused-adam", "a step of Adam reads and writes every Gaussian once instead of a dozen times",
         _Adam, ("torch.optim.Adam", "FusedAdam")),
)
