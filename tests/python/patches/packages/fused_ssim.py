"""The package that trainers ask for by this name, on this project's own loss."""


def fused_ssim(img1, img2):
    from diff_smoe_rasterization import fused_ssim as similarity

    return similarity(img1, img2)
