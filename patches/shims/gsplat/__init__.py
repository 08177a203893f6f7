"""For `dsmoe run`: gsplat as it is installed, with this package's rasterizer in it."""
from diff_smoe_rasterization.patches.runtime import gsplat_of_run

gsplat_of_run()
