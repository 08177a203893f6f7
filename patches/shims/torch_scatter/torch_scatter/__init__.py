"""For `dsmoe run`, where torch_scatter is not installed."""
from diff_smoe_rasterization.integrations.torch_scatter import scatter, scatter_max  # noqa: F401
from diff_smoe_rasterization.patches.runtime import say_stand_in

say_stand_in("torch_scatter")
