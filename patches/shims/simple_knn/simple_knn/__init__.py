"""For `dsmoe run`, where simple_knn is not installed."""
from diff_smoe_rasterization.patches.runtime import say_stand_in

say_stand_in("simple_knn")
