from dsmoe.patches.runtime import is_installed

if not is_installed("torch_scatter"):
    from diff_smoe_rasterization.integrations.torch_scatter import scatter, scatter_max  # noqa: F401
