from dsmoe.patches.runtime import is_installed

if not is_installed("fused_ssim"):
    from diff_smoe_rasterization import fused_ssim  # noqa: F401
