"""The package that trainers ask for by this name, on this project's own loss."""
from diff_smoe_rasterization import fused_ssim

__all__ = ["fused_ssim"]
