"""Patches public trainers so that they train with this package's rasterizer and its blend modes.

    from dsmoe import patches
    patches.apply("gaussian-splatting")        # what `dsmoe patch apply gaussian-splatting` does

README.md lists the trainers and the rules of a patch.
"""
from .engine import apply, check, diff, revert
from .source import PatchError
from .trainers import TRAINER_NAMES as TRAINERS

__all__ = ["PatchError", "TRAINERS", "apply", "check", "diff", "revert"]
