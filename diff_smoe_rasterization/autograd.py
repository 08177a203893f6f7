"""Gradients of the op `rasterize`, and what torch.compile must know of the ops.

One formula, `_keep` and `_backward`, stands behind the op in two ways: registered with torch (2.4 and later), so that
torch.compile sees through it, and in an autograd.Function, which costs less a call, for all that is not compiled.
Compiled code takes any number of Gaussians and any image size; another field of view may be compiled anew.
"""
from __future__ import annotations

import contextlib

import torch
from torch.autograd import forward_ad

from .extension import _C  # noqa: F401  (loading it registers the ops)

_OPS = torch.ops.diff_smoe_rasterization
_CAN_REGISTER = hasattr(torch.library, "register_autograd")
_NUM_INPUTS = 14  # tensors before the options
_NUM_OPTIONS = 16  # options that the backward op takes too
_NUM_IMAGES = 5  # results that are the caller's: color, radii, gate_sum, depth, inverse_depth
_RADII, _DEPTH = 1, 3
_BLEND_MODE = _NUM_INPUTS + 9  # among the op's arguments
_ALPHA = 0  # BLEND_MODES.index("alpha")


# Eager calls skip the Python wrapper that register_autograd puts around an op: the formula is already in hand.
_below_autograd = getattr(torch._C, "_AutoDispatchBelowAutograd", None)
if not hasattr(_below_autograd, "__enter__"):  # torch 1.13 has it, but not as a context manager
    _below_autograd = contextlib.nullcontext


def refuse_forward_mode(function, values):
    """Raises NotImplementedError where a tensor among the values carries a tangent: the ops would drop it."""
    if forward_ad._current_level < 0:  # nobody takes a forward-mode derivative; unpack_dual would cost time
        return
    # Tensors that torch.compile traces do not always show their tangents.
    compiling = _CAN_REGISTER and torch.compiler.is_compiling()
    for value in values:
        if isinstance(value, torch.Tensor) and (compiling or forward_ad.unpack_dual(value).tangent is not None):
            raise NotImplementedError(f"{function}: forward-mode derivatives (torch.func.jvp, jacfwd, dual tensors) "
                                      "are not implemented; take those of backward mode (torch.autograd.grad)")


def _remember(ctx, inputs, output):
    """Notes what is no tensor, and what needs no gradient. Returns the tensors that were given."""
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[_RADII], *output[_NUM_IMAGES:])
    ctx.options = inputs[_NUM_INPUTS:_NUM_INPUTS + _NUM_OPTIONS]
    ctx.present = [tensor is not None for tensor in inputs[:_NUM_INPUTS]]
    return [tensor for tensor in inputs[:_NUM_INPUTS] if tensor is not None]


def _keep(ctx, inputs, output):
    """Keeps what the backward pass needs. The images are the caller's to edit in place, so they are copied."""
    images = [image if i == _RADII else image.clone() for i, image in enumerate(output[:_NUM_IMAGES])]
    ctx.save_for_backward(*_remember(ctx, inputs, output), *images, *output[_NUM_IMAGES:])


def _input_gradients(ctx, gradients, outputs, inputs, op):
    wanted = list(ctx.needs_input_grad[:_NUM_INPUTS])
    image_gradients = [gradient for i, gradient in enumerate(gradients[:_NUM_IMAGES]) if i != _RADII]
    refuse_forward_mode("rasterize", [*gradients, *inputs])
    results = iter(op(*image_gradients, inputs, ctx.present, outputs, *ctx.options, wanted))
    no_tensors = len(ctx.needs_input_grad) - _NUM_INPUTS
    return tuple(next(results) if want else None for want in wanted) + (None,) * no_tensors


def _backward(ctx, *gradients):
    saved = list(ctx.saved_tensors)
    count = sum(ctx.present)
    return _input_gradients(ctx, gradients, saved[count:], saved[:count], _OPS.rasterize_backward)


def _refuse_second_derivative(ctx, *gradients):
    raise RuntimeError("rasterize: second derivatives are not implemented; its gradients cannot be differentiated "
                       "again")


class _Rasterize(torch.autograd.Function):
    """The same formula for eager calls: nothing between Python and the kernels that they do not need."""

    @staticmethod
    def forward(ctx, *inputs):
        with _below_autograd():
            output = _OPS.rasterize.default(*inputs)
        # In `alpha` mode the backward pass reads the images for an expected depth alone; else the caller may edit them.
        read = inputs[_BLEND_MODE] != _ALPHA or output[_DEPTH].numel() > 0
        ctx.images = [image.clone() if read and image.numel() > 0 else image.detach()
                      for i, image in enumerate(output[:_NUM_IMAGES]) if i != _RADII]
        ctx.save_for_backward(*_remember(ctx, inputs, output), output[_RADII], *output[_NUM_IMAGES:])
        return output

    def backward(ctx, *gradients):
        saved = list(ctx.saved_tensors)
        count = sum(ctx.present)
        radii, *internal = saved[count:]
        outputs = [*ctx.images[:_RADII], radii, *ctx.images[_RADII:], *internal]
        # Under create_graph=True the op itself is called, which refuses to be differentiated when somebody tries.
        with contextlib.nullcontext() if torch.is_grad_enabled() else _below_autograd():
            return _input_gradients(ctx, gradients, outputs, saved[:count], _OPS.rasterize_backward.default)

    backward = staticmethod(backward if _CAN_REGISTER else torch.autograd.function.once_differentiable(backward))


def rasterize_op(*inputs):
    """Calls the op `rasterize` differentiably. Arguments and results: csrc/torch/schema.cpp."""
    refuse_forward_mode("rasterize", inputs)
    if _CAN_REGISTER and torch.compiler.is_compiling():
        return _OPS.rasterize(*inputs, torch.is_grad_enabled())  # for_backward
    if torch.is_grad_enabled() and any(isinstance(value, torch.Tensor) and value.requires_grad for value in inputs):
        return _Rasterize.apply(*inputs)
    with _below_autograd():
        return _OPS.rasterize.default(*inputs, for_backward=False)


def _fake_rasterize(means3D, means2D, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp, bg,
                    viewmatrix, projmatrix, campos, background_gate, image_height, image_width, tanfovx, tanfovy,
                    scale_modifier, near, alpha_min, fixed_background_gate, sh_degree, blend_mode, antialiasing, depth,
                    inverse_depth, deterministic, debug, clamp_color, strict, prefiltered, for_backward=True):
    """The results' shapes and types, as csrc/torch/tensors.cpp allocates them."""
    count = means3D.shape[0]
    channels = 3 if colors_precomp is None else colors_precomp.shape[1]
    tile = _C.constants["tile_size"]
    tiles = ((image_width + tile - 1) // tile) * ((image_height + tile - 1) // tile)
    num_instances = torch.library.get_ctx().new_dynamic_size()
    num_features = channels + int(depth) + int(inverse_depth)
    if means3D.device.type == "cuda":
        feature_row, num_tile_offsets, instance_row, in_order = (num_features + 3) // 4 * 4, tiles + 2, 1, count
        instance_offsets, segments, segment_queue = (0,), (0,), (0,)
        if means3D.dtype == torch.float32 and num_features == 3:
            rows = num_instances // _C.constants["segment_length"] + 1 if for_backward else 0
            segments, segment_queue = (rows, 4 * tile * tile), (1 + 4 * rows if for_backward else 0, 2)
        if deterministic:
            instance_row, instance_offsets = 2, (count, 2)
    else:
        feature_row, num_tile_offsets, instance_row, in_order = num_features, tiles + 1, 2, 0
        instance_offsets, segments, segment_queue = (count + 1,), (0,), (0,)

    def image(wanted=True):
        return means3D.new_empty((1, image_height, image_width) if wanted else (0,))

    return (means3D.new_empty((channels, image_height, image_width)), means3D.new_empty((count,), dtype=torch.int32),
            image(), image(depth), image(inverse_depth), means3D.new_empty((count, 8)),
            means3D.new_empty((count, feature_row)), means3D.new_empty(instance_offsets, dtype=torch.int64),
            means3D.new_empty((num_tile_offsets,), dtype=torch.int64),
            means3D.new_empty((num_instances, instance_row), dtype=torch.int32),
            means3D.new_empty((image_height, image_width)),
            means3D.new_empty((image_height, image_width), dtype=torch.int32),
            means3D.new_empty((in_order,), dtype=torch.int32), means3D.new_empty(segments),
            means3D.new_empty(segment_queue, dtype=torch.int32))


def _fake_rasterize_backward(dL_dcolor, dL_dgate_sum, dL_ddepth, dL_dinverse_depth, inputs, present, outputs,
                             *options_and_wanted):
    given = iter(inputs)
    all_inputs = [next(given) if here else None for here in present]
    return [tensor.new_empty(tensor.shape) for tensor, want in zip(all_inputs, options_and_wanted[-1]) if want]


def _fake_mark_visible(positions, viewmatrix, near):
    return positions.new_empty((positions.shape[0],), dtype=torch.bool)


def _fake_contributions(pixel_weights, radii, projected, *others):
    def sums():
        return projected.new_empty((projected.shape[0],))

    return sums(), radii.new_empty((projected.shape[0],)), sums(), sums()


if _CAN_REGISTER:
    _NAME = "diff_smoe_rasterization::"
    torch.library.register_fake(_NAME + "rasterize", _fake_rasterize)
    torch.library.register_fake(_NAME + "rasterize_backward", _fake_rasterize_backward)
    torch.library.register_fake(_NAME + "mark_visible", _fake_mark_visible)
    torch.library.register_fake(_NAME + "contributions", _fake_contributions)
    torch.library.register_autograd(_NAME + "rasterize", _backward, setup_context=_keep)
    torch.library.register_autograd(_NAME + "rasterize_backward", _refuse_second_derivative)
