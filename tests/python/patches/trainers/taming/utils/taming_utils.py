import torch
from fused_ssim import fused_ssim as fast_ssim
from gaussian_renderer import render


def compute_photometric_loss(view, image):
    similarity = fast_ssim(image[None], view.original_image[None])
    return torch.lerp((image - view.original_image).abs().mean(), 1 - similarity, 0.3)


def compute_gaussian_score(views, gaussians, pipe, bg):
    """[N]: what every Gaussian does in these views, of two renderings each."""
    score = torch.zeros_like(gaussians.get_xyz[:, 0])
    for view in views:
        image = render(view, gaussians, pipe, bg)["render"]
        weights = (image - view.original_image).abs().mean(0)
        result = render(view, gaussians, pipe, bg, pixel_weights=weights)
        values = [result[name].flatten().float() for name in (
            "gaussian_depths", "gaussian_radii", "accum_weights", "accum_count", "accum_blend", "accum_dist")]
        seen = result["visibility_filter"]
        score[seen] += compute_photometric_loss(view, image) * sum(value / value.max() for value in values)[seen]
    return score
