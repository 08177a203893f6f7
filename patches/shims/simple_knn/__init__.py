"""For `dsmoe run`: simple_knn as it is installed, else this package's."""
from diff_smoe_rasterization.patches.runtime import is_installed

is_installed("simple_knn._C")
