from dsmoe.patches.runtime import gsplat_of_run

gsplat_of_run()
