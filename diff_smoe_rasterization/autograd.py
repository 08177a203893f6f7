"""Gradients of the op `rasterize`, and the fake ops that torch.compile needs.

The op has one formula, `_keep` and `_backward`, which torch meets in two ways. It is registered with torch (2.4 and
later), so that torch.compile sees through the op. Eager calls take it by an autograd.Function, which costs less a call.
Compiled code takes any number of Gaussians and any image size. For another field of view it may be compiled anew.
"""
from __future__ import annotations

import contextlib
import functools

import torch
from torch.autograd import forward_ad

from .extension import _core  # loading it registers the ops
from .settings import FEATURE_OUTPUTS

_OPS = torch.ops.diff_smoe_rasterization
_CAN_REGISTER = hasattr(torch.library, "register_autograd")

INPUTS, IMAGES = _core.inputs, _core.images
"""The names of the op's tensors, and of the images among its results. csrc/torch/fields.h lists them."""

_PYTHON_TYPES = {"SymInt": int, "int": int, "float": float, "float[]": list, "bool": bool}
OPTIONS = {name: _PYTHON_TYPES[kind] for name, kind in _core.options.items()}
"""The op's other arguments with their types, in order: what `csrc/torch/fields.h` lists."""

_NUM_INPUTS, _NUM_IMAGES = len(INPUTS), len(IMAGES)
_RADII, _DEPTH = IMAGES.index("radii"), IMAGES.index("depth")
_BLEND_MODE = list(OPTIONS).index("blend_mode")
_DIVIDES = {mode["number"]: mode["divides"] for mode in _core.blend_modes.values()}


# Eager calls skip the Python wrapper that register_autograd puts around an op, because they have the formula already.
_below_autograd = getattr(torch._C, "_AutoDispatchBelowAutograd", None)
if not hasattr(_below_autograd, "__enter__"):  # torch 1.13 has it, but not as a context manager
    _below_autograd = contextlib.nullcontext


_functorch = getattr(torch._C, "_functorch", None)  # before torch 2.0 it is a package of its own


def is_compiling():
    """Whether torch.compile traces the call."""
    return _CAN_REGISTER and torch.compiler.is_compiling()


def is_transformed():
    """Whether a transform of torch.func calls."""
    return _functorch is not None and _functorch.peek_interpreter_stack() is not None


def refuse_transforms(function, values):
    """Raises NotImplementedError if torch.func or forward mode differentiates, or maps, a tensor among the values.

    The ops would drop a tangent, and autograd.Function with a context does not know torch.func.
    """
    compiling = is_compiling()
    forward, transformed = forward_ad._current_level >= 0, not compiling and is_transformed()
    if not forward and not transformed:  # asking each tensor would cost time
        return
    for value in values:
        if not isinstance(value, torch.Tensor):
            continue
        # Tensors that torch.compile traces do not always show their tangents.
        if forward and (compiling or forward_ad.unpack_dual(value).tangent is not None):
            raise NotImplementedError(f"{function}: forward-mode derivatives (torch.func.jvp, jacfwd, dual tensors) "
                                      "are not implemented; take those of backward mode (torch.autograd.grad)")
        if transformed and _functorch.is_functorch_wrapped_tensor(value):
            raise NotImplementedError(f"{function}: torch.func (grad, vjp, jacrev, vmap) is not implemented; take "
                                      "torch.autograd.grad, and a loop in place of vmap")


class _FirstDerivatives(torch.autograd.Function):
    @staticmethod
    def forward(ctx, function, gradients, *sources):
        ctx.function = function
        return tuple(gradients)

    @staticmethod
    def backward(ctx, *gradients):
        raise RuntimeError(f"{ctx.function}: second derivatives are not implemented; its gradients cannot be "
                           "differentiated again")


def differentiated_once(function, gradients, sources):
    """Returns gradients, tensors or None, that raise if they are differentiated again by one of the sources."""
    marked = iter(_FirstDerivatives.apply(function, [each for each in gradients if each is not None], *sources))
    return tuple(None if gradient is None else next(marked) for gradient in gradients)


def once_differentiable(function):
    """Decorates `backward` of an autograd.Function that has saved its inputs: second derivatives raise.

    Those of torch's decorator of this name raise only by the incoming gradients. By the inputs they would be dropped,
    and a loss with a further term would not show it.
    """
    def decorate(backward):
        @functools.wraps(backward)
        def refusing(ctx, *gradients):
            if not torch.is_grad_enabled():  # true only with create_graph
                return backward(ctx, *gradients)
            with torch.no_grad():
                results = backward(ctx, *gradients)
            return differentiated_once(function, results, [*ctx.saved_tensors, *gradients])

        return refusing

    return decorate


def _remember(ctx, inputs, options, radii):
    """Notes the arguments that are not tensors, and that radii have no gradient. Returns the given tensors."""
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(radii)
    ctx.options = options
    ctx.present = [tensor is not None for tensor in inputs]
    return [tensor for tensor in inputs if tensor is not None]


def _keep(ctx, inputs, output):
    """Keeps what the backward pass needs. The caller may edit the images in place, so they are copied."""
    *images, saved = output
    given = _remember(ctx, inputs[:_NUM_INPUTS], inputs[_NUM_INPUTS:], images[_RADII])
    ctx.mark_non_differentiable(images[_RADII], *saved)
    images = [image if i == _RADII else image.clone() for i, image in enumerate(images)]
    ctx.save_for_backward(*given, *images, *saved)


def _input_gradients(ctx, wanted, gradients, inputs, images, saved, op):
    """Returns a gradient for each input, None if it is not wanted."""
    image_gradients = [gradient for i, gradient in enumerate(gradients[:_NUM_IMAGES]) if i != _RADII]
    refuse_transforms("rasterize", [*image_gradients, *inputs])
    results = iter(op(*image_gradients, inputs, ctx.present, images, saved, *ctx.options, wanted))
    return [next(results) if want else None for want in wanted]


def _backward(ctx, *gradients):
    kept, count = list(ctx.saved_tensors), sum(ctx.present)
    inputs, images, saved = kept[:count], kept[count:count + _NUM_IMAGES], kept[count + _NUM_IMAGES:]
    by_input = _input_gradients(ctx, list(ctx.needs_input_grad[:_NUM_INPUTS]), gradients, inputs, images, saved,
                                _OPS.rasterize_backward)
    # torch wants a gradient of the structure of each argument: of a list a list.
    return (*by_input, *([None] * len(option) if isinstance(option, (list, tuple)) else None for option in ctx.options))


def _refuse_second_derivative(ctx, *gradients):
    raise RuntimeError("rasterize: second derivatives are not implemented; its gradients cannot be differentiated "
                       "again")


class _Rasterize(torch.autograd.Function):
    """The same formula for eager calls, with as little as possible between Python and the kernels."""

    @staticmethod
    def forward(ctx, options, *inputs):
        with _below_autograd():
            *images, saved = _OPS.rasterize.default(*inputs, *options)
        # The backward pass reads the images if a pixel is divided by its gate sum. An expected depth always is. The
        # caller may edit the images, so they are copied; if they are not read, they are not.
        read = _DIVIDES[options[_BLEND_MODE]] or images[_DEPTH].numel() > 0
        ctx.images = [image.clone() if read and image.numel() > 0 else image.detach()
                      for i, image in enumerate(images) if i != _RADII]
        given = _remember(ctx, inputs, options, images[_RADII])
        ctx.save_for_backward(*given, images[_RADII], *saved)
        return (*images, saved)

    @staticmethod
    @once_differentiable("rasterize")
    def backward(ctx, *gradients):
        kept, count = list(ctx.saved_tensors), sum(ctx.present)
        images = [*ctx.images[:_RADII], kept[count], *ctx.images[_RADII:]]
        with _below_autograd():
            return (None, *_input_gradients(ctx, list(ctx.needs_input_grad[1:]), gradients, kept[:count], images,
                                            kept[count + 1:], _OPS.rasterize_backward.default))


def rasterize_op(function, inputs, options):
    """Calls the op `rasterize` differentiably. Returns the images of IMAGES, and the list of what it saved.

    function: the one that the caller called, which errors name. inputs: a tensor or None for each of INPUTS. options: a
    value for each of OPTIONS; the last, `for_backward`, is left out.
    """
    refuse_transforms(function, inputs)
    if _CAN_REGISTER and torch.compiler.is_compiling():
        return _OPS.rasterize(*inputs, *options, torch.is_grad_enabled())
    if torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in inputs):
        return _Rasterize.apply((*options, True), *inputs)
    with _below_autograd():
        return _OPS.rasterize.default(*inputs, *options, False)


def _fake_rasterize(*arguments):
    """Returns tensors of the results' shapes and types. Only the kernels know how many rows a backend saves."""
    given = dict(zip((*INPUTS, *OPTIONS), arguments))
    means3D, colors = given["means3D"], given["colors_precomp"]
    count, height, width = means3D.shape[0], given["image_height"], given["image_width"]
    shapes = {"color": (3 if colors is None else colors.shape[1], height, width), "radii": (count,)}
    images = []
    for name in IMAGES:
        wanted = given.get(name, True)  # the options say so of FEATURE_OUTPUTS
        shape = shapes.get(name, (1, height, width)) if wanted else (0,)
        images.append(means3D.new_empty(shape, dtype=torch.int32 if name == "radii" else means3D.dtype))
    saved = []
    for name, kind, columns in _core.saved["cuda" if means3D.device.type == "cuda" else "cpu"]:
        rows = count if name == "projected" else torch.library.get_ctx().new_dynamic_size()
        saved.append(means3D.new_empty((rows,) if columns == 1 else (rows, columns),
                                       dtype=means3D.dtype if kind == "real" else getattr(torch, kind)))
    return (*images, saved)


def _fake_project(*arguments):
    given = dict(zip((*INPUTS, *OPTIONS), arguments))
    means3D, colors = given["means3D"], given["colors_precomp"]
    features = (3 if colors is None else colors.shape[1]) + sum(given[name] for name in FEATURE_OUTPUTS)
    stored = (features + 3) // 4 * 4 if means3D.device.type == "cuda" else features  # rows of vectors
    return (means3D.new_empty((means3D.shape[0], 8)), means3D.new_empty((means3D.shape[0], stored))[:, :features],
            _fake_radii(means3D))


def _fake_radii(means3D, *others):
    return means3D.new_empty((means3D.shape[0],), dtype=torch.int32)


def _fake_gradients(inputs, present, wanted):
    """Returns tensors of the shapes of the gradients by those inputs that are wanted."""
    given = iter(inputs)
    all_inputs = [next(given) if here else None for here in present]
    return [tensor.new_empty(tensor.shape) for tensor, want in zip(all_inputs, wanted) if want]


def _fake_rasterize_backward(*arguments):
    inputs, present = arguments[_NUM_IMAGES - 1:_NUM_IMAGES + 1]  # behind the gradients by the images
    return _fake_gradients(inputs, present, arguments[-1])


def _fake_project_backward(records, dL_ddepths, inputs, present, *others):
    return _fake_gradients(inputs, present, others[-1])


def _fake_mark_visible(positions, viewmatrix, near, camera_model=0, viewmatrix_end=None):
    return positions.new_empty((positions.shape[0],), dtype=torch.bool)


def _on_one_device(name, fake):
    """Returns the fake op, which first refuses tensors on several devices: torch calls it for one on `meta` too."""
    names = [argument.name for argument in getattr(_OPS, name).default._schema.arguments]

    def checked(*arguments):
        tensors = [(of, tensor) for of, value in zip(names, arguments)
                   for tensor in (value if isinstance(value, (list, tuple)) else [value])
                   if isinstance(tensor, torch.Tensor)]
        first_name, first = tensors[0]
        for of, tensor in tensors:
            if tensor.device != first.device:
                raise TypeError(f"{name}: {of} is on {tensor.device}; it must be on {first.device}, as {first_name} "
                                "is")
        return fake(*arguments)

    return checked


def register_fake(op, fake):
    """Registers the function that gives an op's results without their values, if this torch can have one."""
    if _CAN_REGISTER:
        torch.library.register_fake(_NAME + op, _on_one_device(op, fake))


_NAME = "diff_smoe_rasterization::"
for _op, _fake in (("rasterize", _fake_rasterize), ("rasterize_backward", _fake_rasterize_backward),
                   ("project", _fake_project), ("project_backward", _fake_project_backward),
                   ("radii", _fake_radii), ("mark_visible", _fake_mark_visible),
                   ("gate_adam", lambda *arguments: None)):
    register_fake(_op, _fake)
if _CAN_REGISTER:
    torch.library.register_autograd(_NAME + "rasterize", _backward, setup_context=_keep)
    torch.library.register_autograd(_NAME + "rasterize_backward", _refuse_second_derivative)
