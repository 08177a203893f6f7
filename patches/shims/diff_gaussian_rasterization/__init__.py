"""For `dsmoe run`: what a trainer imports from its rasterizer is the module of integrations that fits it."""
from diff_smoe_rasterization.patches.runtime import rasterizer_of_run

globals().update(rasterizer_of_run())
