"""For `dsmoe run`: what a trainer imports from this rasterizer is `fastgs` of integrations."""
from diff_smoe_rasterization.patches.runtime import rasterizer_of_run

globals().update(rasterizer_of_run("fastgs"))
