"""For `dsmoe run`, where torch_scatter is not installed."""
from diff_smoe_rasterization.integrations.torch_scatter import scatter, scatter_max  # noqa: F401
