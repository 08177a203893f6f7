"""The names of the methods a suite may ask for; what they are is in the modules beside this one."""
from __future__ import annotations

NATIVE = "native"
VARIANTS = ("native", "unpatched", "patched", "fused")  # fused: by a patch with --fuse
# Of each public trainer, whether it can be patched to this package's rasterizer (patches/).
CHECKOUTS = {"3dgs-2023": True, "3dgs-2024": True, "taming": True, "c3dgs": True, "hac": True, "hac-plus": True,
             "2dgs": False, "dbs": False}
WITHOUT_SCHEDULE = ("hac", "hac-plus", "dbs")  # they grow and prune by rules of their own
NEEDS = {"dbs": "--cap_max"}  # an argument without which a method has no size
