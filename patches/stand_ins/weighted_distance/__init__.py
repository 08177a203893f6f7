from dsmoe.patches.runtime import is_installed

is_installed("weighted_distance._C")
