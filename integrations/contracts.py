"""The Python APIs of public Gaussian rasterizers, as data: how a trainer is recognised by them, and what is returned.

From this table come the classes of the modules here, what `dsmoe run` answers for, how `dsmoe patch` tells trainers
apart, and the table in README.md. A new rasterizer of Inria's kind is one entry and one module.
"""
from __future__ import annotations

from typing import NamedTuple, Tuple

RASTERIZER = "diff_gaussian_rasterization"  # the name that most trainers import
SETTINGS = ("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
            "sh_degree", "campos", "prefiltered", "debug")
ARGUMENTS = ("means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp")
NAMES = ("GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians")
METHODS = ("markVisible", "forward", "to", "cuda", "cpu", "train", "eval")  # of a rasterizer, those of torch among them

RESULTS = {  # what a result is, and a word that is in the name that callers give it, if it must be
    "color": ("[C, H, W]", ""),
    "radii": ("[N] int32, pixels", ""),
    "inverse_depth": ("[1, H, W], 1 / z blended as a colour over 0", ""),
    "depth": ("[1, H, W], z blended as a colour over 0", "depth"),
    "alpha": ("[1, H, W], the share of the pixel that the background does not have", "alpha"),
    "median_depth": ("[1, H, W], z of the Gaussian where the weights, front to back, reach half a pixel", "med"),
    "depth_alpha": ("[2, H, W], the depth, and the share of the pixel that the background has", "depth_alpha"),
    "opacity": ("[1, H, W], the same as alpha", "opac"),
    "is_used": ("[N] int32, 1 where the radius is positive", "used"),
    "pixels": ("[N, 1], how many pixels blended the Gaussian", "pixel"),
    "weights": ("[N], sum over them of alpha T", "w"),
    "n_touched": ("[N] int32, how many pixels blended the Gaussian", "touched"),
    "counts": ("[N] int32, how many pixels blended the Gaussian", "count"),
    "opacity_sums": ("[N], counts times the opacity", "score"),
    "largest": ("[N], in how many pixels the Gaussian has the largest weight", "max"),
    "metric_counts": ("[N] int32, how many pixels of metric_map blended the Gaussian", "count"),
    "kernel_times": ("[1], NaN: nothing is timed", "time"),
    "mask": ("[1, H, W], zeros", "mask"),
    "objects": ("[F, H, W], sh_objs blended as a colour over 0", "object"),
    "feature_map": ("[F, H, W], semantic_feature blended as a colour over 0", "feature"),
    "language_feature": ("[F, H, W], language_feature_precomp blended as a colour over 0", "feature"),
    "normal": ("[3, H, W], normal_precomp blended as a colour over 0", "norm"),
}
FEATURES = {  # arguments [N, F] or [N, 1, F] that are blended beside the colours over 0: the result, and F without them
    "sh_objs": ("objects", 0), "semantic_feature": ("feature_map", 0),
    "language_feature_precomp": ("language_feature", 3), "normal_precomp": ("normal", 3)}
# What a rasterizer of Inria's kind may have beside its results, in any combination.
FREE_SETTINGS = ("antialiasing", "kernel_size", "subpixel_offset", "clamp_color", "confidence", "depth_threshold",
                 "projmatrix_raw", "include_feature", "nearest_points")
FREE_ARGUMENTS = ("means2D_densify", "theta", "rho", *FEATURES)
FREE_METHODS = ("visible_filter",)

# What callers name a result, without blanks, plural and the words of NO_MEANING: for those of a rasterizer that returns
# results in an order of its own.
WORDS = (("radii", "radi[ui]s?"), ("is_used", "(is)?used"), ("n_touched", "n?touched"),
         ("median_depth", "med(ian)?depth|depthmed(ian)?"), ("inverse_depth", "inv(erse)?depth|depthinv"),
         ("depth", "depth"), ("alpha", "alpha|opac(ity)?|acc(um(ulation)?)?"), ("normal", "norm(al)?"),
         ("objects", "obj(ect)?"), ("feature_map", "(semantic)?feature|semantic"),
         ("language_feature", "language(feature)?"), ("color", "colou?r|rgb|im|"))
NO_MEANING = "rendered|rendering|render|image|img|map|pred|out(put)?|expected|blended|final|_"
# What is in the names of packages that have Inria's names and compute something else: surfels, planes, opacity fields,
# other lenses, rays of light or sound, other kernels.
FOREIGN = ("surf", "plan", "gof", "^rade|_rade", "omni", "pano", "spher", "fisheye", "360", "op43", "ortho", "ray",
           "2d", "4d", "mesh", "triang", "convex", "beta", "gabor", "sonar", "radar", "_rf", "event", "voxel", "normal",
           "light")

REFUSED = {  # signs of rasterizers whose API is known, and why none is offered
    "sets require_depth": "its settings have require_depth, as RaDe-GS's: its gradients of the depths and normals of "
                          "planes, and its median of a pixel that is never half full, are not computed here",
}


class Contract(NamedTuple):
    """What callers of a rasterizer rely on, beside SETTINGS, ARGUMENTS, NAMES and METHODS, which all of a kind have."""

    name: str  # of the module here, and for `dsmoe run --trainer`
    used_by: str
    results: Tuple[str, ...] = ("color", "radii")  # of a call, in order
    settings: Tuple[str, ...] = ()  # behind `debug`
    arguments: Tuple[str, ...] = ARGUMENTS  # of a call, in order
    names: Tuple[str, ...] = ()  # that can be imported
    signs: Tuple[str, ...] = ()  # a caller shows one of these (patches/facts.py); none: it needs to show nothing
    module: str = RASTERIZER  # what callers import
    other_results: Tuple[Tuple[str, ...], ...] = ()  # of calls by other settings, or of a rasterizer beside it
    methods: Tuple[str, ...] = ()  # of a rasterizer, beside METHODS


def _behind(name: str, *further: str) -> Tuple[str, ...]:
    """Returns ARGUMENTS with further ones behind one of them."""
    place = ARGUMENTS.index(name) + 1
    return (*ARGUMENTS[:place], *further, *ARGUMENTS[place:])


WITH_DC = _behind("opacities", "dc")
TAMING = ("color", "radii", "counts", "lists", "listsRender", "listsDistance", "centers", "depths", "my_radii",
          "accum_weights", "accum_count", "accum_blend", "accum_dist")

GSPLAT = (  # what its `rasterization` takes
    "means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d sh_degree "
    "packed tile_size backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk distributed "
    "camera_model segmented covars blend_mode background_gate faint_below radial_coeffs tangential_coeffs "
    "thin_prism_coeffs rolling_shutter viewmats_rs").split()
# What it takes in later versions, with the values that switch them off. Callers spell those out.
OF_LATER_GSPLAT = {
    "with_ut": False, "with_eval3d": False, "return_normals": False, "global_z_order": True, "rays": None,
    "ftheta_coeffs": None, "lidar_coeffs": None, "external_distortion_coeffs": None, "ut_params": None,
    "extra_signals": None, "extra_signals_sh_degree": None, "renderer_config": None}

CONTRACTS = (
    Contract("scaffold", "Scaffold-GS, Octree-GS, HAC, HAC++", signs=("calls visible_filter",),
             methods=("visible_filter",)),
    Contract("c3dgs", "c3dgs (3DGS-C)", settings=("clamp_color",),
             arguments=(*ARGUMENTS, "sh_indices", "g_indices", "scale_factors"),
             names=("GaussianRasterizerIndexed", "rasterize_gaussians_indexed"),
             signs=("sets clamp_color", "imports GaussianRasterizerIndexed")),
    Contract("taming", "Taming-3DGS", TAMING, ("pixel_weights",), WITH_DC, ("SparseGaussianAdam",),
             ("sets pixel_weights",)),
    Contract("mip_splatting", "Mip-Splatting, TRELLIS", settings=("kernel_size", "subpixel_offset"),
             signs=("sets kernel_size",)),
    Contract("monogs", "MonoGS", ("color", "radii", "depth", "opacity", "n_touched"), ("projmatrix_raw",),
             (*ARGUMENTS, "theta", "rho"), signs=("sets projmatrix_raw",),
             other_results=(("color", "radii", "depth", "opacity"),)),
    Contract("grouping", "gaussian-grouping", ("color", "radii", "objects"), arguments=_behind("shs", "sh_objs"),
             signs=("takes sh_objs",)),
    Contract("feature_3dgs", "feature-3dgs", ("color", "feature_map", "radii", "depth"),
             arguments=_behind("colors_precomp", "semantic_feature"), signs=("takes semantic_feature",)),
    Contract("langsplat", "LangSplat", ("color", "language_feature", "radii"), ("include_feature",),
             _behind("colors_precomp", "language_feature_precomp"), signs=("sets include_feature",)),
    Contract("cob_gs", "COB-GS, NG-GS", ("color", "mask", "radii", "inverse_depth"),
             ("antialiasing", "include_mask"), _behind("colors_precomp", "mask_precomp", "mask_signals"),
             signs=("sets include_mask",)),
    Contract("speedy_splat", "Speedy-Splat", ("color", "radii", "kernel_times"),
             arguments=_behind("opacities", "scores"), signs=("takes scores",)),
    Contract("pixel_gs", "Pixel-GS", ("color", "radii", "pixels"), ("depth_threshold",),
             signs=("sets depth_threshold",)),
    Contract("nearest_points", "B32xN0/gaussian-splatting", settings=("nearest_points",),
             signs=("sets nearest_points",)),
    Contract("light_gaussian", "LightGaussian", settings=("f_count",), signs=("sets f_count",),
             other_results=(("counts", "opacity_sums", "color", "radii"),)),
    Contract("inria_2024", "3DGS of 2024 (`antialiasing`, sparse Adam)", ("color", "radii", "inverse_depth"),
             ("antialiasing",), WITH_DC, ("SparseGaussianAdam", "compute_relocation"),
             ("sets antialiasing", "takes dc", "imports SparseGaussianAdam", "reads invdepthmap")),
    Contract("inria", "3DGS of 2023, GaussianPro, InstantSplat, Compact-3DGS, SuGaR"),
    Contract("depth", "4DGaussians, Deformable 3D Gaussians, GaussianEditor, SplaTAM", ("color", "radii", "depth"),
             arguments=(*ARGUMENTS, "means2D_densify")),
    Contract("depth_alpha", "dreamgaussian, LGM, DNGaussian, FSGS, SC-GS", ("color", "radii", "depth", "alpha"),
             settings=("confidence",)),
    Contract("lucid_dreamer", "LucidDreamer, InfiniteScene", ("color", "radii", "depth_alpha")),
    Contract("mcmc", "3DGS-MCMC", ("color", "radii", "is_used"), names=("compute_relocation",)),
    Contract("absgs", "AbsGS", ("color", "radii", "weights"), module=RASTERIZER + "_abs"),
    Contract("fastgs", "FastGS", ("color", "radii", "metric_counts"), ("mult", "get_flag", "metric_map"), WITH_DC,
             ("SparseGaussianAdam",), module=RASTERIZER + "_fastgs"),
    Contract("mini_splatting", "Mini-Splatting", ("color", "radii", "weights", "counts", "largest"),
             methods=("render_depth",), module=RASTERIZER + "_ms",
             other_results=(("color", "radii"),)),  # of Inria's, which its trainer calls too
    Contract("dngaussian", "DNGaussian (`_depth`)", ("color", "radii", "depth", "alpha"), module=RASTERIZER + "_depth"),
    Contract("gsplat", "gsplat, nerfstudio", ("renders", "alphas", "meta"), module="gsplat"),
)


def ordered(results: Tuple[str, ...]) -> Contract:
    """Returns the entry of a rasterizer like Inria's whose results come in another order: names of WORDS, each once.

    Whatever is free may come with them. Raises KeyError if they are others, or without `color` and `radii`.
    """
    if len(set(results)) < len(results) or not {"color", "radii"} <= set(results) <= {name for name, _ in WORDS}:
        raise KeyError(",".join(results))
    return Contract(",".join(results), "rasterizers whose results come in this order", results, FREE_SETTINGS,
                    (*ARGUMENTS, "dc", *FREE_ARGUMENTS), ("SparseGaussianAdam", "compute_relocation"),
                    methods=FREE_METHODS)


def contract_of(name: str) -> Contract:
    """Returns the entry of a name, or of results with commas between them. Raises KeyError if there is none."""
    return ordered(tuple(name.split(","))) if "," in name else {contract.name: contract for contract in CONTRACTS}[name]
