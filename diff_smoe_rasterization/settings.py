"""What a caller says about one rendering: camera, image, blend mode and options."""
from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, Any, List, NamedTuple, Optional, Sequence, Tuple, Union, cast

if TYPE_CHECKING:
    import torch  # which takes seconds to load: the command line reads this file for its names

BLEND_MODES = ("alpha", "smoe", "smoe_eq7", "smoe_tn", "smoe_std")
"""The blend modes, by number in the C++ core.

========== ====================== =========================================== ==========
name       paper                  colour of a pixel                           background
========== ====================== =========================================== ==========
alpha      Eq. 3 (3DGS)           sum c_i alpha_i T_i + T bg                  blended
smoe       the authors' program   (sum c_i alpha_i T_i + B bg) / (W + B)      by tails and gate
smoe_eq7   Eq. 7 (the text)       sum c_i alpha_i T_i / W                     by its gate
smoe_tn    Eq. 8 (ablation)       sum c_i alpha_i T_i / sum alpha_i           if no gate
smoe_std   Eq. 6 (classic SMoE)   sum c_i alpha_i / sum alpha_i               if no gate
========== ====================== =========================================== ==========

W = sum alpha_i T_i. In `smoe` the sums are of strong pairs, those of alpha >= 1/2040. A weaker pair in the tiles of its
Gaussian's 3-sigma square is a tail: B is the sum of the tails' alpha T, and gets no gradient. `smoe_eq7` sums all pairs
of G >= 1e-5.

A pair that counts is near if alpha >= 1/255, and within 3 sigma if alpha >= 1/1020; else it is faint. If the
near pairs of a pixel have a gate sum of `faint_below` or more, only they are blended, and B is 0. That is 0.25 in
`smoe`, and in `smoe_eq7` on request.

With a `background_gate` lambda > 0 the background is one more expert of both, behind all others:

    (sum c_i alpha_i T_i + (B + lambda T) bg) / (W + B + lambda T)

At lambda 0, the default, the background is seen in `smoe` where Gaussians end, and in `smoe_eq7` where no gate is open.
At lambda 1 `smoe_eq7` is alpha blending.
"""

CAMERA_MODELS = ("pinhole", "orthographic", "opencv", "fisheye", "thin_prism_fisheye", "equirectangular")
"""The camera models, by number in the C++ core.

================== =============================================== ================================== ========
name               distortion                                      what it sees                       depth
================== =============================================== ================================== ========
pinhole            none; its projection is `projmatrix`            depths above `near`                view z
orthographic       none; focal lengths in pixels by unit of length depths above `near`                view z
opencv             k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4             until the distorted radius stops   view z
fisheye            k1 k2 k3 k4 (Kannala-Brandt)                    until it stops; 174.6 degrees      distance
thin_prism_fisheye k1 k2 p1 p2 k3 k4 sx1 sy1                       until it stops; 174.6 degrees      distance
equirectangular    none                                            all but 0.06 degrees at the poles  distance
================== =============================================== ================================== ========

`near`, the order of the Gaussians and the depth images take the depth so. `opencv` has the first 0, 1, 2, 4, 5, 8 or 12
of its numbers, `fisheye` 0, 1, 2 or 4. COLMAP's OPENCV and FULL_OPENCV are `opencv`, and its OPENCV_FISHEYE is
`fisheye`, with their numbers in the same order.
"""

ROLLING_SHUTTERS = ("global", "top_to_bottom", "left_to_right", "bottom_to_top", "right_to_left")
"""How an image is read out, by number in the C++ core: at once, or by rows or columns in this order."""

_FIXED_GATES = {"alpha": 1.0, "smoe": None, "smoe_eq7": None, "smoe_tn": 0.0, "smoe_std": 0.0}
"""The background's gate that a blend mode has by itself. None: the caller gives it."""

GATED_MODES = tuple(mode for mode, gate in _FIXED_GATES.items() if gate is None)
"""The blend modes that take a `background_gate`: `smoe` and `smoe_eq7`."""

_FAINT_BELOW = {"smoe": 0.25}
"""The `faint_below` of a blend mode if the caller gives none; of the others it is 2: no pair is left out."""

BLEND_MODE_VARIABLE = "DSMOE_BLEND_MODE"
BACKGROUND_GATE_VARIABLE = "DSMOE_BACKGROUND_GATE"
FAINT_BELOW_VARIABLE = "DSMOE_FAINT_BELOW"
LEARNED = "learned"
"""The background gate that this process learns, one for all its renderings (learned_gate.py)."""
EVERYWHERE = 2.0
"""The `faint_below` with which no pair is left out: no gate sum is above 1."""
PAPER = "paper"
PAPER_PROGRAM = {"blend_mode": "smoe", "background_gate": 0.0, "faint_below": EVERYWHERE}
"""How the program of the paper's authors blends; PAPER stands for it on command lines and in suites."""
MAX_BACKGROUND_GATE = 1e30  # that and a background's colour still make a float32 number

BackgroundGate = Union[float, str, "torch.Tensor"]
"""lambda: a number, a tensor of one element, which receives a gradient, or LEARNED.

In `smoe_eq7` the number 1 is alpha blending bit for bit. A tensor of 1 keeps the footprints of `smoe_eq7`, and pixels
differ where tiles end.
"""


class GaussianRasterizationSettings(NamedTuple):
    """Camera and options of one rendering; the first twelve fields are Inria's, in Inria's order.

    Matrices are transposed, as every 3DGS trainer passes them: a row vector times the matrix.
    """

    image_height: int  # pixels
    image_width: int  # pixels
    tanfovx: float  # tan of half the horizontal field of view
    tanfovy: float
    bg: torch.Tensor  # [C] background colour, C = 3 unless colors_precomp has other channels
    scale_modifier: float  # multiplies every scale; 1 for training
    viewmatrix: torch.Tensor  # [4, 4] world to view, transposed
    projmatrix: torch.Tensor  # [4, 4] world to clip (view and projection), transposed; carries the principal point
    sh_degree: int  # active degree, 0 to 3; shs may hold more
    campos: torch.Tensor  # [3] camera centre, world
    prefiltered: bool = False  # the caller asserts that every point lies in front of the near plane
    debug: bool = False  # look for NaN in images and gradients, and for raw values; slower. Attributes: `strict`
    antialiasing: bool = False  # scale opacity by sqrt(det(cov2D) / det(cov2D + low_pass I))
    near: float = 0.2  # Gaussians with view depth <= near are culled
    # SMoE modes: also skip alpha below this; 0 is the paper's rule. `smoe`: pairs below this are not strong ones
    alpha_min: float = 0.0
    strict: bool = False  # raise if an attribute is NaN or infinite, instead of culling that Gaussian
    blend_mode: Optional[str] = None  # one of BLEND_MODES; None: $DSMOE_BLEND_MODE, else "alpha"
    # CUDA: gradients and sums of `Splats` equal bit for bit from run to run; slower. The CPU's always are, at one SIMD
    # level.
    deterministic: bool = False
    clamp_color: bool = True  # colours from shs are at least 0; False: as the harmonics give them, with their gradient
    # `smoe` and `smoe_eq7`: the background's weight, 0 or more, or "learned"; None: $DSMOE_BACKGROUND_GATE, else 0
    background_gate: Optional[BackgroundGate] = None
    low_pass: float = 0.3  # px^2 added to the variances on the image: no Gaussian is thinner than about a pixel
    # `smoe` and `smoe_eq7`: faint pairs and tails count in pixels whose near pairs have a gate sum below this. 2: in
    # all, as in the authors' program and in the text; slower. 0: in none. None: $DSMOE_FAINT_BELOW, else 0.25 in
    # `smoe`, 2 in `smoe_eq7`. The other modes ignore it
    faint_below: Optional[float] = None
    # One of CAMERA_MODELS. But for "pinhole", `viewmatrix` has all of the pose, `projmatrix` is not read and gets no
    # gradient, and the focal lengths are image_width / (2 tanfovx) and image_height / (2 tanfovy)
    camera_model: str = "pinhole"
    distortion: Sequence[float] = ()  # as CAMERA_MODELS has them
    # pixels; the centre of the first pixel is (0.5, 0.5). None: of the image. A pinhole's is in `projmatrix`
    principal_point: Optional[Tuple[float, float]] = None
    # One of ROLLING_SHUTTERS. But for "global", `viewmatrix` is the pose at the first row, or column, and
    # `viewmatrix_end` that at the last. Then a pinhole needs `principal_point`, and `projmatrix` is not read
    rolling_shutter: str = "global"
    viewmatrix_end: Optional[torch.Tensor] = None  # [4, 4] transposed; differentiable


class Rendering(NamedTuple):
    """What `rasterize` returns; an output that was not asked for is None."""

    color: torch.Tensor  # [C, H, W]
    radii: torch.Tensor  # [N] int32; 3-sigma radius in pixels, 0 if the Gaussian touches nothing
    # [1, H, W]; the gate sum W = sum alpha_i T_i. `smoe`: W / (W + B + lambda T), what is not the background's.
    # Ablations: sum alpha_i
    alpha: Optional[torch.Tensor] = None
    depth: Optional[torch.Tensor] = None  # [1, H, W]; expected view depth sum(w z) / sum(w), 0 if nothing is hit
    inverse_depth: Optional[torch.Tensor] = None  # [1, H, W]; 1 / z blended as a colour, over background 0


class Contributions(NamedTuple):
    """Sums over the pixels that blended each of N Gaussians: what `Splats.contributions` returns.

    A pixel is among those of a Gaussian if the Gaussian has a weight in the numerator of the pixel's colour, so none
    behind a full pixel is. A Gaussian without pixels has 0.
    """

    pixel_weights: torch.Tensor  # [N] sum of the given map
    pixels: torch.Tensor  # [N] int32, how many they are
    blend_weights: torch.Tensor  # [N] sum of alpha T, in `smoe_std` of alpha; divided by no gate sum
    distances: torch.Tensor  # [N] sum of |pixel - centre| in pixels


class Importance(NamedTuple):
    """What each of N Gaussians is worth to an image: what `Splats.importance` returns. A culled Gaussian has 0.

    Sums over the pixels, with e the weight of a pixel. C is a pixel's colour, and f, the Gaussian's share of it, is its
    weight in the numerator divided by the denominator: dC/dc of its colour c. The shares of a pixel's Gaussians, and of
    its background, make 1; in `smoe_tn` less.
    """

    shares: torch.Tensor  # [N] sum e f
    squared_shares: torch.Tensor  # [N] sum e f^2
    removal_costs: torch.Tensor  # [N] sum e |C' - C|^2, over all channels; C' is the pixel without the Gaussian


class GateMap(NamedTuple):
    """Which Gaussians have a part in each pixel: what `Splats.gate_map` returns."""

    gaussians: torch.Tensor  # [H, W] int32; of the largest weight in the numerator, the nearest of equal ones; -1: none
    counts: torch.Tensor  # [H, W] int32, how many Gaussians the numerator has
    # [H, W] int32; with it the weights, front to back (`smoe_std`: by index), reach half of their denominator; -1: none
    medians: torch.Tensor


FEATURE_OUTPUTS = ("depth", "inverse_depth")  # images of the op on request, in its order
OUTPUTS = ("alpha", *FEATURE_OUTPUTS)
"""The optional outputs of `rasterize`, in the order of `Rendering`."""


def resolve_blend_mode(blend_mode: Optional[str]) -> str:
    """Returns the blend mode that a rendering uses.

    An explicit name wins; None means the environment variable DSMOE_BLEND_MODE, for callers that
    cannot be edited, and "alpha" if that is unset.
    Raises ValueError for a name that is not in BLEND_MODES.
    """
    source = "blend_mode"
    if blend_mode is None:
        blend_mode = os.environ.get(BLEND_MODE_VARIABLE) or "alpha"
        source = BLEND_MODE_VARIABLE
    if blend_mode not in BLEND_MODES:
        raise ValueError(f"{source} is {blend_mode!r}; it must be one of {', '.join(BLEND_MODES)}")
    return blend_mode


def resolve_background_gate(blend_mode: str, background_gate: Optional[BackgroundGate]) -> BackgroundGate:
    """Returns the background's gate lambda that a rendering in this blend mode uses.

    In `smoe` and `smoe_eq7` an explicit value wins; None means the environment variable DSMOE_BACKGROUND_GATE, for
    callers that cannot be edited, and 0 if that is unset. `alpha` has the gate 1; the ablations have none.
    LEARNED stays that word. Raises ValueError for a number that is negative, NaN or above MAX_BACKGROUND_GATE, a tensor
    of not one element, another word, and for a value in a mode that knows none.
    """
    fixed = _FIXED_GATES.get(blend_mode, 0.0)
    if fixed is not None:
        if background_gate is None or (fixed == 1 and not _is_tensor(background_gate) and background_gate == fixed):
            return fixed
        raise ValueError(f"background_gate is given, but blend_mode is {blend_mode!r}; only {_gated_names()} know it")
    source = "background_gate"
    if background_gate is None:
        background_gate = os.environ.get(BACKGROUND_GATE_VARIABLE) or 0.0
        source = BACKGROUND_GATE_VARIABLE
    if _is_tensor(background_gate):
        tensor = cast("torch.Tensor", background_gate)
        if tensor.numel() != 1:
            raise ValueError(f"background_gate has shape {list(tensor.shape)}; it must have one element")
        return background_gate
    if isinstance(background_gate, str) and background_gate == LEARNED:
        return LEARNED
    return _weight(source, background_gate, other=f", or {LEARNED!r}")


def resolve_faint_below(blend_mode: str, faint_below: Optional[float]) -> float:
    """Returns the gate sum of near pairs below which a rendering in this blend mode counts faint pairs and tails.

    None means the process's value, else the environment variable DSMOE_FAINT_BELOW, for callers that cannot be edited,
    else the mode's own.
    Raises ValueError for what is not a number of 0 or more, or a greater one than MAX_BACKGROUND_GATE.
    """
    if faint_below is None and blend_of_process is not None:
        faint_below = blend_of_process[2]
    if faint_below is None:
        asked = os.environ.get(FAINT_BELOW_VARIABLE)
        return _weight(FAINT_BELOW_VARIABLE, asked) if asked else usual_faint_below(blend_mode)
    return _weight("faint_below", faint_below, text_counts=False, other=", or None")


def usual_faint_below(blend_mode: str) -> float:
    """Returns the `faint_below` of a blend mode if nothing says another."""
    return _FAINT_BELOW.get(blend_mode, EVERYWHERE)


def trained_faint_below(blend_mode: str, recorded: Optional[float]) -> float:
    """Returns the `faint_below` that a model was trained with, whatever $DSMOE_FAINT_BELOW says now.

    recorded: what its file says; None: nothing, as where it was the usual one.
    """
    return usual_faint_below(blend_mode) if recorded is None else recorded


def leaves_out_faint(blend_mode: str, faint_below: Optional[float]) -> bool:
    """Returns whether a rendering in this blend mode has pixels in which faint pairs do not count."""
    return blend_mode in GATED_MODES and resolve_faint_below(blend_mode, faint_below) <= 1


def resolve_lens(settings: GaussianRasterizationSettings) -> Tuple[int, List[float]]:
    """Returns the number of the camera model, and the principal point and distortion that the ops take.

    With a rolling shutter a pinhole is `opencv` without distortion. Raises ValueError for a name that is not in
    CAMERA_MODELS, for values that are not numbers, and for a pinhole that has or lacks them against its rule. The core
    refuses wrong counts and values.
    """
    model, distortion, principal_point = settings.camera_model, settings.distortion, settings.principal_point
    if model == "pinhole" and settings.rolling_shutter != "global" and len(distortion) == 0:
        if principal_point is None:
            raise ValueError(f"principal_point is None, but rolling_shutter is {settings.rolling_shutter!r}, with "
                             "which projmatrix is not read; it must be given")
        model = "opencv"
    if model == "pinhole":  # which every eager call of a trainer comes through
        if len(distortion) > 0:
            raise ValueError(f"distortion is {distortion!r}, but camera_model is 'pinhole'; name the lens that has it: "
                             f"{', '.join(CAMERA_MODELS[2:5])}")
        if principal_point is not None:
            raise ValueError(f"principal_point is {principal_point!r}, but camera_model is 'pinhole'; its principal "
                             "point is in projmatrix")
        return 0, []
    if model not in CAMERA_MODELS:
        raise ValueError(f"camera_model is {model!r}; it must be one of {', '.join(CAMERA_MODELS)}")
    if principal_point is None:
        principal_point = (settings.image_width / 2, settings.image_height / 2)
    point = numbers_of("principal_point", principal_point)
    if len(point) != 2:
        raise ValueError(f"principal_point is {principal_point!r}; it must be two numbers")
    return CAMERA_MODELS.index(model), [*point, *numbers_of("distortion", distortion)]


def numbers_of(name: str, values: Any) -> List[float]:
    """Returns numbers of a lens. Raises ValueError for what are none, and for tensors that require a gradient."""
    try:
        if isinstance(values, str):
            raise TypeError
        needs_gradient = any(getattr(value, "requires_grad", False) for value in values)
        numbers = [float(value) for value in values] if not needs_gradient else []
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name} is {values!r}; it must be a sequence of numbers") from None
    if needs_gradient:
        raise ValueError(f"{name} requires a gradient, but a lens has none; detach it")
    return numbers


def resolve_shutter(settings: GaussianRasterizationSettings) -> int:
    """Returns the number of the rolling shutter.

    Raises ValueError for a name that is not in ROLLING_SHUTTERS, and for a `viewmatrix_end` that does not fit it.
    """
    name = settings.rolling_shutter
    if name not in ROLLING_SHUTTERS:
        raise ValueError(f"rolling_shutter is {name!r}; it must be one of {', '.join(ROLLING_SHUTTERS)}")
    if (name == "global") != (settings.viewmatrix_end is None):
        given, should = ("given", "be None") if name == "global" else ("None", "be the pose at the last row or column")
        raise ValueError(f"viewmatrix_end is {given}, but rolling_shutter is {name!r}; it must {should}")
    return ROLLING_SHUTTERS.index(name)


def _gated_names() -> str:
    return " and ".join(repr(mode) for mode in GATED_MODES)


def _weight(name: str, given: Any, text_counts: bool = True, other: str = "") -> float:
    """The number that is given. Raises ValueError for what is none, and for one below 0 or above MAX_BACKGROUND_GATE.

    text_counts: also what a text such as "0.1" says. other: what may be given too, for the error.
    """
    try:
        value = math.nan if isinstance(given, str) and not text_counts else float(given)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: a tensor of several elements
        value = math.nan
    if not 0 <= value <= MAX_BACKGROUND_GATE:
        raise ValueError(f"{name} is {given!r}; it must be a number, 0 or more and at most "
                         f"{MAX_BACKGROUND_GATE:g}{other}")
    return value


def _is_tensor(value: Any) -> bool:
    return hasattr(value, "numel")


# Blend mode, gate and `faint_below` of the training that this process is, ahead of the variables: a patched trainer
# sets it.
blend_of_process: Optional[Tuple[str, Optional[Union[float, str]], Optional[float]]] = None


def resolve_blend(settings: GaussianRasterizationSettings) -> Tuple[str, BackgroundGate]:
    """Returns the blend mode and the background's gate of a rendering.

    `smoe_eq7` with the number 1 is `alpha`, bit for bit. Raises ValueError as the two functions above do.
    """
    mode, gate = settings.blend_mode, settings.background_gate
    if mode is None and gate is None and blend_of_process is not None:
        mode, gate, _ = blend_of_process
    mode = resolve_blend_mode(mode)
    gate = resolve_background_gate(mode, gate)
    return "alpha" if mode == "smoe_eq7" and not _is_tensor(gate) and gate == 1 else mode, gate


def training_background_gate(blend_mode: str, background_gate: Union[float, str, None] = None
                             ) -> Union[float, str, None]:
    """Returns the background's gate that a public trainer takes and records; None in modes that know none.

    In GATED_MODES that is the given value, else the environment variable DSMOE_BACKGROUND_GATE, else LEARNED in `smoe`
    and 0 in `smoe_eq7`. Raises ValueError as `resolve_background_gate` does.
    """
    if background_gate is None and blend_mode == "smoe" and not os.environ.get(BACKGROUND_GATE_VARIABLE):
        return LEARNED
    gate = resolve_background_gate(blend_mode, background_gate)
    return cast("Union[float, str]", gate) if blend_mode in GATED_MODES else None
