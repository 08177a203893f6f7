"""Makes the classes of a rasterizer of Inria's kind from its entry in contracts.py."""
from __future__ import annotations

from collections import namedtuple
from inspect import Parameter, Signature
from typing import Any, Callable, Dict, Optional, Sequence, Tuple

import torch
from torch.nn.functional import pad

import diff_smoe_rasterization
from diff_smoe_rasterization import GaussianRasterizationSettings as Settings
from diff_smoe_rasterization import rasterize, rasterize_with_splats, reference
from diff_smoe_rasterization.arguments import KINDS, fits
from diff_smoe_rasterization.checks import check_tensor
from diff_smoe_rasterization.learned_gate import gate_of
from diff_smoe_rasterization.rasterizer import visible_radii
from diff_smoe_rasterization.settings import GateMap, resolve_blend

from .contracts import FEATURES, RESULTS, contract_of

ON_REQUEST = {"inverse_depth": ("inverse_depth",), "depth": ("depth", "alpha"), "alpha": ("alpha",),
              "opacity": ("alpha",)}
# Results that need another walk, by `contributions` or `gate_map`.
COUNTED = ("pixels", "weights", "n_touched", "counts", "opacity_sums")
MAPPED = ("largest", "median_depth")
# Of arguments that are looked at before `rasterize` does; others have N rows.
AXES = {"means3D": ("N", 3), "means2D": ("N", "D"), "means2D_densify": ("N", 3), "dc": ("N", 1, 3),
        "shs": ("N", "K", 3), "colors_precomp": ("N", "C"), "opacities": ("N", 1), "scales": ("N", 3),
        "rotations": ("N", 4), "cov3D_precomp": ("N", 6), "theta": (3,), "rho": (3,)}


# Settings beside the package's own, by what they must be if they are not None.
FLAGS = ("f_count", "get_flag", "include_mask", "include_feature")
NUMBERS = ("kernel_size", "depth_threshold")
TENSORS = ("subpixel_offset", "projmatrix_raw", "confidence")


def check_own_settings(settings: Settings, num_gaussians: int) -> None:
    """Raises ValueError or TypeError if one of the settings above is not what it must be."""
    for names, kind in ((FLAGS, bool), (NUMBERS, float)):
        for name in names:
            value = getattr(settings, name, None)
            if value is not None and not fits(kind, value):
                raise ValueError(f"rasterize: {name} is {value!r}; it must be {KINDS[kind]}")
    sizes = {"projmatrix_raw": 16, "confidence": num_gaussians}
    for name in TENSORS:
        value = getattr(settings, name, None)
        if value is not None:
            check_tensor("rasterize", name, value)
            check_size(name, value, sizes.get(name, value.numel()))


def check_size(name: str, tensor: torch.Tensor, size: int) -> None:
    """Raises ValueError unless the tensor has so many elements."""
    if tensor.numel() != size:
        raise ValueError(f"rasterize: {name} has shape {list(tensor.shape)}; it must have {size} elements")


def given_inputs(settings: Settings, inputs: Dict[str, Any]) -> Dict[str, Any]:
    """Returns the inputs with None for what is absent.

    Raises TypeError or ValueError, as `rasterize` does, for what this module would compute with before `rasterize`
    looks at it.
    """
    means, checked = inputs["means3D"], {}
    check_tensor("rasterize", "means3D", means)
    for name in ("bg", "viewmatrix", "projmatrix", "campos"):
        check_tensor("rasterize", name, getattr(settings, name))
    _check_axes("bg", settings.bg, ("C",))
    for name, value in inputs.items():
        if value is not None:
            check_tensor("rasterize", name, value)
            if value.numel() == 0 and (means.numel() > 0 or value.dim() == 1):
                value = None
            else:
                axes = AXES.get(name, ("N", *value.shape[1:]))
                axes = ("N",) if name == "opacities" and value.dim() == 1 else axes
                flat = value.reshape(-1) if axes == (3,) else value
                _check_axes(name, flat, (len(means), *axes[1:]) if axes[0] == "N" and name != "means3D" else axes)
        checked[name] = value
    return checked


def _check_axes(name: str, tensor: torch.Tensor, axes: Sequence[Any]) -> None:
    """Raises ValueError unless the sizes are those of the axes; a letter is any size."""
    if tensor.dim() != len(axes) or any(size != axis and not isinstance(axis, str)
                                        for size, axis in zip(tensor.shape, axes)):
        raise ValueError(f"rasterize: {name} has shape {list(tensor.shape)}; it must be "
                         f"[{', '.join(map(str, axes))}]")


def _refuse_lens(settings: Settings, what: str) -> None:
    """Raises NotImplementedError unless each pixel is seen by one pose and by projmatrix."""
    for name, only in (("camera_model", "pinhole"), ("rolling_shutter", "global")):
        if getattr(settings, name) != only:
            raise NotImplementedError(f"{name} is {getattr(settings, name)!r}; {what} are offered for {only!r} alone")


def pixel_rays(settings: Settings, like: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor]:
    """Returns x [W] and y [H] of the rays (x, y, 1) through the pixels, in the camera's frame.

    Raises NotImplementedError for a lens or a rolling shutter.
    """
    _refuse_lens(settings, "rays of pixels")
    lens = torch.linalg.solve(settings.viewmatrix.to(like), settings.projmatrix.to(like))
    x, y = ((2 * torch.arange(size).to(like) + 1) / size - 1 for size in (settings.image_width, settings.image_height))
    return (x - lens[2, 0]) / lens[0, 0], (y - lens[2, 1]) / lens[1, 1]


def settings_with(names: Sequence[str], module: str) -> type:
    """Returns the package's settings as a class that has the fields `names` behind `debug`.

    A field that the package has too moves there with its default; another one has the default None.
    module: the module that the class belongs to; pickle finds it by this name.
    """
    fields = [field for field in Settings._fields if field not in names]
    fields[fields.index("debug") + 1:fields.index("debug") + 1] = names
    defaults = {**dict.fromkeys(names), **Settings._field_defaults}
    return namedtuple("GaussianRasterizationSettings", fields, module=module,
                      defaults=[defaults[field] for field in fields if field in defaults])


def share_of_gaussians(alpha: torch.Tensor, settings: Settings) -> torch.Tensor:
    """Returns the share beta of each pixel that the background does not have, so C = beta G + (1 - beta) bg.

    alpha: [1, H, W], the output of that name. In `alpha` and `smoe` it is beta. In the other modes it is a gate sum W:
    with the background gate lambda beta is W / (W + lambda (1 - W)), by W + T = 1. With gate 0 it is 1 wherever a gate
    is open, as in `smoe_tn` and `smoe_std`.
    """
    mode, gate = resolve_blend(settings)
    if mode in ("alpha", "smoe"):
        return alpha
    gate = gate_of(gate, mode, (alpha,))
    gate_sum = alpha
    if not isinstance(gate, torch.Tensor) and gate == 0:
        return (gate_sum > 0).to(gate_sum.dtype)
    total = gate_sum + gate * (1 - gate_sum)
    return torch.where(total > 0, gate_sum / torch.where(total > 0, total, 1), torch.zeros_like(total))


def results_of(names: Sequence[str], settings: Settings, inputs: Dict[str, Any]) -> Tuple[torch.Tensor, ...]:
    """Renders as `rasterize`, and returns results by their names, as RESULTS explains them.

    settings, inputs: they may have what is free in contracts.py: see `as_ours`. The FEATURES among the inputs are
    blended in the same rendering; without them their image is black.
    """
    settings, inputs = as_ours(settings, inputs)
    features = {result: inputs.pop(argument, None) for argument, (result, _) in FEATURES.items()}
    is_wanted = getattr(settings, "include_feature", None)
    if is_wanted is not None and not is_wanted:
        features["language_feature"] = None
    given = {name: features[name].flatten(1) for name in names if features.get(name) is not None
             and features[name].dim() > 1}
    if given:
        shs, colors = reference.appearance(*(inputs.pop(name, None) for name in ("dc", "shs", "colors_precomp")))
        colors = reference.color(reference.Gaussians(inputs["means3D"], None, None, shs, colors, None, None, None),
                                 settings)
        inputs["colors_precomp"] = torch.cat([colors, *given.values()], 1)
        settings = settings._replace(bg=pad(settings.bg, (0, sum(rows.shape[1] for rows in given.values()))))
    found = _rendered([name for name in names if name not in features], settings, inputs)
    image = found["color"]
    if given:
        found["color"], *images = image.split([colors.shape[1], *(rows.shape[1] for rows in given.values())])
        found.update(zip(given, images))
    for result, channels in FEATURES.values():
        if result in names and result not in found:
            found[result] = image.new_zeros(channels, *image.shape[1:])
    return tuple(found[name] for name in names)


def _rendered(names: Sequence[str], settings: Settings, inputs: Dict[str, Any]) -> Dict[str, torch.Tensor]:
    """Returns results by their names, and perhaps others, of what the package's own rasterizer knows."""
    found: Dict[str, Any] = {}
    outputs = sorted({output for name in names for output in ON_REQUEST.get(name, ())})
    counted, mapped = (not set(asked).isdisjoint(names) for asked in (COUNTED, MAPPED))
    if not counted and not mapped:
        rendering = rasterize(settings=settings, outputs=outputs, **inputs)
    else:
        rendering, splats = rasterize_with_splats(settings=settings, outputs=outputs, **inputs)
    if mapped:
        maps = splats.gate_map()
        if "largest" in names:  # the host waits for it
            largest = maps.gaussians[maps.gaussians >= 0]
            found["largest"] = torch.bincount(largest, minlength=rendering.radii.numel()).to(rendering.color)
        if "median_depth" in names:
            found["median_depth"] = _median_depth(settings, inputs, maps)
    if counted:
        sums = splats.contributions(torch.ones_like(rendering.color[0]))
        found.update(pixels=sums.pixels.to(rendering.color.dtype)[:, None], weights=sums.blend_weights,
                     n_touched=sums.pixels, counts=sums.pixels,
                     opacity_sums=sums.pixels * inputs["opacities"].detach().reshape(-1))
    found.update(color=rendering.color, radii=rendering.radii, inverse_depth=rendering.inverse_depth,
                 is_used=(rendering.radii > 0).to(torch.int32))
    if "alpha" in outputs:
        found["alpha"] = found["opacity"] = share_of_gaussians(rendering.alpha, settings)
    if "depth" in outputs:
        found["depth"] = rendering.depth * found["alpha"]
    return found


def as_ours(settings: Settings, inputs: Dict[str, Any]) -> Tuple[Settings, Dict[str, Any]]:
    """Returns settings and inputs for this package's rasterizer, from those of others, whose settings have None for
    what is not given.

    - `kernel_size` is `low_pass`, with opacities compensated as under `antialiasing` (Mip-Splatting). Its
      `subpixel_offset` other than zeros is refused.
    - `depth_threshold` multiplies the gradient of means2D by (z / depth_threshold)^2, at most 1 (Pixel-GS).
    - `theta` and `rho` [3] among the inputs are a small rotation and translation that follow world to view. They get
      the camera's gradient, and their values are not read (MonoGS).
    - `nearest_points` other than None are refused.

    Raises NotImplementedError.
    """
    own, inputs = settings._asdict(), dict(inputs)
    offset = own.get("subpixel_offset")
    if offset is not None and offset.numel() > 0 and bool(offset.any()):
        raise NotImplementedError("rasterize: subpixel_offset is not zero (Mip-Splatting's --sample_more_highres); "
                                  "this package samples pixels only at their centres")
    if own.get("nearest_points") is not None:
        raise NotImplementedError("rasterize: nearest_points are set (a scene of DUSt3R); this package does not turn "
                                  "gradients towards points; train without them, as on a COLMAP scene")
    if own.get("kernel_size") is not None:
        settings = settings._replace(low_pass=own["kernel_size"], antialiasing=True)
    points = inputs.get("means2D")
    if own.get("depth_threshold") and points is not None:
        view = settings.viewmatrix.to(inputs["means3D"])
        depths = (inputs["means3D"] @ view[:3, 2] + view[3, 2]).detach()
        factors = (depths / own["depth_threshold"]).square().clamp(max=1)
        inputs.update({name: scaled_gradient(factors, inputs[name]) for name in ("means2D", "means2D_abs")
                       if name in inputs})
    theta, rho = inputs.pop("theta", None), inputs.pop("rho", None)
    if theta is not None or rho is not None:
        settings = _moved(settings, theta, rho)
    return settings, inputs


def _moved(settings: Settings, theta: Optional[torch.Tensor], rho: Optional[torch.Tensor]) -> Settings:
    """Returns the settings with a camera that depends on theta and rho, at 0, to first order. Its values stay.

    Of a rolling shutter they follow both poses, which are mixed linearly: so the pose of every row.
    """
    for name, size in (("projmatrix", 16), ("campos", 3)):
        check_size(name, getattr(settings, name), size)
    view, end = settings.viewmatrix, settings.viewmatrix_end  # transposed
    zero = view.new_zeros(3)
    x, y, z = (zero if theta is None else theta.reshape(3) - theta.reshape(3).detach()).unbind()
    nothing = torch.zeros_like(x)
    turn = torch.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing]).reshape(3, 3)  # turn @ v = theta x v
    step = torch.cat([turn.T, (zero if rho is None else rho.reshape(3) - rho.reshape(3).detach())[None]])  # transposed

    def motion(pose: torch.Tensor) -> torch.Tensor:
        return torch.cat([pose[:, :3] @ step[:3] + pose[:, 3:] * step[3:], view.new_zeros(4, 1)], 1)

    moved = view + motion(view)
    projection = getattr(settings, "projmatrix_raw", None)
    if projection is None:  # what the product of both says
        projection = torch.linalg.solve(view, settings.projmatrix)
    centre = -moved[3, :3] @ torch.linalg.inv(moved[:3, :3])
    if end is not None:
        end = end + motion(end)
        centre = (centre - end[3, :3] @ torch.linalg.inv(end[:3, :3])) / 2
    projection = moved @ projection
    return settings._replace(viewmatrix=moved, viewmatrix_end=end,
                             projmatrix=settings.projmatrix + (projection - projection.detach()),
                             campos=settings.campos + (centre - centre.detach()))


def _median_depth(settings: Settings, inputs: Dict[str, Any], maps: GateMap) -> torch.Tensor:
    """Returns z [1, H, W] of the Gaussians that make pixels half full, 0 if none does; differentiable.

    Raises NotImplementedError for a lens or a rolling shutter.
    """
    _refuse_lens(settings, "median depths")
    means, which = inputs["means3D"], maps.medians
    if not len(means):
        return means.new_zeros(1, *which.shape)
    view = settings.viewmatrix.to(means)
    depths = means @ view[:3, 2] + view[3, 2]
    if resolve_blend(settings)[0] == "smoe_std":  # it takes Gaussians in the order of their indices
        with torch.no_grad():
            order = depths.argsort()
            nearest_first = {name: rows[order] for name, rows in inputs.items()
                             if name != "means2D" and rows is not None and len(rows) == len(order)}
            which = rasterize_with_splats(settings=settings, **nearest_first)[1].gate_map().medians
        depths = depths[order]
    return depths[which.long().clamp(min=0)].masked_fill(which < 0, 0)[None]


def with_absolute(columns: int, inputs: Dict[str, Any]) -> Dict[str, Any]:
    """Returns the inputs with means2D_abs, so that the columns of means2D behind x and y get absolute sums.

    columns: 2 for x and y, or 1 for the sum of both. A means2D without those columns is passed on as it is; one with
    four is always of 2.
    """
    points = inputs.get("means2D")
    columns = 2 if points is not None and points.shape[1] == 4 else columns
    if points is None or points.shape[1] != 2 + columns:
        return inputs
    if not points.requires_grad:
        return {**inputs, "means2D": None}
    return {**inputs, "means2D": pad(points[:, :2], (0, 1)), "means2D_abs": points[:, 2:2 + columns].expand(-1, 2)}


def scaled_gradient(factors: torch.Tensor, tensor: Any) -> Any:
    """Returns a tensor of N Gaussians, or None, whose gradient will be multiplied by the factors [N, 1] or [N]."""
    if tensor is None or tensor.numel() == 0 or not tensor.requires_grad:
        return tensor
    tensor = tensor.view_as(tensor)
    tensor.register_hook(lambda grad: grad * factors.reshape(-1, *[1] * (grad.dim() - 1)))
    return tensor


@torch.no_grad()
def visible_filter(self, means3D, scales=None, rotations=None, cov3D_precomp=None):
    """Returns the radii [N] int32 that a rendering would have, 0 for what the view does not see: a rasterizer's method.

    means3D: [N, 3]; scales [N, 3] with rotations [N or more, 4], or cov3D_precomp [N, 6]. Views such as `scales[:, :3]`
    are taken as they are. Which radii are 0 depends on the blend mode: the anchors need the mode of their rendering.
    Raises ValueError or TypeError if arguments do not fit, as `rasterize` does.
    """
    if all(isinstance(given, torch.Tensor) and given.dim() == 2 for given in (means3D, rotations)):
        rotations = rotations[:len(means3D)]  # HAC++'s decoder leaves more than anchors, all of them the identity
    return visible_radii(means3D, as_ours(self.raster_settings, {})[0], scales, rotations, cov3D_precomp)


Renderer = Callable[[Settings, Dict[str, Any]], Tuple[torch.Tensor, ...]]


def classes_of(contract: str, module: str, renderer: Optional[Renderer] = None) -> Tuple[type, type, Any]:
    """Returns GaussianRasterizationSettings, GaussianRasterizer and rasterize_gaussians of a contract.

    module: the module that the classes belong to. renderer: from the settings and the arguments by name to the results,
    if `results_of` does not do.
    """
    entry = contract_of(contract)
    new_settings = [name for name in entry.settings if name not in Settings._fields]
    settings_class = settings_with(new_settings, module) if new_settings else Settings
    renamed = {"shs": "sh", "cov3D_precomp": "cov3Ds_precomp"}
    further = [name for name in entry.arguments if name not in ("means3D", "means2D", "opacities")]
    place = further.index("scales")
    positional = ["means3D", "means2D", *further[:place], "opacities", *further[place:]]
    of_function = _signature(*(renamed.get(name, name) for name in positional), "raster_settings")
    required = ("self", "means3D", "means2D", "opacities")
    of_module = _signature(*required, absent=[name for name in entry.arguments if name not in required])
    returns = ", ".join(f"{name} {RESULTS[name][0]}" for name in entry.results)

    def render(settings: Settings, inputs: Dict[str, Any]) -> Tuple[torch.Tensor, ...]:
        inputs = given_inputs(settings, inputs)
        if new_settings:
            check_own_settings(settings, len(inputs["means3D"]))
        densify = inputs.pop("means2D_densify", None)
        if densify is not None:  # one gradient of the image, which both receive
            inputs["means2D"] = densify if inputs["means2D"] is None else inputs["means2D"] + densify
        confidence = getattr(settings, "confidence", None)
        inputs = with_absolute(2 if getattr(settings, "kernel_size", None) is None else 1, inputs)
        if confidence is not None:
            inputs = {name: tensor if name == "means2D" else scaled_gradient(confidence, tensor)
                      for name, tensor in inputs.items()}
        return renderer(settings, inputs) if renderer else results_of(entry.results, settings, inputs)

    def rasterize_gaussians(*values: Any, **named: Any) -> Tuple[torch.Tensor, ...]:
        given = of_function.bind(*values, **named).arguments
        settings = given.pop("raster_settings")
        back = {new: old for old, new in renamed.items()}
        return render(settings, {back.get(name, name): value for name, value in given.items()})

    class GaussianRasterizer(diff_smoe_rasterization.GaussianRasterizer):
        def forward(*values: Any, **named: Any) -> Tuple[torch.Tensor, ...]:
            given = of_module.bind(*values, **named).arguments
            return render(given.pop("self").raster_settings, given)

    if "visible_filter" in entry.methods:
        GaussianRasterizer.visible_filter = visible_filter
    GaussianRasterizer.forward.__signature__ = of_module
    GaussianRasterizer.__doc__ = f"Renders as `rasterize`; used by {entry.used_by}.\n\nA call returns {returns}."
    rasterize_gaussians.__signature__ = of_function
    rasterize_gaussians.__doc__ = f"Renders as `rasterize`, whose shapes and errors are these.\n\nReturns: {returns}."
    for made in (GaussianRasterizer, rasterize_gaussians):
        made.__module__ = module
        made.__qualname__ = made.__name__
    return settings_class, GaussianRasterizer, rasterize_gaussians


def _signature(*required: str, absent: Sequence[str] = ()) -> Signature:
    """A signature of these names; the second ones default to None."""
    return Signature([*(Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in required),
                      *(Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, default=None) for name in absent)])
