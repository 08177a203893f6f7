from diff_smoe_rasterization.integrations.simple_knn import distCUDA2  # noqa: F401
