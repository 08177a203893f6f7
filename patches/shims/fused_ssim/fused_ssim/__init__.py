"""For `dsmoe run`, where fused_ssim is not installed."""
from diff_smoe_rasterization import fused_ssim  # noqa: F401
from diff_smoe_rasterization.patches.runtime import say_stand_in

say_stand_in("fused_ssim")
