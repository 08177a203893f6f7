"""The rasterizer as a function, and as the function and the module that 3D Gaussian Splatting trainers call."""
from __future__ import annotations

from typing import Optional, Sequence, Tuple

import torch

from .arguments import as_rendering, op_arguments, tensor_checks, without_batch
from .autograd import rasterize_op, refuse_transforms
from .settings import GaussianRasterizationSettings, Rendering, resolve_lens, resolve_shutter
from .splats import Splats


def rasterize(means3D: torch.Tensor, opacities: torch.Tensor, settings: GaussianRasterizationSettings,
              means2D: Optional[torch.Tensor] = None, dc: Optional[torch.Tensor] = None,
              shs: Optional[torch.Tensor] = None, colors_precomp: Optional[torch.Tensor] = None,
              scales: Optional[torch.Tensor] = None, rotations: Optional[torch.Tensor] = None,
              cov3D_precomp: Optional[torch.Tensor] = None, outputs: Sequence[str] = (),
              means2D_abs: Optional[torch.Tensor] = None) -> Rendering:
    """Renders N Gaussians by the equation that `settings.blend_mode` names (see BLEND_MODES).

    Args:
        means3D: [N, 3] centres, world.
        opacities: [N, 1] or [N]; may exceed 1, up to 1e20.
        settings: camera and options. Its viewmatrix, viewmatrix_end, projmatrix, campos, bg and, as a tensor,
            background_gate are differentiable too, each on its own. With background_gate="learned", and only then, the
            rendering is a step of a training: the gate of this process is stepped when the optimizer that holds means3D
            is.
        means2D: [N, 3]; only its gradient is used: dL/d(pixel) times (width / 2, height / 2), z = 0.
            Densification reads it.
        shs: [N, K, 3] spherical harmonics, K >= (sh_degree + 1)^2.
        dc: [N, 1, 3], the first coefficient if shs [N, K - 1, 3] holds only the others.
        colors_precomp: [N, C] instead of shs; C is free and settings.bg has as many.
        scales, rotations: [N, 3] standard deviations, world, and [N, 4] quaternions (w, x, y, z), used as given.
        cov3D_precomp: [N, 6] (xx, xy, xz, yy, yz, zz) instead of scales and rotations.
        outputs: names out of OUTPUTS, images to return beside the colour.
        means2D_abs: [N, 2]; only its gradient is used: the sum over pixels of the absolute values of
            dL/d(pixel), each axis apart, times (width / 2, height / 2). Without it nothing is summed.
    All tensors have one type, float32 or float64, and one device. Absent is None, or any tensor without elements;
    if N is 0, None or one of shape [0].

    Returns: Rendering. A Gaussian with a NaN or infinite attribute, or an opacity above 1e20, is culled: radius 0,
    gradients 0.
    Raises:
        ValueError: a shape or a value does not fit; bg or what is read of the camera's tensors is not finite; both or
            neither of shs and colors_precomp, or of scales with rotations and cov3D_precomp, are given;
            background_gate does not fit the blend mode; under `settings.strict` an attribute is not finite; under
            `settings.prefiltered` a Gaussian is not beyond the near plane.
        TypeError: a type or a device does not fit.
        RuntimeError: the Gaussians cover more tiles than fit; under `settings.debug` a result or gradient is NaN.

    On CUDA the values of the camera's tensors, of bg and of a tensor background_gate are not checked: the host would
    have to wait for them. `settings.debug` names a NaN there.
    """
    inputs, options = op_arguments("rasterize", settings, outputs, means3D, opacities, means2D=means2D, dc=dc, shs=shs,
                                   colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                                   cov3D_precomp=cov3D_precomp, means2D_abs=means2D_abs)
    return as_rendering(rasterize_op("rasterize", inputs, options)[:-1], outputs)


def rasterize_with_splats(means3D: torch.Tensor, opacities: torch.Tensor, settings: GaussianRasterizationSettings,
                          means2D: Optional[torch.Tensor] = None, dc: Optional[torch.Tensor] = None,
                          shs: Optional[torch.Tensor] = None, colors_precomp: Optional[torch.Tensor] = None,
                          scales: Optional[torch.Tensor] = None, rotations: Optional[torch.Tensor] = None,
                          cov3D_precomp: Optional[torch.Tensor] = None,
                          outputs: Sequence[str] = (),
                          means2D_abs: Optional[torch.Tensor] = None) -> Tuple[Rendering, Splats]:
    """Renders as `rasterize`, and also returns where the Gaussians are on the image and can say what each gave to it.

    Arguments and errors are those of `rasterize`. Splats hold on to memory of the rendering as long as they live.
    """
    inputs, options = op_arguments("rasterize_with_splats", settings, outputs, means3D, opacities, means2D=means2D,
                                   dc=dc, shs=shs, colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                                   cov3D_precomp=cov3D_precomp, means2D_abs=means2D_abs)
    *images, saved = rasterize_op("rasterize_with_splats", inputs, options)
    return as_rendering(images, outputs), Splats(images, saved, inputs, options)


def visible_radii(means3D: torch.Tensor, settings: GaussianRasterizationSettings,
                  scales: Optional[torch.Tensor] = None, rotations: Optional[torch.Tensor] = None,
                  cov3D_precomp: Optional[torch.Tensor] = None) -> torch.Tensor:
    """Returns the radii [N] int32, in pixels, that `rasterize` would return for Gaussians of finite colours.

    A radius of 0 means that the Gaussian is not visible. Nothing is blended, so this costs only the projection. It has
    no gradient. The arguments are those of `rasterize` that a radius depends on; errors are as there.
    """
    tensor_checks("visible_radii", "means3D", means3D)
    with torch.no_grad():
        # A radius depends neither on the opacity nor on the colour.
        of_each = means3D.new_zeros(means3D.shape[:1])
        inputs, options = op_arguments("visible_radii", settings._replace(bg=means3D.new_zeros(1)), (), means3D,
                                       of_each, colors_precomp=of_each.unsqueeze(-1),
                                       scales=scales, rotations=rotations, cov3D_precomp=cov3D_precomp)
        refuse_transforms("visible_radii", inputs)
        return torch.ops.diff_smoe_rasterization.radii(*inputs, *options, False)


_Absent = Optional[torch.Tensor]


def rasterize_gaussians(means3D: torch.Tensor, means2D: _Absent, sh: _Absent, colors_precomp: _Absent,
                        opacities: torch.Tensor, scales: _Absent, rotations: _Absent, cov3Ds_precomp: _Absent,
                        raster_settings: GaussianRasterizationSettings) -> Tuple[torch.Tensor, torch.Tensor]:
    """Renders as `rasterize`, with the arguments of Inria's function of 2023 in its order.

    Returns: color [C, H, W], radii [N] int32.
    """
    rendering = rasterize(means3D, opacities, raster_settings, means2D=means2D, shs=sh, colors_precomp=colors_precomp,
                          scales=scales, rotations=rotations, cov3D_precomp=cov3Ds_precomp)
    return rendering.color, rendering.radii


class GaussianRasterizer(torch.nn.Module):
    """Renders as `rasterize`, as Inria's module of 2023 does. raster_settings: GaussianRasterizationSettings."""

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    @torch.no_grad()
    def markVisible(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns which positions [N, 3] have a depth above `near`, [N] bool."""
        required, _ = tensor_checks("markVisible", "positions", positions)
        viewmatrix = without_batch(required("viewmatrix", self.raster_settings.viewmatrix), 2)
        refuse_transforms("markVisible", (positions, viewmatrix))
        model, _ = resolve_lens(self.raster_settings)
        end = self.raster_settings.viewmatrix_end if resolve_shutter(self.raster_settings) > 0 else None
        if end is not None:
            end = without_batch(required("viewmatrix_end", end), 2)
        return torch.ops.diff_smoe_rasterization.mark_visible(positions, viewmatrix, float(self.raster_settings.near),
                                                              model, end)

    def forward(self, means3D: torch.Tensor, means2D: _Absent, opacities: torch.Tensor, shs: _Absent = None,
                colors_precomp: _Absent = None, scales: _Absent = None, rotations: _Absent = None,
                cov3D_precomp: _Absent = None, dc: _Absent = None) -> Tuple[torch.Tensor, torch.Tensor]:
        """Returns color [C, H, W], radii [N] int32. Arguments and errors are those of `rasterize`."""
        rendering = rasterize(means3D, opacities, self.raster_settings, means2D=means2D, dc=dc, shs=shs,
                              colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                              cov3D_precomp=cov3D_precomp)
        return rendering.color, rendering.radii
