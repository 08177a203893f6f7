"""The command `dsmoe`: trains, views, exports and compares Gaussians, by the rasterizer diff_smoe_rasterization."""
