"""What a patched trainer calls while it runs: how it blends and who says so, and stand-ins for what may be absent."""
from __future__ import annotations

import ast
import functools
import importlib
import os
import sys
import types
import warnings
from pathlib import Path
from typing import Any, Callable, Dict, Optional, Tuple

from diff_smoe_rasterization.settings import (
    BLEND_MODES,
    resolve_background_gate,
    resolve_blend_mode,
    training_background_gate,
)

SHIMS = Path(__file__).resolve().parent / "shims"
RASTERIZER_VARIABLE = "DSMOE_RASTERIZER"  # under `dsmoe run`: the module of integrations
WITHOUT_VARIABLE = "DSMOE_RUN_WITHOUT"  # and a name of it that the trainer must not find
USED_VARIABLE = "DSMOE_RUN_USED"  # and a file that is made when it is used first


def default_blend() -> Tuple[str, str]:
    """Returns the defaults of --blend_mode: $DSMOE_BLEND_MODE, else "alpha"; and of --background_gate: "".

    "" is what `training_background_gate` gives for the mode. Raises ValueError where DSMOE_BLEND_MODE names no mode.
    """
    return resolve_blend_mode(None), ""


def saved_blend_of(dataset: Any) -> Dict[str, Any]:
    """Returns what `blend_of` does, for a function that renders a trained model.

    What is not typed as an option is what the model's cfg_args records, whatever default `dataset` brought.
    """
    saved = _saved(dataset)
    for option in ("blend_mode", "background_gate"):
        if getattr(dataset, "model_path", "") and not _is_typed(option):
            setattr(dataset, option, saved.get(option))
    return blend_of(dataset)


def blend_of(dataset: Any) -> Dict[str, Any]:
    """Returns the settings `blend_mode` and `background_gate` of a run (None but in `smoe`).

    Notes both in `dataset`, the trainer's extracted ModelParams, which the trainer saves as cfg_args. Without a
    `blend_mode` (a cfg_args of before the patch): "alpha". In `smoe` without a `background_gate`: 0, Eq. 7.
    Says on stderr what they are, and whence. Warns, once, where one may not be what was meant.
    Raises ValueError where one is wrong, RuntimeError where the renderer has another rasterizer.
    """
    _check_renderer()
    given, saved = getattr(dataset, "blend_mode", None), _saved(dataset)
    mode = given or "alpha"
    cfg_args = Path(getattr(dataset, "model_path", "") or ".", "cfg_args")
    whence = _whence("blend_mode", mode, functools.partial(resolve_blend_mode, None), saved.get("blend_mode"), cfg_args)
    if mode not in BLEND_MODES:
        raise ValueError(f"the blend mode is {mode!r}, {whence}; it must be one of {', '.join(BLEND_MODES)}")
    said = f"blend mode {mode}, {whence}"
    if not given:
        _warn("this model's cfg_args records no blend mode, so it is alpha (a model trained by `dsmoe run`, or before "
              "the patch); --blend_mode says otherwise")
    gate = getattr(dataset, "background_gate", None)  # "" is the default; what is typed is a string
    if mode == "smoe" and gate is None:
        _warn("this model's cfg_args records no background gate, so it is 0, Eq. 7 (a model trained by `dsmoe run`, "
              "or in another mode); --background_gate says otherwise")
        gate = 0.0
    is_of_smoe = mode != "smoe" and not isinstance(gate, str)
    gate = training_background_gate(mode, None if gate == "" or is_of_smoe else gate)
    if gate is not None:
        before = saved.get("background_gate", 0.0) if saved.get("blend_mode") == mode else None
        said += f"; background gate {gate}, " + _whence(
            "background_gate", gate, functools.partial(resolve_background_gate, mode, None), before, cfg_args)
    _say(said)
    # The option lies in the trainers' OptimizationParams, which are not at hand where a model is rendered.
    chosen = [name for name, is_on in (("--random_background", "--random_background" in sys.argv),
                                       ("--white_background", getattr(dataset, "white_background", False))) if is_on]
    if mode != "alpha" and not gate and chosen:
        _warn(f"{' and '.join(chosen)} with blend mode {mode}{' and background gate 0' if mode == 'smoe' else ''}: the "
              "background shows only where no gate is open, so it does not penalise transparent Gaussians as it does "
              "in alpha mode")
    dataset.blend_mode, dataset.background_gate = mode, gate
    return {"blend_mode": mode, "background_gate": gate}


def _whence(option: str, value: Any, of_variable: Callable[[], Any], saved: Any, cfg_args: Path) -> str:
    """Says in words where an option's value comes from; warns where its variable or cfg_args has another.

    of_variable: reads the variable. saved: what cfg_args has, None where that is nothing.
    """
    name, flag, variable = option.replace("_", " "), "--" + option, "DSMOE_" + option.upper()
    there = {variable: of_variable() if os.environ.get(variable) else None, str(cfg_args): saved}
    agreeing = [source for source, other in there.items() if other == value]
    whence = f"as in {' and '.join(agreeing)}" if agreeing else "the default"
    if _is_typed(option):
        whence = f"as {flag} says"
    # Rendering without the flag never comes here: it has the value of cfg_args.
    if saved not in (None, value):
        _warn(f"{cfg_args} is of a run with {name} {saved}, but this one has {value}, {whence}; a training overwrites "
              f"it. To go on as before, give {flag} {saved}")
    if there[variable] not in (None, value):
        _warn(f"{variable} is {there[variable]}, but the {name} is {value}: {flag} and cfg_args win")
    return whence


@functools.lru_cache(maxsize=None)
def _note_use() -> None:
    """Tells `dsmoe run` that something was rendered."""
    used = os.environ.get(USED_VARIABLE, "")
    if os.path.isdir(os.path.dirname(used)):
        Path(used).touch()


def _noting(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        _note_use()
        return function(*arguments, **keywords)

    return call


def _say_rasterizer(flavour: str) -> None:
    mode = resolve_blend_mode(None)
    gate = f", background gate {resolve_background_gate(mode, None)}" if mode == "smoe" else ""
    _say(f"the rasterizer is {flavour} of this package, blend mode {mode}{gate}")


def rasterizer_of_run(flavour: Optional[str] = None) -> Dict[str, Any]:
    """Returns what a trainer imports from its rasterizer under `dsmoe run`, and says so on stderr.

    flavour: the module of integrations, where the name that is imported says it; None: the one that the trainer needs.
    The first rasterizer that is made, or function that is called, is noted for `dsmoe run`, which else says at the end
    that nothing was rendered.
    """
    from diff_smoe_rasterization import GaussianRasterizer

    flavour = flavour or os.environ[RASTERIZER_VARIABLE]
    flavour = "inria" if flavour == "gsplat" else flavour  # gsplat's wrapper of Inria's rasterizer imports that
    module = importlib.import_module("diff_smoe_rasterization.integrations." + flavour)
    GaussianRasterizer.__init__ = _noting(GaussianRasterizer.__init__)
    _say_rasterizer(flavour)
    offered = {name: getattr(module, name) for name in module.__all__ if name != os.environ.get(WITHOUT_VARIABLE)}
    return {name: _noting(value) if name.startswith("rasterize_") else value for name, value in offered.items()}


def gsplat_of_run() -> None:
    """Puts this package's functions into gsplat as it is installed: the rasterizer, and what its strategies compute.

    The strategies and all else stay gsplat's own. A gsplat before 1.5 finds radii [C, N], without an axis of two.
    Where gsplat cannot be had, the package has `rasterization` and `rendering.rasterization` alone.
    """
    from diff_smoe_rasterization.integrations import gsplat as ours

    if not is_installed("gsplat"):
        sys.modules["gsplat.rendering"] = types.ModuleType("gsplat.rendering")
        for module in ("gsplat", "gsplat.rendering"):
            sys.modules[module].__dict__["rasterization"] = None
    theirs = sys.modules["gsplat"]
    major, minor = (int(number) for number in str(getattr(theirs, "__version__", "1.5")).split(".")[:2])

    @functools.wraps(ours.rasterization)
    def rasterization(*arguments: Any, **keywords: Any) -> Any:
        renders, alphas, meta = ours.rasterization(*arguments, **keywords)
        if (major, minor) < (1, 5):
            meta["radii"] = meta["radii"][..., 0]
        return renders, alphas, meta

    offered = {"rasterization": _noting(rasterization), "compute_relocation": ours.compute_relocation,
               "quat_scale_to_covar_preci": ours.quat_scale_to_covar_preci}
    for name, function in offered.items():
        for module in ("gsplat", "gsplat.rendering", "gsplat.relocation", "gsplat.strategy.ops"):
            if hasattr(sys.modules.get(module), name):
                setattr(sys.modules[module], name, function)
    _say_rasterizer("gsplat")


def is_installed(module: str) -> bool:
    """Whether a package can be imported from elsewhere; then it takes the place of the stand-in in shims/ that asks.

    module: of the package, one that may fail to load. Where it cannot be had, that is said on stderr.
    """
    import torch  # noqa: F401  (its libraries are the extensions')

    name, path = module.partition(".")[0], sys.path[:]
    ours = sys.modules.pop(name)
    sys.path[:] = [folder for folder in path if Path(folder).resolve() != SHIMS]
    try:
        importlib.import_module(module)
        return True
    except Exception:  # an extension that was built for another torch fails in many ways
        for loaded in [loaded for loaded in sys.modules if (loaded + ".").startswith(name + ".")]:
            del sys.modules[loaded]
        sys.modules[name] = ours
        _say(f"{name} could not be imported: this package's own takes its place")
        return False
    finally:
        sys.path[:] = path


def optional_import(name: str) -> Any:
    """Returns the module; where it is not installed, a stand-in whose attributes raise the ImportError."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        absent, reason = types.ModuleType(name), error

        def missed(_: str) -> Any:
            raise reason

        absent.__getattr__ = missed  # type: ignore[method-assign]
        return absent


def deferred(make: Callable[[], Callable[..., Any]]) -> Callable[..., Any]:
    """Returns a function that calls make() when it is called first, and then what make() returned."""
    made = functools.lru_cache(maxsize=None)(make)
    return lambda *arguments, **keywords: made()(*arguments, **keywords)


def nan_without_network(metric: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the metric, whose value is NaN, with a warning, where it is not installed or cannot download its weights.

    A measurement then does not end a training of hours. After the first failure it is not tried again.
    """
    failed = []

    @functools.wraps(metric)
    def call(*arguments: Any, **keywords: Any) -> Any:
        import torch

        if not failed:
            try:
                return metric(*arguments, **keywords)
            except (ImportError, OSError) as error:  # urllib's URLError is an OSError
                failed.append(error)
                _warn(f"LPIPS is NaN: it, or its weights, could not be had ({error})")
        return torch.tensor(float("nan"))

    return call


# Of the largest value. Of a variance E[x^2] - E[x]^2 float32 rounds off some 1e-7 of E[x^2], which may be 1e-4 of the
# variance; another window, border or constant makes several per cent.
SSIM_ROUNDING = 1e-3


def fused_where_equal(ssim: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a trainer's ssim(img1, img2, ...), by `fused_ssim` where that can be.

    img1, img2: [3, H, W] or [B, 3, H, W]. Of the first images of a shape both are computed: where they differ in value
    or gradient the trainer's own stays, and a line on stderr says so. It is also called for other arguments and types,
    and for gradients by img2: the kernel has none of it.
    """
    differences: Dict[Any, str] = {}

    @functools.wraps(ssim)
    def call(*images: Any, **keywords: Any) -> Any:
        import torch

        from diff_smoe_rasterization import fused_ssim

        first, second = images if len(images) == 2 and not keywords else (None, None)
        if (first is None or first.dim() not in (3, 4) or first.shape != second.shape or first.device != second.device
                or {first.dtype, second.dtype} != {torch.float32}
                or second.requires_grad and torch.is_grad_enabled()):
            return ssim(*images, **keywords)
        case = first.device, first.shape
        if case not in differences:
            differences[case] = difference_of(fused_ssim, ssim, first, second)
            if differences[case]:
                _say(f"--fuse: {ssim.__module__}.{ssim.__name__} is not SSIM as it is fused here "
                     f"({differences[case]}): it is computed as before")
        return ssim(*images) if differences[case] else fused_ssim(*images)

    return call


def difference_of(fused: Callable[..., Any], own: Callable[..., Any], img1: Any, img2: Any) -> str:
    """What two similarities of images differ in, their gradients by img1 too; empty where in nothing."""
    import torch

    def value_and_gradient(similarity: Callable[..., Any]) -> Any:
        image = img1.detach().clone().requires_grad_()
        value = similarity(image, img2.detach().clone())
        return (value.detach(), *torch.autograd.grad(value, image))

    with torch.inference_mode(False), torch.enable_grad(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        try:
            for ours, theirs in zip(value_and_gradient(fused), value_and_gradient(own)):
                torch.testing.assert_close(theirs, ours, rtol=0, atol=SSIM_ROUNDING * float(ours.abs().max()))
        except Exception as error:  # whatever another function has against the images: the training goes on
            return " ".join(str(error).split())
    return ""


EIGH_AT_ONCE = 16_384  # cuSOLVER's batched solver of CUDA 12.8 and later fails on batches somewhere above 32,000


def eigh_in_parts(matrices: Any, UPLO: str = "L") -> Any:
    """Returns what torch.linalg.eigh returns, computed for so many matrices at once as its CUDA solver can take.

    matrices: [..., n, n]. Has the gradient that torch.linalg.eigh has.
    """
    import torch

    flat = matrices.reshape(-1, *matrices.shape[-2:])
    if len(flat) <= EIGH_AT_ONCE:
        return torch.linalg.eigh(matrices, UPLO=UPLO)
    parts = [torch.linalg.eigh(part, UPLO=UPLO) for part in flat.split(EIGH_AT_ONCE)]
    values, vectors = (torch.cat(results) for results in zip(*parts))
    return type(parts[0])((values.reshape(matrices.shape[:-1]), vectors.reshape(matrices.shape)))


def unique_rows(input: Any, sorted: bool = True, return_inverse: bool = False, return_counts: bool = False,
                dim: int = 0) -> Any:
    """Returns what torch.unique returns, of integers along dim 0 without the merge sort that may fail on CUDA.

    With that of CUB (NVIDIA/cccl 5456) processes that share a GPU ended with cudaErrorIllegalAddress. In one dimension
    torch.unique has a radix sort.
    input: [N, ...]. As in torch, rows are sorted whatever `sorted` says.
    """
    import torch

    if dim != 0 or input.dim() == 0 or input.numel() == 0 or input.is_floating_point() or input.is_complex():
        return torch.unique(input, sorted, return_inverse, return_counts, dim)
    inverse = torch.zeros(len(input), dtype=torch.int64, device=input.device)
    for column in input.reshape(len(input), -1).unbind(1):
        values, rank = torch.unique(column, return_inverse=True)
        # Of the columns so far and this one. Both are ranks below N: no key reaches N^2, of which int64 takes N < 3e9.
        _, inverse, counts = torch.unique(inverse * len(values) + rank, return_inverse=True, return_counts=True)
    unique = input.new_empty(len(counts), *input.shape[1:])
    unique[inverse] = input  # of rows that are equal any one
    results = (unique,) + (inverse,) * return_inverse + (counts,) * return_counts
    return results if len(results) > 1 else unique


def _check_renderer() -> None:
    """Raises RuntimeError where the trainer's renderer is not, or no longer, patched: it would ignore the mode."""
    renderer = sys.modules.get("gaussian_renderer")
    settings = getattr(renderer, "GaussianRasterizationSettings", None)
    if settings is not None and "blend_mode" not in getattr(settings, "_fields", ()):
        checkout = Path(getattr(renderer, "__file__", None) or "PATH/x").parent.parent
        raise RuntimeError("gaussian_renderer uses another rasterizer, which has no blend modes: was it restored after "
                           f"the patch? type: dsmoe patch check {checkout}")


def _is_typed(option: str) -> bool:
    """Whether an option is on the command line, as argparse takes it: also `--blend smoe`."""
    flag = "--" + option
    return any(word.startswith(flag[:4]) and flag.startswith(word.partition("=")[0]) for word in sys.argv)


def _saved(dataset: Any) -> Dict[str, Any]:
    """Returns the constants in a model's cfg_args, a Namespace as text; none where there is none."""
    folder = getattr(dataset, "model_path", "")
    try:
        call = ast.parse(Path(folder, "cfg_args").read_text(), mode="eval").body if folder else None
    except (OSError, ValueError, SyntaxError):
        return {}
    return {keyword.arg: keyword.value.value for keyword in getattr(call, "keywords", ())
            if isinstance(keyword.value, ast.Constant)}


@functools.lru_cache(maxsize=None)
def _say(text: str) -> None:
    print("diff_smoe_rasterization: " + text, file=sys.stderr, flush=True)


@functools.lru_cache(maxsize=None)
def _warn(text: str) -> None:
    warnings.warn("diff_smoe_rasterization: " + text, stacklevel=3)
