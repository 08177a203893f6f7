"""Patches public trainers so that they train with this package's rasterizer and its blend modes.

    from diff_smoe_rasterization import patches
    patches.apply("gaussian-splatting")        # what `dsmoe patch apply gaussian-splatting` does

trainers.py is the table of trainers; rules.py is how a rule changes a file; engine.py plans and carries out;
record.py keeps the originals. shims/ is what `dsmoe run` puts in front of an unmodified checkout, runtime.py what a
patched trainer imports.
"""
from .engine import apply, check, diff, plan, revert
from .source import PatchError
from .trainers import names

TRAINERS = names()

__all__ = ["PatchError", "TRAINERS", "apply", "check", "diff", "plan", "revert"]
