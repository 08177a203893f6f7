"""What the package's functions are given, in the order of the ops; refuses what torch cannot dispatch."""
from __future__ import annotations

import torch

from .autograd import INPUTS, OPTIONS
from .extension import BACKENDS, build_info
from .settings import BLEND_MODES, FEATURE_OUTPUTS, OUTPUTS, Rendering, resolve_blend, resolve_faint_below


def op_arguments(function, settings, outputs, means3D, opacities, **tensors):
    """Returns the tensors and the options of a rendering in the order of the op; all options but the last one.

    function: the one that the caller called, which errors name.
    Every eager call comes through here, and costs what this costs: what can be looked up once is looked up below.
    """
    blend_mode, background_gate = resolve_blend(settings)
    required, optional = tensor_checks(function, "means3D", means3D)
    inputs = {"means3D": means3D, "opacities": required("opacities", opacities)}
    for name, tensor in tensors.items():
        if tensor is not None:
            inputs[name] = optional(name, tensor)
    fixed_gate = background_gate
    if isinstance(background_gate, torch.Tensor):
        inputs["background_gate"], fixed_gate = required("background_gate", background_gate), 0.0
    inputs["bg"] = required("bg", settings.bg)
    for name, dim in (("viewmatrix", 2), ("projmatrix", 2), ("campos", 1)):
        inputs[name] = without_batch(required(name, getattr(settings, name)), dim)
    return [inputs.get(name) for name in INPUTS], op_options(function, settings, outputs, blend_mode, fixed_gate)


def op_options(function, settings, outputs, blend_mode, fixed_gate):
    """Returns the options of a rendering in the order of the op, all but the last one. function: as above."""
    if not _OUTPUTS.issuperset(outputs):
        raise ValueError(f"{function}: outputs is {tuple(outputs)}; it may hold {', '.join(OUTPUTS)}")
    options = [kind(getattr(settings, name)) for name, kind in _SETTING_OPTIONS]
    for place, name in _WHOLE_OPTIONS:
        if options[place] != getattr(settings, name):  # int() has cut digits off
            raise ValueError(f"{name} is {getattr(settings, name)!r}; it must be a whole number")
    computed = {"fixed_background_gate": fixed_gate, "blend_mode": BLEND_MODES.index(blend_mode),
                "faint_below": resolve_faint_below(blend_mode, settings.faint_below),
                **{name: name in outputs for name in FEATURE_OUTPUTS}}
    for name, place in _COMPUTED_OPTIONS.items():
        options.insert(place, computed[name])
    return options


_OUTPUTS = frozenset(OUTPUTS)

# The options that are computed, with their places; the others are settings of the same name. `rasterize_op` decides
# for_backward, which is the last one.
assert list(OPTIONS)[-1] == "for_backward"
_COMPUTED_OPTIONS = {name: place for place, name in enumerate(OPTIONS)
                     if name in ("fixed_background_gate", "blend_mode", "faint_below", *FEATURE_OUTPUTS)}
_SETTING_OPTIONS = [(name, kind) for name, kind in list(OPTIONS.items())[:-1] if name not in _COMPUTED_OPTIONS]
_WHOLE_OPTIONS = [(place, name) for place, (name, kind) in enumerate(_SETTING_OPTIONS) if kind is int]


def tensor_checks(function, first_name, first):
    """Returns functions that pass a required and an optional tensor on, and refuse what torch cannot dispatch.

    Those are values that are no tensors and tensors on different devices; the ops refuse wrong shapes and types.
    function: the one that errors name. first: the tensor on whose device all others have to be.
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


def without_batch(tensor, dim):
    """Returns a camera tensor without the batch axis of size 1 that some trainers leave in front."""
    return tensor[0] if tensor.dim() == dim + 1 and tensor.shape[0] == 1 else tensor


def as_rendering(images, outputs):
    """Returns the op's images under their names."""
    color, radii, *optional = images
    return Rendering(color, radii, *(image if name in outputs else None for name, image in zip(OUTPUTS, optional)))
