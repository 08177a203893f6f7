from diff_smoe_rasterization.integrations.weighted_distance import weightedDistance  # noqa: F401
