"""The Python APIs of public Gaussian rasterizers, as data: how a trainer is recognised by them, and what is returned.

From this table come the modules here, what `dsmoe run` answers for, how `dsmoe patch` tells trainers apart, and the
table in README.md. A new rasterizer of Inria's kind is one entry and a module of three lines, such as depth.py.
"""
from __future__ import annotations

from typing import NamedTuple, Tuple

RASTERIZER = "diff_gaussian_rasterization"  # the name that trainers import
SETTINGS = ("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
            "sh_degree", "campos", "prefiltered", "debug")
ARGUMENTS = ("means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp")
NAMES = ("GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians")

RESULTS = {  # what a result is, and a word that is in the name that callers give it, if it must be
    "color": ("[C, H, W]", ""),
    "radii": ("[N] int32, pixels", ""),
    "inverse_depth": ("[1, H, W], 1 / z blended as a colour over 0", ""),
    "depth": ("[1, H, W], z blended as a colour over 0", "depth"),
    "alpha": ("[1, H, W], the share of the pixel that the background does not have", "alpha"),
}


class Contract(NamedTuple):
    """What callers of a rasterizer rely on, beside SETTINGS, ARGUMENTS and NAMES, which all have."""

    name: str  # of the module here, and for `dsmoe run --trainer`
    used_by: str
    results: Tuple[str, ...] = ("color", "radii")  # of a call, in order
    settings: Tuple[str, ...] = ()  # behind `debug`
    arguments: Tuple[str, ...] = ARGUMENTS  # of a call, in order
    names: Tuple[str, ...] = ()  # that can be imported
    signs: Tuple[str, ...] = ()  # a caller shows one of these (patches/facts.py); none: it needs to show nothing


WITH_DC = ARGUMENTS[:3] + ("dc",) + ARGUMENTS[3:]
TAMING = ("color", "radii", "counts", "lists", "listsRender", "listsDistance", "centers", "depths", "my_radii",
          "accum_weights", "accum_count", "accum_blend", "accum_dist")

CONTRACTS = (
    Contract("scaffold", "Scaffold-GS, Octree-GS, HAC, HAC++", signs=("calls visible_filter",)),
    Contract("c3dgs", "c3dgs (3DGS-C)", settings=("clamp_color",),
             arguments=(*ARGUMENTS, "sh_indices", "g_indices", "scale_factors"),
             names=("GaussianRasterizerIndexed", "rasterize_gaussians_indexed"),
             signs=("sets clamp_color", "imports GaussianRasterizerIndexed")),
    Contract("taming", "Taming-3DGS", TAMING, ("pixel_weights",), WITH_DC, ("SparseGaussianAdam",),
             ("sets pixel_weights",)),
    Contract("inria_2024", "3DGS of 2024 (`antialiasing`, sparse Adam)", ("color", "radii", "inverse_depth"),
             ("antialiasing",), WITH_DC, ("SparseGaussianAdam",),
             ("sets antialiasing", "takes dc", "imports SparseGaussianAdam", "reads invdepthmap")),
    Contract("inria", "3DGS of 2023, GaussianPro, InstantSplat, Compact-3DGS, SuGaR"),
    Contract("depth", "4DGaussians, Deformable 3D Gaussians, GaussianEditor, SplaTAM", ("color", "radii", "depth"),
             arguments=(*ARGUMENTS, "means2D_densify")),
    Contract("depth_alpha", "dreamgaussian, LGM, DNGaussian, FSGS, SC-GS", ("color", "radii", "depth", "alpha"),
             settings=("confidence",)),
)


def contract_of(name: str) -> Contract:
    """Returns the entry of a name. Raises KeyError where there is none."""
    return {contract.name: contract for contract in CONTRACTS}[name]
