"""The API of c3dgs's rasterizer: Inria's of 2023, `clamp_color`, and Gaussians that share the rows of codebooks.

An index says which row of a codebook a Gaussian has; the gradient of a row is the sum over the Gaussians that have it.
"""
from __future__ import annotations

import weakref

import torch

from diff_smoe_rasterization import GaussianRasterizer, rasterize_gaussians
from diff_smoe_rasterization.arguments import tensor_checks

from ._rasterizer import settings_with

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "GaussianRasterizerIndexed", "rasterize_gaussians",
           "rasterize_gaussians_indexed"]

GaussianRasterizationSettings = settings_with(["clamp_color"], __name__)
GaussianRasterizationSettings.__doc__ = """The package's settings, with `clamp_color` as the thirteenth.

clamp_color=False: colours from shs may be negative, and the gradient reaches their coefficients all the same.
"""


class GaussianRasterizerIndexed(GaussianRasterizer):
    """Renders as `rasterize_gaussians_indexed`. raster_settings: GaussianRasterizationSettings."""

    def forward(self, means3D, means2D, opacities, sh_indices, g_indices, shs=None, colors_precomp=None, scales=None,
                scale_factors=None, rotations=None, cov3D_precomp=None):
        """Returns color [C, H, W], radii [N] int32."""
        return rasterize_gaussians_indexed(means3D, means2D, shs, sh_indices, g_indices, colors_precomp, opacities,
                                           scales, scale_factors, rotations, cov3D_precomp, self.raster_settings)


def rasterize_gaussians_indexed(means3D, means2D, sh, sh_indices, g_indices, colors_precomp, opacities, scales,
                                scale_factors, rotations, cov3Ds_precomp, raster_settings):
    """Renders N Gaussians whose harmonics and shapes are rows of codebooks.

    Args:
        sh: [S, K, 3] harmonics. colors_precomp [N, C], instead of them, has a row for each Gaussian.
        sh_indices: [N] int64, the row of sh that a Gaussian has; not read if sh is absent.
        scales, rotations: [G, 3] and [G, 4], used as given. cov3Ds_precomp [N, 6], instead of them, has a row for each
            Gaussian.
        g_indices: [N] int64, the row of scales and of rotations that a Gaussian has; not read if they are absent.
        scale_factors: [N, 1] or [N], what a Gaussian's scales are multiplied by, beside `scale_modifier`; absent: 1.
    The others are those of `diff_smoe_rasterization.rasterize`, and so are types, errors, and what is absent. An index
    that is negative or beyond its codebook raises ValueError. The host looks for one if a tensor of indices is new,
    was changed, or meets a codebook of another length. On a GPU it waits in that call, in no other.

    Returns: color [C, H, W], radii [N] int32. Gradients equal bit for bit from run to run if those of `rasterize`
    do.
    """
    required, _ = tensor_checks("rasterize_gaussians_indexed", "means3D", means3D)
    if means3D.dim() != 2:
        raise ValueError(f"rasterize_gaussians_indexed: means3D has shape {list(means3D.shape)}; it must be [N, 3]")
    count = len(means3D)

    def rows(name, codebook, index_name, indices):
        if not _is_given(codebook):
            return None
        required(name, codebook)
        _check_indices(index_name, required(index_name, indices), count, name, codebook)
        # On a GPU the gradient of index_select adds by atomics. The gradient of codebook[indices] sorts: it is slower.
        sorts = raster_settings.deterministic and codebook.is_cuda
        return codebook[indices] if sorts else codebook.index_select(0, indices)

    sh = rows("shs", sh, "sh_indices", sh_indices)
    scales = rows("scales", scales, "g_indices", g_indices)
    rotations = rows("rotations", rotations, "g_indices", g_indices)
    if scales is not None and _is_given(scale_factors):
        required("scale_factors", scale_factors)
        if scale_factors.dtype != scales.dtype:
            raise TypeError(f"rasterize_gaussians_indexed: scale_factors is {_name(scale_factors.dtype)}; it must be "
                            f"{_name(scales.dtype)}, as scales is")
        if list(scale_factors.shape) not in ([count], [count, 1]):
            raise ValueError(f"rasterize_gaussians_indexed: scale_factors has shape {list(scale_factors.shape)}; it "
                             f"must be [{count}, 1] or [{count}]")
        scales = scale_factors.reshape(count, 1) * scales
    return rasterize_gaussians(means3D, means2D, sh, colors_precomp, opacities, scales, rotations, cov3Ds_precomp,
                               raster_settings)


def _is_given(tensor):
    """Callers pass torch.Tensor([]) for what is absent."""
    return tensor is not None and not (isinstance(tensor, torch.Tensor) and tensor.shape == (0,))


def _name(dtype):
    return str(dtype).replace("torch.", "")


# The tensors of indices that were found to fit, by what would make them another case.
_fitting = weakref.WeakValueDictionary()


def _check_indices(name, indices, count, codebook_name, codebook):
    """Raises unless each index names a row of the codebook. Its rows are its first axis."""
    where = "rasterize_gaussians_indexed"
    if codebook.dim() != (3 if codebook_name == "shs" else 2):
        expected = {"shs": "[S, K, 3]", "scales": "[G, 3]", "rotations": "[G, 4]"}[codebook_name]
        raise ValueError(f"{where}: {codebook_name} has shape {list(codebook.shape)}; it must be {expected}")
    if indices.dtype != torch.int64:
        raise TypeError(f"{where}: {name} is {_name(indices.dtype)}; it must be int64: cast it, for instance with "
                        f"{name}.long()")
    if indices.shape != (count,):
        raise ValueError(f"{where}: {name} has shape {list(indices.shape)}; it must be [{count}]")
    version = None if indices.is_inference() else indices._version
    case = (id(indices), version, len(codebook))
    if version is not None and _fitting.get(case) is indices:
        return
    wrong = ((indices < 0) | (indices >= len(codebook))).nonzero()
    if len(wrong) > 0:
        first = wrong[0].item()
        raise ValueError(f"{where}: {name}[{first}] is {indices[first].item()}; it must be at least 0 and below "
                         f"{len(codebook)}, the number of rows of {codebook_name}")
    if version is not None:
        for other in [other for other in _fitting.keys() if other[0] == id(indices) and other[1] != version]:
            del _fitting[other]  # of before the tensor was changed
        _fitting[case] = indices
