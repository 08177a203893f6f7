"""The package that trainers ask for by this name, on this project's own search."""
from diff_smoe_rasterization import distCUDA2

__all__ = ["distCUDA2"]
