"""Patches public trainers so that they train with this package's rasterizer and its blend modes.

    from diff_smoe_rasterization import patches
    patches.apply("gaussian-splatting")        # what `dsmoe patch apply gaussian-splatting` does

engine.py plans and carries out; trainers/ has a short file of rules for each trainer; codemods.py is how a rule
changes a file; shims/ is what `dsmoe run` puts in front of an unmodified checkout. runtime.py is what a patched trainer
imports.
"""
from .engine import apply, check, diff, inspect, plan, revert
from .errors import PatchError
from .facts import names

TRAINERS = names()

__all__ = ["PatchError", "TRAINERS", "apply", "check", "diff", "inspect", "plan", "revert"]
