from diff_smoe_rasterization.patches.runtime import gsplat_of_run

gsplat_of_run()
