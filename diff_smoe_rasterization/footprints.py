"""A rendering in two halves: Gaussians to footprints on the image, and footprints to pixels.

    footprints = project_gaussians(means3D, opacities, settings, shs=shs, scales=scales, rotations=rotations)
    rendering = blend_footprints(footprints, settings)

gives what `rasterize` gives, bit for bit. In between, footprints can be selected, joined with others, changed, or sent
to where they are blended. Both halves are differentiable.
"""
from __future__ import annotations

import math
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import torch

from .arguments import as_rendering, op_arguments, op_options, tensor_checks
from .autograd import INPUTS, OPTIONS, once_differentiable, refuse_transforms
from .core import _core
from .learned_gate import gate_of
from .settings import (
    BLEND_MODES,
    FEATURE_OUTPUTS,
    GaussianRasterizationSettings,
    Rendering,
    resolve_blend,
    resolve_lens,
    resolve_shutter,
)

_OPS = torch.ops.diff_smoe_rasterization
GATE_NUMBERS = 8
"""Numbers of a gate: centre (2), conic (3), opacity, squared reach, depth."""
GATE_GRADIENTS = 6
"""Numbers of a gate that have a gradient from the pixels: the first six."""
_OPACITY, _REACH = 5, 6


class Footprints(NamedTuple):
    """What the pixels of one image read of N Gaussians.

    A footprint of radius 0 is on no pixel, and its other numbers mean nothing. Of two footprints of one depth the first
    is blended first. An opacity that is changed needs the reach that belongs to it: project again.
    """

    gates: torch.Tensor  # [N, 8] centre x, y in pixels; conic xx, xy, yy; opacity; squared reach in sigmas; view depth
    features: torch.Tensor  # [N, F] colour channels, then z and 1 / z for the outputs `depth` and `inverse_depth`
    radii: torch.Tensor  # [N] int32 pixels

    @property
    def means2D(self) -> torch.Tensor:
        """[N, 2] centres x, y in pixels; the centre of the first pixel is (0, 0)."""
        return self.gates[:, :2]

    @property
    def conics(self) -> torch.Tensor:
        """[N, 3] xx, xy, yy of the inverse covariance, 1 / pixel^2."""
        return self.gates[:, 2:5]

    @property
    def opacities(self) -> torch.Tensor:
        """[N] after antialiasing."""
        return self.gates[:, 5]

    @property
    def depths(self) -> torch.Tensor:
        """[N] view z, or what `CAMERA_MODELS` has as the depth. They order the footprints."""
        return self.gates[:, 7]

    def rows(self, index: torch.Tensor) -> Footprints:
        """The footprints that an index or a mask [N] selects."""
        return Footprints(self.gates[index], self.features[index], self.radii[index])

    def visible(self) -> Footprints:
        """Those of a radius above 0, in their order. The host waits for their number."""
        return self.rows(self.radii.nonzero().squeeze(1))

    def around(self, width: int) -> Footprints:
        """Those of an equirectangular image of this width, and the footprints that cross its seam on both sides of it.

        Copies, moved by the width, follow the others: those of `copied`. A footprint has at most one copy on each side,
        so the seam shows where a footprint reaches further than the width. The host waits for their number. Raises
        ValueError for a width below 1.
        """
        parts = [self]
        for index, step in zip(self.copied(width), (width, -width)):
            shift = self.gates.new_tensor([step, *[0] * (GATE_NUMBERS - 1)])
            copies = self.rows(index)
            parts.append(copies._replace(gates=copies.gates + shift))
        return Footprints.joined(parts)

    def copied(self, width: int) -> Tuple[torch.Tensor, torch.Tensor]:
        """Which footprints `around` copies, int64: to the right those at the left border, then those at the right."""
        if width < 1:
            raise ValueError(f"around: width is {width}; it must be that of the equirectangular image, 1 or more")
        column, opacity, squared_reach = self.gates.detach()[:, (0, _OPACITY, _REACH)].unbind(1)
        reach = _OPS.pixel_reach(self.radii, opacity, squared_reach)
        return (((self.radii > 0) & (column < reach)).nonzero().squeeze(1),
                ((self.radii > 0) & (column > width - 1 - reach)).nonzero().squeeze(1))

    @staticmethod
    def joined(parts: Sequence[Footprints]) -> Footprints:
        """All footprints of several parts, one part behind the other."""
        gates, features, radii = zip(*parts)
        return Footprints(torch.cat(gates), torch.cat(features), torch.cat(radii))


def project_gaussians(means3D: torch.Tensor, opacities: torch.Tensor, settings: GaussianRasterizationSettings,
                      means2D: Optional[torch.Tensor] = None, dc: Optional[torch.Tensor] = None,
                      shs: Optional[torch.Tensor] = None, colors_precomp: Optional[torch.Tensor] = None,
                      scales: Optional[torch.Tensor] = None, rotations: Optional[torch.Tensor] = None,
                      cov3D_precomp: Optional[torch.Tensor] = None, outputs: Sequence[str] = ()) -> Footprints:
    """The first half of `rasterize`, whose arguments these are, but means2D_abs; it raises as `rasterize` does.

    Gradients reach every tensor, but settings.bg and settings.background_gate, whose gradients the second half has.
    They come from all numbers of the footprints, the reach included. In `smoe_eq7` the reach depends on background_gate
    and alpha_min: give both halves the same, or the image is of neither.
    """
    inputs, options = op_arguments("project_gaussians", settings, outputs, means3D, opacities, means2D=means2D, dc=dc,
                                   shs=shs, colors_precomp=colors_precomp, scales=scales, rotations=rotations,
                                   cov3D_precomp=cov3D_precomp)
    refuse_transforms("project_gaussians", inputs)
    if _wants_gradient(inputs):
        return Footprints(*_Project.apply((*options, True), *inputs))
    return Footprints(*_OPS.project(*inputs, *options, False))


def projection_arguments(settings: GaussianRasterizationSettings, means3D: torch.Tensor, opacities: torch.Tensor,
                         **tensors: Optional[torch.Tensor]) -> Tuple[List[Optional[torch.Tensor]], List[Any]]:
    """The tensors and the options of the op `project`, all but the last option. The arguments of the function."""
    return op_arguments("project_gaussians", settings, (), means3D, opacities, **tensors)


def camera_tensors(settings: GaussianRasterizationSettings) -> List[torch.Tensor]:
    """The tensors of a view that the ops on batches take, without a rolling shutter `viewmatrix` twice."""
    end = settings.viewmatrix_end
    return [settings.viewmatrix, settings.projmatrix, settings.campos, settings.viewmatrix if end is None else end]


def image_numbers(settings: GaussianRasterizationSettings) -> List[float]:
    """What the ops on batches take of a view besides its tensors."""
    model, lens = resolve_lens(settings)
    most = _core.constants["most_lens_numbers"]
    numbers = (settings.image_width, settings.image_height, settings.tanfovx, settings.tanfovy, model, len(lens),
               resolve_shutter(settings))
    return [float(number) for number in numbers] + (lens + [0.0] * most)[:most]


def blend_op_arguments(footprints: Footprints, settings: GaussianRasterizationSettings,
                       outputs: Sequence[str] = ()) -> Tuple[List[Optional[torch.Tensor]], List[Any]]:
    """The tensors and the options of the op `blend`, all but the last option. Raises as `blend_footprints` does."""
    blend_mode, gate = resolve_blend(settings)
    required, _ = tensor_checks("blend_footprints", "gates", footprints.gates)
    gate = gate_of(gate, blend_mode, (footprints.gates, footprints.features))
    learned = isinstance(gate, torch.Tensor)
    tensors = [footprints.gates, required("features", footprints.features), required("radii", footprints.radii),
               required("bg", settings.bg), required("background_gate", gate) if learned else None]
    return tensors, op_options("blend_footprints", settings, outputs, blend_mode, 0.0 if learned else gate)


def blend_footprints(footprints: Footprints, settings: GaussianRasterizationSettings,
                     outputs: Sequence[str] = ()) -> Rendering:
    """The second half of `rasterize`: the images of footprints, of one projection or of several.

    Of the settings it takes the image's size, the background with its gate, the blend mode, alpha_min,
    faint_below and deterministic. Blend mode, and in `smoe_eq7` gate and alpha_min, must be those of the projection:
    they decide which pixels a footprint reaches. outputs: those that the footprints were projected for, `alpha` apart.
    Raises ValueError, TypeError or RuntimeError as `rasterize` does.
    """
    tensors, options = blend_op_arguments(footprints, settings, outputs)
    refuse_transforms("blend_footprints", tensors)
    shape = list(footprints.features.shape)
    columns = settings.bg.numel() + sum(name in outputs for name in FEATURE_OUTPUTS)
    if len(shape) == 2 and shape[1] != columns:  # the op would take rows that are filled up
        raise ValueError(f"blend_footprints: features has shape {shape}; it must be {[shape[0], columns]}; give "
                         "project_gaussians and blend_footprints the same outputs and background")
    if _wants_gradient(tensors):
        images = _Blend.apply((*options, True), *tensors)
    else:
        images = _OPS.blend(*tensors, *options, False)[:-1]
    color, *optional = images
    return as_rendering((color, footprints.radii, *optional), outputs)


def _wants_gradient(tensors: Sequence[Optional[torch.Tensor]]) -> bool:
    return torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in tensors)


def _spread(tensors: Sequence[torch.Tensor], present: Sequence[bool]) -> List[Optional[torch.Tensor]]:
    """The tensors in their places, None if none was given."""
    given = iter(tensors)
    return [next(given) if here else None for here in present]


def _reach_moves(opacities: torch.Tensor, options: Dict[str, Any], gate: Optional[torch.Tensor]) -> torch.Tensor:
    """[N] bool: whether the squared reach is 2 log(opacity / least alpha) and the least alpha is constant.

    Elsewhere the reach is constant. The rule is `squared_reach` and `AlphaCut` in include/dsmoe/gate.h.
    """
    positive, constants = opacities > 0, _core.constants
    if BLEND_MODES[options["blend_mode"]] in ("alpha", "smoe"):
        return positive
    faint = constants["alpha_cut"] * (options["fixed_background_gate"] if gate is None else gate.reshape(()))
    core = opacities * constants["core_kernel"]
    least = core.minimum(torch.as_tensor(faint).to(core)).clamp(min=options["alpha_min"])
    widest = -2 * math.log(constants["gate_cut"])
    return positive & (least > 0) & (least != core) & (2 * (opacities / least).log() < widest)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, options: Tuple[Any, ...], *inputs: Any) -> Tuple[torch.Tensor, ...]:
        gates, features, radii = _OPS.project(*inputs, *options)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        ctx.options, ctx.present = options, [tensor is not None for tensor in inputs]
        # The caller may edit gates and features, so they are copied.
        ctx.save_for_backward(*(tensor for tensor in inputs if tensor is not None), features.clone(),
                              gates[:, _OPACITY].clone(), radii)
        return gates, features, radii

    @staticmethod
    @once_differentiable("project_gaussians")
    def backward(ctx: Any, dL_dgates: Any, dL_dfeatures: Any, _: Any) -> Tuple[Any, ...]:  # type: ignore[override]
        *inputs, features, opacities, radii = ctx.saved_tensors
        wanted = list(ctx.needs_input_grad[1:])
        belongs = [want and name not in ("bg", "background_gate") for want, name in zip(wanted, INPUTS)]
        by_gates = features.new_zeros(len(features), GATE_NUMBERS) if dL_dgates is None else dL_dgates
        by_features = torch.zeros_like(features) if dL_dfeatures is None else dL_dfeatures
        records = torch.cat([by_gates[:, :GATE_GRADIENTS], by_features], 1)
        if dL_dgates is not None:
            given = dict(zip(INPUTS, _spread(inputs, ctx.present)))
            moves = (radii > 0) & _reach_moves(opacities, dict(zip(OPTIONS, ctx.options)), given["background_gate"])
            records[:, _OPACITY] += (2 * by_gates[:, _REACH] / opacities).masked_fill(~moves, 0)
        results = iter(_OPS.project_backward(records, None if dL_dgates is None else by_gates[:, -1].contiguous(),
                                             inputs, ctx.present, features, radii, *ctx.options, belongs))
        return (None, *(next(results) if want else None for want in belongs))


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, options: Tuple[Any, ...], gates: torch.Tensor, features: torch.Tensor, radii: torch.Tensor,
                bg: torch.Tensor, background_gate: Optional[torch.Tensor]) -> Tuple[torch.Tensor, ...]:
        *images, saved = _OPS.blend(gates, features, radii, bg, background_gate, *options)
        ctx.set_materialize_grads(False)
        ctx.options, ctx.has_gate = options, background_gate is not None
        ctx.images = [image.clone() for image in images]  # the caller may edit them
        gate = () if background_gate is None else (background_gate,)
        ctx.save_for_backward(gates, features, radii, bg, *gate, *saved)
        return tuple(images)

    @staticmethod
    @once_differentiable("blend_footprints")
    def backward(ctx: Any, *image_gradients: Any) -> Tuple[Any, ...]:  # type: ignore[override]
        gates, _, radii, bg, *kept = ctx.saved_tensors
        gate = kept.pop(0) if ctx.has_gate else None
        wants_background = ctx.needs_input_grad[4] or ctx.needs_input_grad[5]
        records, dL_dbg, dL_dgate = _OPS.blend_backward(*image_gradients, ctx.images, kept, radii, bg, gate,
                                                        *ctx.options, wants_background)
        dL_dgates = torch.zeros_like(gates)
        dL_dgates[:, :GATE_GRADIENTS] = records[:, :GATE_GRADIENTS]
        return (None, dL_dgates, records[:, GATE_GRADIENTS:], None, dL_dbg if ctx.needs_input_grad[4] else None,
                dL_dgate.reshape(gate.shape) if gate is not None and ctx.needs_input_grad[5] else None)
