from diff_smoe_rasterization.patches.runtime import is_installed

is_installed("weighted_distance._C")
