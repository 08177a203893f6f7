"""The rasterizer as a function, and as the function and the module that 3D Gaussian Splatting trainers call."""
from __future__ import annotations

from typing import Optional, Sequence, Tuple

import torch

from .autograd import INPUTS, OPTIONS, rasterize_op
from .extension import BACKENDS, build_info
from .settings import BLEND_MODES, OUTPUTS, GaussianRasterizationSettings, Rendering, resolve_blend
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
        opacities: [N, 1] or [N]; may exceed 1.
        settings: camera and options. Its viewmatrix, projmatrix, campos, bg and, as a tensor, background_gate are
            differentiable too, each on its own.
        means2D: [N, 3], of which only the gradient is of use: dL/d(pixel) times (width / 2, height / 2), z = 0.
            Densification reads it.
        shs: [N, K, 3] spherical harmonics, K >= (sh_degree + 1)^2.
        dc: [N, 1, 3], the first coefficient where shs [N, K - 1, 3] holds only the others.
        colors_precomp: [N, C] instead of shs; C is free and settings.bg has as many.
        scales, rotations: [N, 3] standard deviations, world, and [N, 4] quaternions (w, x, y, z), used as given.
        cov3D_precomp: [N, 6] (xx, xy, xz, yy, yz, zz) instead of scales and rotations.
        outputs: names out of OUTPUTS, images to return beside the colour.
        means2D_abs: [N, 2], of which only the gradient is of use: the sum over pixels of the absolute values of
            dL/d(pixel), each axis apart, times (width / 2, height / 2). Without it nothing is summed.
    All tensors have one type, float32 or float64, and one device. Absent is None, or any tensor without elements.

    Returns: Rendering. A Gaussian with a NaN or infinite attribute is culled: radius 0, gradients 0.
    Raises:
        ValueError: a shape or a value does not fit; both or neither of shs and colors_precomp, or of scales with
            rotations and cov3D_precomp, are given; background_gate does not fit the blend mode; under
            `settings.strict` an attribute is not finite; under `settings.prefiltered` a Gaussian is not beyond the near
            plane.
        TypeError: a type or a device does not fit.
        RuntimeError: the Gaussians cover more tiles than fit; under `settings.debug` a result or gradient is NaN.

    On CUDA the value of a tensor background_gate is not checked: the host would have to wait for it.
    """
    inputs, options = _arguments(settings, outputs, means3D, opacities, means2D=means2D, dc=dc, shs=shs,
                                 colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                                 cov3D_precomp=cov3D_precomp, means2D_abs=means2D_abs)
    return _rendering(rasterize_op(inputs, options)[:-1], outputs)


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
    inputs, options = _arguments(settings, outputs, means3D, opacities, means2D=means2D, dc=dc, shs=shs,
                                 colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                                 cov3D_precomp=cov3D_precomp, means2D_abs=means2D_abs)
    *images, saved = rasterize_op(inputs, options)
    return _rendering(images, outputs), Splats(images, saved, inputs, options)


def visible_radii(means3D: torch.Tensor, settings: GaussianRasterizationSettings,
                  scales: Optional[torch.Tensor] = None, rotations: Optional[torch.Tensor] = None,
                  cov3D_precomp: Optional[torch.Tensor] = None) -> torch.Tensor:
    """Returns the radii [N] int32, in pixels, that `rasterize` would return for Gaussians of finite colours.

    A radius of 0 means that the Gaussian is not visible. Nothing is blended, so this costs only the projection. It has
    no gradient. The arguments are those of `rasterize` that a radius depends on; errors are as there.
    """
    # A radius depends neither on the opacity nor on the colour.
    inputs, options = _arguments(settings._replace(bg=means3D.new_zeros(1)), (), means3D,
                                 means3D.new_zeros(len(means3D)), colors_precomp=means3D.new_zeros(len(means3D), 1),
                                 scales=scales, rotations=rotations, cov3D_precomp=cov3D_precomp)
    with torch.no_grad():
        return torch.ops.diff_smoe_rasterization.radii(*inputs, *options, False)


def _rendering(images, outputs):
    color, radii, gate_sum, depth, inverse_depth = images
    return Rendering(color, radii, alpha=gate_sum if "alpha" in outputs else None,
                     depth=depth if "depth" in outputs else None,
                     inverse_depth=inverse_depth if "inverse_depth" in outputs else None)


def _arguments(settings, outputs, means3D, opacities, **tensors):
    """Returns the tensors and the options of a rendering in the order of the op; all options but the last one.

    Every eager call comes through here, and costs what this costs: what can be looked up once is looked up below.
    """
    if not _OUTPUTS.issuperset(outputs):
        raise ValueError(f"rasterize: outputs is {tuple(outputs)}; it may hold {', '.join(OUTPUTS)}")
    blend_mode, background_gate = resolve_blend(settings)
    required, optional = _checks("rasterize", "means3D", means3D)
    inputs = {"means3D": means3D, "opacities": required("opacities", opacities)}
    for name, tensor in tensors.items():
        if tensor is not None:
            inputs[name] = optional(name, tensor)
    fixed_gate = background_gate
    if isinstance(background_gate, torch.Tensor):
        inputs["background_gate"], fixed_gate = required("background_gate", background_gate), 0.0
    inputs["bg"] = required("bg", settings.bg)
    for name, dim in (("viewmatrix", 2), ("projmatrix", 2), ("campos", 1)):
        inputs[name] = _without_batch(required(name, getattr(settings, name)), dim)
    return [inputs.get(name) for name in INPUTS], _options(settings, outputs, blend_mode, fixed_gate)


def _options(settings, outputs, blend_mode, fixed_gate):
    """Returns the options of a rendering in the order of the op, all but the last one."""
    options = [kind(getattr(settings, name)) for name, kind in _SETTING_OPTIONS]
    computed = {"fixed_background_gate": fixed_gate, "blend_mode": BLEND_MODES.index(blend_mode),
                "depth": "depth" in outputs, "inverse_depth": "inverse_depth" in outputs}
    for name, place in _COMPUTED_OPTIONS.items():
        options.insert(place, computed[name])
    return options


_OUTPUTS = frozenset(OUTPUTS)

# The options that are computed, with their places; the others are settings of the same name. `rasterize_op` decides
# for_backward, which is the last one.
assert list(OPTIONS)[-1] == "for_backward"
_COMPUTED_OPTIONS = {name: place for place, name in enumerate(OPTIONS)
                     if name in ("fixed_background_gate", "blend_mode", "depth", "inverse_depth")}
_SETTING_OPTIONS = [(name, kind) for name, kind in list(OPTIONS.items())[:-1] if name not in _COMPUTED_OPTIONS]


def _checks(function, first_name, first):
    """Returns functions that pass a required and an optional tensor on, and refuse what torch cannot dispatch.

    Those are values that are no tensors and tensors on different devices; the ops refuse wrong shapes and types.
    """
    def required(name, value):
        if not isinstance(value, torch.Tensor):
            raise TypeError(f"{function}: {name} is of type {type(value).__name__}; it must be a torch.Tensor")
        if value.device != device:
            raise TypeError(f"{function}: {name} is on {value.device}; it must be on {device}, as {first_name} is")
        return value

    def optional(name, value):
        # Inria's callers pass torch.Tensor([]), on the CPU, for what is absent.
        if value is None:
            return None
        if isinstance(value, torch.Tensor) and value.numel() == 0 and (first.numel() > 0 or value.dim() == 1):
            return None
        return required(name, value)

    device = getattr(first, "device", None)
    required(first_name, first)
    if device.type not in BACKENDS:
        reason = build_info()["without_cuda_because"] if device.type == "cuda" else None
        raise TypeError(f"{function}: {first_name} is on {device}; this build renders on "
                        f"{' and '.join(BACKENDS)}" + (f": {reason}" if reason else ""))
    return required, optional


def _without_batch(tensor, dim):
    """Returns a camera tensor without the batch axis of size 1 that some trainers leave in front."""
    return tensor[0] if tensor.dim() == dim + 1 and tensor.shape[0] == 1 else tensor


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
        """Returns which positions [N, 3] lie beyond the near plane, [N] bool."""
        required, _ = _checks("markVisible", "positions", positions)
        viewmatrix = _without_batch(required("viewmatrix", self.raster_settings.viewmatrix), 2)
        return torch.ops.diff_smoe_rasterization.mark_visible(positions, viewmatrix, float(self.raster_settings.near))

    def forward(self, means3D: torch.Tensor, means2D: _Absent, opacities: torch.Tensor, shs: _Absent = None,
                colors_precomp: _Absent = None, scales: _Absent = None, rotations: _Absent = None,
                cov3D_precomp: _Absent = None, dc: _Absent = None) -> Tuple[torch.Tensor, torch.Tensor]:
        """Returns color [C, H, W], radii [N] int32. Arguments and errors are those of `rasterize`."""
        rendering = rasterize(means3D, opacities, self.raster_settings, means2D=means2D, dc=dc, shs=shs,
                              colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                              cov3D_precomp=cov3D_precomp)
        return rendering.color, rendering.radii
