"""What trainers import from simple_knn's extension."""
from diff_smoe_rasterization import distCUDA2  # noqa: F401
