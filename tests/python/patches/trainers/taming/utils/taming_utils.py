import torch
from fused_ssim import fused_ssim as fast_ssim
from gaussian_renderer import render

from .loss_utils import l1_loss


def stretched(map):
    return (map - map.min()) / (map.max() - map.min())


def get_edges(image):
    """[H, W]: how much the grey value changes to the right and downwards."""
    grey = torch.nn.functional.pad(image.mean(0)[None], (0, 1, 0, 1), mode="replicate")[0]
    return (grey[1:, :-1] - grey[:-1, :-1]).abs() + (grey[:-1, 1:] - grey[:-1, :-1]).abs()


def over_median(values):
    """Positive values over their median; 0 elsewhere."""
    values = values.float().nan_to_num(0.0).clamp_min(0.0)
    return values / values[values > 0].median() if bool((values > 0).any()) else values


def compute_photometric_loss(view, image):
    similarity = fast_ssim(image[None], view.original_image[None])
    return torch.lerp(l1_loss(image, view.original_image), 1 - similarity, 0.3)


def compute_gaussian_score(scene, camlist, edge_losses, gaussians, pipe, bg, coefficients, opt):
    """[N]: what every Gaussian does in these views, of two renderings each."""
    score = torch.zeros_like(gaussians.get_xyz[:, 0])
    of_model = {"gradient": gaussians.xyz_gradient_accum / gaussians.denom, "opacity": gaussians.get_opacity,
                "size": gaussians.get_scaling.prod(dim=1)}
    for view, edges in zip(camlist, edge_losses):
        image = render(view, gaussians, pipe, bg)["render"]
        weights = coefficients["error"] * stretched((image - view.original_image).abs().mean(0))
        result = render(view, gaussians, pipe, bg, pixel_weights=weights + coefficients["edges"] * edges)
        values = {**of_model, "depth": result["gaussian_depths"], "radius": result["gaussian_radii"],
                  "distance": result["accum_dist"], "weight": result["accum_weights"],
                  "count": result["accum_count"], "blend": result["accum_blend"]}
        importance = sum(coefficients[name] * over_median(value.flatten()) for name, value in values.items())
        seen = result["visibility_filter"]
        score[seen] += compute_photometric_loss(view, image) * importance[seen]
    return score


def get_count_array(first, multiplier, opt, mode):
    """How many Gaussians there may be after every densification."""
    last = multiplier * (first if mode == "multiplier" else 1)
    steps = (opt.densify_until_iter - opt.densify_from_iter) // opt.densification_interval + 1
    return torch.linspace(first, last, steps + 1).int().tolist()[1:]
