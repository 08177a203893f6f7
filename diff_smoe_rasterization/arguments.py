"""What the package's functions are given, in the order of the ops; refuses what torch cannot dispatch."""
from __future__ import annotations

import torch

from .autograd import INPUTS, OPTIONS
from .checks import check_tensor, refuse_device
from .extension import BACKENDS
from .learned_gate import gate_of
from .raw_values import look_for_raw_values
from .settings import (
    BLEND_MODES,
    FEATURE_OUTPUTS,
    OUTPUTS,
    Rendering,
    resolve_blend,
    resolve_faint_below,
    resolve_lens,
    resolve_shutter,
)


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
    look_for_raw_values(function, inputs, settings.debug)
    # Only background_gate="learned" reads the tensors: that gate waits for the step of the optimizer that has means3D.
    background_gate = gate_of(background_gate, blend_mode, inputs.values(), means3D)
    fixed_gate = background_gate
    if isinstance(background_gate, torch.Tensor):
        inputs["background_gate"], fixed_gate = required("background_gate", background_gate), 0.0
    inputs["bg"] = required("bg", settings.bg)
    for name, dim in (("viewmatrix", 2), ("projmatrix", 2), ("campos", 1)):
        inputs[name] = without_batch(required(name, getattr(settings, name)), dim)
    if settings.viewmatrix_end is not None:
        inputs["viewmatrix_end"] = without_batch(required("viewmatrix_end", settings.viewmatrix_end), 2)
    return [inputs.get(name) for name in INPUTS], op_options(function, settings, outputs, blend_mode, fixed_gate)


def op_options(function, settings, outputs, blend_mode, fixed_gate):
    """Returns the options of a rendering in the order of the op, all but the last one. function: as above."""
    if not _OUTPUTS.issuperset(outputs):
        raise ValueError(f"{function}: outputs is {tuple(outputs)}; it may hold {', '.join(OUTPUTS)}")
    given = [getattr(settings, name) for name, _ in _SETTING_OPTIONS]
    try:
        options = [kind(value) for value, (_, kind) in zip(given, _SETTING_OPTIONS)]
    except (TypeError, ValueError, OverflowError, RuntimeError):
        options = None
    # Unchanged by conversion: so it was not a string (float() and bool() take those) and lost no digits.
    if options != given or not all([-_WHOLE_LIMIT < options[place] < _WHOLE_LIMIT for place in _WHOLE_OPTIONS]):
        for (name, kind), value in zip(_SETTING_OPTIONS, given):
            if not fits(kind, value):
                raise ValueError(f"{function}: {name} is {value!r}; it must be {KINDS[kind]}")
    faint_below = resolve_faint_below(blend_mode, settings.faint_below)
    shutter = resolve_shutter(settings)
    model, lens = resolve_lens(settings)
    computed = [faint_below, fixed_gate, BLEND_MODES.index(blend_mode), model, lens, shutter,
                *[name in outputs for name in FEATURE_OUTPUTS]]
    for place, value in zip(_COMPUTED_OPTIONS.values(), computed):
        options.insert(place, value)
    return options


def fits(kind, value):
    """Whether a setting can be an option of this type, a key of KINDS."""
    try:
        option = kind(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: a tensor of several elements
        return False
    return not isinstance(value, str) and (kind is not int or (option == value and abs(option) < _WHOLE_LIMIT))


_OUTPUTS = frozenset(OUTPUTS)
KINDS = {int: "a whole number below 2^63", float: "a number", bool: "True or False"}
_WHOLE_LIMIT = 2**63

# The options that are computed, with their places; the others are settings of the same name. `rasterize_op` decides
# for_backward, which is the last one.
assert list(OPTIONS)[-1] == "for_backward"
_COMPUTED_OPTIONS = {name: list(OPTIONS).index(name)
                     for name in ("faint_below", "fixed_background_gate", "blend_mode", "camera_model", "lens",
                                  "rolling_shutter", *FEATURE_OUTPUTS)}
assert list(_COMPUTED_OPTIONS.values()) == sorted(_COMPUTED_OPTIONS.values())  # they are inserted in this order
_SETTING_OPTIONS = [(name, kind) for name, kind in list(OPTIONS.items())[:-1] if name not in _COMPUTED_OPTIONS]
_WHOLE_OPTIONS = [place for place, (_, kind) in enumerate(_SETTING_OPTIONS) if kind is int]


def tensor_checks(function, first_name, first):
    """Returns functions that pass a required and an optional tensor on, and refuse what torch cannot dispatch.

    Those are values that are not tensors and tensors on different devices; the ops refuse wrong shapes and types.
    function: the one that errors name. first: the tensor on whose device all others have to be.
    """
    def required(name, value):
        if not isinstance(value, torch.Tensor) or value.layout is not torch.strided:
            check_tensor(function, name, value)
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
        refuse_device(function, first_name, first)
    return required, optional


def without_batch(tensor, dim):
    """Returns a camera tensor without the batch axis of size 1 that some trainers leave in front."""
    return tensor[0] if tensor.dim() == dim + 1 and tensor.shape[0] == 1 else tensor


def as_rendering(images, outputs):
    """Returns the op's images under their names."""
    color, radii, *optional = images
    return Rendering(color, radii, *(image if name in outputs else None for name, image in zip(OUTPUTS, optional)))
