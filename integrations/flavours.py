"""The modules that have no file here: the classes of their entries in contracts.py, and what these do not say.

A function named as a module takes the settings and the arguments by name, and returns the results of a call.
"""
from __future__ import annotations

from types import ModuleType

import torch

from diff_smoe_rasterization import SparseGaussianAdam, rasterize_with_splats

from ._rasterizer import classes_of, results_of, results_with_features, scaled_gradients
from .contracts import NAMES, contract_of


def fill(module: ModuleType) -> None:
    """Gives a module the names of its contract. Raises KeyError where there is none."""
    name = module.__name__.rpartition(".")[2]
    contract, renderer = contract_of(name), RENDERERS.get(name)
    about = (renderer.__doc__ if renderer else None) or "What a call returns is in contracts.py."
    module.__doc__ = f"The API of the rasterizer of {contract.used_by}.\n\n{about}"
    offered = dict(zip(NAMES, classes_of(name, module.__name__, renderer)))
    offered.update({further: FURTHER[further] for further in contract.names})
    vars(module).update(offered, __all__=sorted(offered))


def lucid_dreamer(settings, inputs):
    """Depth, and the share that the background has, are one image."""
    color, radii, depth, alpha = results_of(("color", "radii", "depth", "alpha"), settings, inputs)
    return color, radii, torch.cat([depth, 1 - alpha])


def feature_3dgs(settings, inputs):
    """`semantic_feature` [N, 1, F] is blended beside the colours in one rendering."""
    return results_with_features(("color", "feature_map", "radii", "depth"), settings, inputs, "feature_map",
                                 inputs.pop("semantic_feature"))


def grouping(settings, inputs):
    """`sh_objs` [N, 1, F] are blended beside the colours in one rendering."""
    objects = inputs.pop("sh_objs", None)
    if objects is None:
        color, radii = results_of(("color", "radii"), settings, inputs)
        return color, radii, color.new_zeros(0, *color.shape[1:])
    return results_with_features(("color", "radii", "objects"), settings, inputs, "objects", objects)


def langsplat(settings, inputs):
    """`language_feature_precomp` [N, F] is blended beside the colours in one rendering.

    Without `include_feature` in the settings the features are not read, and their image is black.
    """
    features = inputs.pop("language_feature_precomp", None)
    if settings.include_feature and features is not None:
        return results_with_features(("color", "language_feature", "radii"), settings, inputs, "language_feature",
                                     features)
    color, radii = results_of(("color", "radii"), settings, inputs)
    return color, color.new_zeros(3, *color.shape[1:]), radii


def light_gaussian(settings, inputs):
    """Under `f_count` two scores of each Gaussian come before the usual results.

    They are how many pixels blended it, and that number times its opacity.
    """
    scores = ("counts", "opacity_sums") if settings.f_count else ()
    return results_of((*scores, "color", "radii"), settings, inputs)


def nearest_points(settings, inputs):
    """`nearest_points` in the settings are None but for scenes of DUSt3R, where the gradient of means3D is turned
    towards them. Such scenes are refused.
    """
    if settings.nearest_points is not None:
        raise NotImplementedError("rasterize: nearest_points are set (a scene of DUSt3R); this package does not turn "
                                  "gradients towards points; train without them, as on a COLMAP scene")
    return results_of(("color", "radii"), settings, inputs)


def cob_gs(settings, inputs):
    """The stage without masks: `include_mask` is refused."""
    if settings.include_mask:
        raise NotImplementedError("rasterize: include_mask is set (masks are segmented); this package renders only the "
                                  "images of the stage before")
    inputs = {name: value for name, value in inputs.items() if name not in ("mask_precomp", "mask_signals")}
    color, radii, inverse_depth = results_of(("color", "radii", "inverse_depth"), settings, inputs)
    return color, torch.zeros_like(inverse_depth), radii, inverse_depth


def pixel_gs(settings, inputs):
    """How many pixels blended each Gaussian, and `depth_threshold` in the settings.

    The gradient of means2D, by which the trainer densifies, is multiplied by (z / depth_threshold)^2, at most 1: less
    grows in front of the camera.
    """
    points = inputs.get("means2D")
    if settings.depth_threshold and points is not None:
        depths = (inputs["means3D"] @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]).detach()
        factors = (depths / settings.depth_threshold).square().clamp(max=1)
        inputs = {**inputs, "means2D": scaled_gradients(factors, {"": points})[""]}
    return results_of(("color", "radii", "pixels"), settings, inputs)


def mip_splatting(settings, inputs):
    """`kernel_size` in the settings replaces the low-pass filter's 0.3.

    Opacities are compensated as under `antialiasing`. The third column of means2D gets the sum of absolute gradients of
    both axes. `subpixel_offset` may be None or zeros: pixels sampled off their centres are refused.
    """
    offset = settings.subpixel_offset
    if offset is not None and offset.numel() > 0 and bool(offset.any()):
        raise NotImplementedError("rasterize: subpixel_offset is not zero (Mip-Splatting's --sample_more_highres); "
                                  "this package samples pixels only at their centres")
    if settings.kernel_size is not None:
        settings = settings._replace(low_pass=settings.kernel_size)
    return results_of(("color", "radii"), settings._replace(antialiasing=True), inputs)


def fastgs(settings, inputs):
    """means2D [N, 4] as in absgs, and how many pixels of a map blended each Gaussian.

    `metric_map` has a 1 for each pixel that counts; `get_flag` says whether to count. `mult` shrinks the original's
    footprints; here they are exact.
    """
    if not settings.get_flag:
        color, radii = results_of(("color", "radii"), settings, inputs)
        return color, radii, radii.new_zeros(radii.shape)
    rendering, splats = rasterize_with_splats(settings=settings, **inputs)
    counted = (settings.metric_map.reshape(rendering.color.shape[1:]) == 1).to(rendering.color.dtype)
    return rendering.color, rendering.radii, splats.contributions(counted).pixel_weights.round().to(rendering.radii)


RENDERERS = {made.__name__: made for made in (lucid_dreamer, feature_3dgs, grouping, langsplat, light_gaussian,
                                              nearest_points, cob_gs, pixel_gs, mip_splatting, fastgs)}
FURTHER = {"SparseGaussianAdam": SparseGaussianAdam}  # that a module offers beside its classes
