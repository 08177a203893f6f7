"""For `dsmoe run`, where fused_ssim is not installed."""
from diff_smoe_rasterization import fused_ssim  # noqa: F401
