from diff_smoe_rasterization.patches.runtime import rasterizer_of_run

globals().update(rasterizer_of_run("dngaussian"))
