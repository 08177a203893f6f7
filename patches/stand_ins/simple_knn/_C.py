from diff_smoe_rasterization import distCUDA2  # noqa: F401
