from dsmoe.patches.runtime import rasterizer_of_run

globals().update(rasterizer_of_run("absgs"))
