"""For `dsmoe run`, where weighted_distance is not installed."""
from diff_smoe_rasterization.patches.runtime import say_stand_in

say_stand_in("weighted_distance")
