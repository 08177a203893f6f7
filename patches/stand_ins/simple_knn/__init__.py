from dsmoe.patches.runtime import is_installed

is_installed("simple_knn._C")
