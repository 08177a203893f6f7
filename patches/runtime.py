"""What a patched trainer, or one under `dsmoe run`, calls while it runs: how it blends, and what stands in for what."""
from __future__ import annotations

import ast
import contextlib
import functools
import importlib
import os
import re
import sys
import types
from pathlib import Path
from typing import Any, Callable, Dict, Tuple

from diff_smoe_rasterization import settings
from diff_smoe_rasterization.settings import (
    BACKGROUND_GATE_VARIABLE,
    BLEND_MODE_VARIABLE,
    BLEND_MODES,
    FAINT_BELOW_VARIABLE,
    GATED_MODES,
    LEARNED,
    PAPER,
    PAPER_PROGRAM,
    resolve_blend_mode,
    resolve_faint_below,
)

STAND_INS = Path(__file__).resolve().parent / "stand_ins"
OPTIONS = ("blend_mode", "background_gate", "faint_below")  # as cfg_args records them; the last one is not a flag
RASTERIZER_VARIABLE = "DSMOE_RASTERIZER"  # under `dsmoe run`: the module of integrations
WITHOUT_VARIABLE = "DSMOE_RUN_WITHOUT"  # and a name of it that the trainer must not find
USED_VARIABLE = "DSMOE_RUN_USED"  # and a file that is made when it is used first


def keep_records() -> None:
    """Lets the trainer's files record mode and gate, as records.py says."""
    from diff_smoe_rasterization.integrations.records import keep
    keep()


def _begin_gate(frozen: bool) -> None:
    from diff_smoe_rasterization.learned_gate import gate
    gate.reset(frozen)


def default_blend() -> Tuple[str, str]:
    """Returns the defaults of --blend_mode, $DSMOE_BLEND_MODE or alpha, and of --background_gate, the mode's."""
    keep_records()
    _explain_no_gpu()
    _check_renderer()  # if only it was restored, the option would be recorded and ignored
    is_paper = os.environ.get(BLEND_MODE_VARIABLE) == PAPER
    return PAPER if is_paper else resolve_blend_mode(None), ""


def default_smoe() -> Tuple[str, str]:
    """Returns what `default_blend` does for the trainer of the paper's authors: smoe, not alpha."""
    mode, gate = default_blend()
    return (mode if os.environ.get(BLEND_MODE_VARIABLE) else "smoe"), gate


def smoe_of(dataset: Any, of_saved: bool = False) -> Dict[str, Any]:
    """Returns what `blend_of` does for the trainer of the paper's authors, whose rasterizer is one of `smoe`.

    In `smoe` tails count in every pixel, as in their program. A model without a recorded mode is of that program.
    """
    blend = blend_of(dataset, of_saved, unrecorded="smoe")
    return {**blend, "faint_below": settings.EVERYWHERE} if blend["blend_mode"] == "smoe" else blend


def saved_smoe_of(dataset: Any) -> Dict[str, Any]:
    """Returns what `smoe_of` does, for a function that renders a trained model, as `saved_blend_of`."""
    _take_saved(dataset)
    return smoe_of(dataset, of_saved=True)


def saved_blend_of(dataset: Any) -> Dict[str, Any]:
    """Returns what `blend_of` does, for a function that renders a trained model.

    What is not typed as an option is what the model's cfg_args records, whatever default `dataset` brought.
    """
    _take_saved(dataset)
    return blend_of(dataset, of_saved=True)


def _take_saved(dataset: Any) -> None:
    """Options that are not typed get the values of the model's cfg_args, None if it has none."""
    saved = _saved(dataset)
    for option in OPTIONS:
        if getattr(dataset, "model_path", "") and not _is_typed(option):
            setattr(dataset, option, saved.get(option))


def blend_of(dataset: Any, of_saved: bool = False, unrecorded: str = "alpha") -> Dict[str, Any]:
    """Returns the settings `blend_mode`, `background_gate` and `faint_below` of a run (None but in GATED_MODES).

    The blend mode PAPER stands for PAPER_PROGRAM. $DSMOE_FAINT_BELOW is recorded too.

    A gate that is learned begins anew; under `of_saved` it is the model file's, and is never stepped.

    Notes them in `dataset`, the trainer's extracted ModelParams, which the trainer saves as cfg_args.
    Without a `blend_mode` (a cfg_args of before the patch): `unrecorded`. In GATED_MODES without a
    `background_gate`: 0.
    From then on a rendering of this process whose settings name no mode has both.
    Says on stderr what they are. Warns, once, if one may not be what was meant.
    Raises ValueError if one is wrong, RuntimeError if the renderer has another rasterizer.
    """
    _check_renderer()
    mode, gate, faint = (getattr(dataset, option, None) for option in OPTIONS)  # a gate that is typed is a string
    if mode == PAPER:
        if gate not in ("", None) and settings.training_background_gate("smoe", gate) != 0:
            raise ValueError(f"the background gate is {gate!r}; with the blend mode {PAPER} it is 0, or left out")
        mode, gate, faint = PAPER_PROGRAM.values()
    saved = _saved(dataset)
    if not mode and unrecorded == "smoe":
        say("this model's cfg_args records no blend mode, so it is smoe with the gate 0, as the program of the paper's "
            "authors renders")
        mode, gate = unrecorded, 0.0 if gate is None else gate
    elif not mode:
        _warn("this model's cfg_args records no blend mode, so it is alpha (a model trained by `dsmoe run`, or before "
              "the patch); --blend_mode says otherwise")
        mode = unrecorded
    if mode not in BLEND_MODES:
        raise ValueError(f"the blend mode is {mode!r}; it must be one of {', '.join(BLEND_MODES)} or {PAPER}")
    if mode in GATED_MODES and gate is None:
        _warn("this model's cfg_args records no background gate, so it is 0 (a model trained by `dsmoe run`, "
              "or in another mode); --background_gate says otherwise")
        gate = 0.0
    is_of_smoe = mode not in GATED_MODES and (
        not isinstance(gate, str) or gate == LEARNED == saved.get("background_gate"))
    asked = None if gate == "" or is_of_smoe else gate
    if unrecorded == "smoe" and asked is None and mode in GATED_MODES:
        asked = os.environ.get(BACKGROUND_GATE_VARIABLE) or 0.0
    gate = settings.training_background_gate(mode, asked)
    if faint is None and os.environ.get(FAINT_BELOW_VARIABLE):
        faint = resolve_faint_below(mode, None)
    faint = faint if mode in GATED_MODES else None
    keep_records()
    if gate == LEARNED:
        _begin_gate(frozen=of_saved)
    say(f"blend mode {mode}" + (f", background gate {gate}" if gate is not None else "")
        + (f", faint_below {faint:g}" if faint is not None else ""))
    # Rendering without an option never warns: it has what cfg_args records.
    for option, value in zip(OPTIONS, (mode, gate, faint)):
        before = saved.get(option)
        if value is not None and before not in (None, value):
            _warn(f"{dataset.model_path}/cfg_args is of a run with {option} {before}, but this one has {value}; a "
                  f"training overwrites it. To go on as before, give --{option} {before}")
    _warn_of_no_kernels()
    settings.blend_of_process = mode, gate, faint  # the patch's line in the renderer may be deleted
    dataset.blend_mode, dataset.background_gate = mode, gate
    if faint is None:
        return {"blend_mode": mode, "background_gate": gate}
    dataset.faint_below = faint
    return {"blend_mode": mode, "background_gate": gate, "faint_below": faint}


def chosen_blend(pipe: Any) -> Dict[str, Any]:
    """Returns the settings that `blend_of` left. Raises RuntimeError if a script of the user's did not call it."""
    if not hasattr(pipe, "blend"):
        raise RuntimeError("this script renders without a blend mode; before it renders it needs the statements `from "
                           f"{__name__} import saved_blend_of` and `pipe.blend = saved_blend_of(dataset)`; where it "
                           "trains, blend_of")
    return pipe.blend


def _noting(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function, whose first call tells `dsmoe run` that something was rendered."""
    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        used = os.environ.pop(USED_VARIABLE, "")
        if os.path.isdir(os.path.dirname(used)):
            Path(used).touch()
        return function(*arguments, **keywords)

    return call


def _say_rasterizer(flavour: str) -> None:
    """Says which rasterizer it is, and at the first step of an optimizer if nothing has been rendered by then."""
    mode = resolve_blend_mode(None)
    gate = f", background gate {settings.resolve_background_gate(mode, None)}" if mode in GATED_MODES else ""
    say(f"the rasterizer is {flavour} of this package, blend mode {mode}{gate}")
    _warn_of_no_kernels()
    _explain_no_gpu()

    def look(*_: Any) -> None:
        used = os.environ.get(USED_VARIABLE, "")  # until the first rendering of this process
        if used and not os.path.exists(used):
            say(f"the first step of an optimizer, and this rasterizer has rendered nothing yet: if what is trained now "
                f"are Gaussians, another one renders them, not {mode}")

    steps = importlib.import_module("torch.optim.optimizer")
    if USED_VARIABLE in os.environ and hasattr(steps, "register_optimizer_step_pre_hook"):  # torch 2.0
        steps.register_optimizer_step_pre_hook(look)


@functools.lru_cache(maxsize=None)
def _modernise() -> None:
    """Does once what --modernise does; a trainer without Pillow reads no images by it."""
    with contextlib.suppress(ImportError):
        importlib.import_module("dsmoe.patches.modernise").start()


def rasterizer_of_run(flavour: str = "") -> Dict[str, Any]:
    """Returns what a trainer imports from its rasterizer under `dsmoe run`, and says so on stderr.

    flavour: the module of integrations, if the name that is imported says it; else the one that the trainer needs, or
        what a call returns, with commas.
    """
    from diff_smoe_rasterization import GaussianRasterizer
    from diff_smoe_rasterization.integrations._rasterizer import classes_of
    from diff_smoe_rasterization.integrations.contracts import contract_of
    flavour = flavour or os.environ[RASTERIZER_VARIABLE]
    if "," in flavour:
        names = "GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"
        offered = {**vars(importlib.import_module("diff_smoe_rasterization.integrations.inria_2024")),
                   **dict(zip(names, classes_of(flavour, __name__)))}
        module: Any = types.SimpleNamespace(**{**offered, "__all__": [*names, *contract_of(flavour).names]})
    else:
        module = importlib.import_module("diff_smoe_rasterization.integrations." + flavour)
    keep_records()
    _modernise()
    if flavour == "c3dgs":  # it compresses a trained model, whose gate stays
        _begin_gate(frozen=True)
    GaussianRasterizer.__init__ = _noting(GaussianRasterizer.__init__)  # type: ignore[method-assign]
    _say_rasterizer(flavour)
    offered = {name: getattr(module, name) for name in module.__all__ if name != os.environ.get(WITHOUT_VARIABLE)}
    return {name: _noting(value) if name.startswith("rasterize_") else value for name, value in offered.items()}


def gsplat_of_run() -> None:
    """Puts this package's functions into gsplat as it is installed: the rasterizer, and what its strategies compute.

    The strategies and all else stay gsplat's own. A gsplat before 1.5 finds radii [C, N], without an axis of two.
    If gsplat cannot be had, the package has only `rasterization` and `rendering.rasterization`.
    """
    from diff_smoe_rasterization.integrations import gsplat as ours
    if not is_installed("gsplat"):
        sys.modules["gsplat.rendering"] = types.ModuleType("gsplat.rendering")
        for module in ("gsplat", "gsplat.rendering"):
            sys.modules[module].__dict__["rasterization"] = None
    version = str(getattr(sys.modules["gsplat"], "__version__", "1.5")).split(".")

    @functools.wraps(ours.rasterization)
    def rasterization(*arguments: Any, **keywords: Any) -> Any:
        renders, alphas, meta = ours.rasterization(*arguments, **keywords)
        if [int(number) for number in version[:2]] < [1, 5]:
            meta["radii"] = meta["radii"][..., 0]
        return renders, alphas, meta

    offered = {"rasterization": _noting(rasterization), "compute_relocation": ours.compute_relocation,
               "quat_scale_to_covar_preci": ours.quat_scale_to_covar_preci}
    for name, function in offered.items():
        for module in ("gsplat", "gsplat.rendering", "gsplat.relocation", "gsplat.strategy.ops"):
            if hasattr(sys.modules.get(module), name):
                setattr(sys.modules[module], name, function)
    for module in filter(None, map(sys.modules.get, ("gsplat", "gsplat.rendering"))):
        for name in [name for name in vars(module) if name.startswith("rasterization_")]:
            setattr(module, name, _refusing(name))  # which a trainer may call by its options alone
    keep_records()
    _say_rasterizer("gsplat")


def _refusing(name: str) -> Callable[..., Any]:
    """Returns what stands for a rasterizer of gsplat's that this package has not."""
    def refuse(*_: Any, **__: Any) -> Any:
        raise NotImplementedError(f"dsmoe run: the trainer calls gsplat's {name}, which this package has not; choose "
                                  "gsplat's rasterization in the trainer's options, or run it without dsmoe run")

    return refuse


def _warn_of_no_kernels() -> None:
    """Where torch sees a GPU and this build has no kernels: what pip said of that while it built is hidden."""
    from dsmoe.system.device import why_no_gpu
    if importlib.import_module("torch").cuda.is_available() and why_no_gpu():
        _warn(f"the GPU cannot be used: {why_no_gpu()}")


@functools.lru_cache(maxsize=None)
def _explain_no_gpu() -> None:
    """Where the trainer ends in torch's error because there is no GPU, a line behind that says so.

    Not before: asking for GPUs fixes which there are, and some trainers choose theirs later, by an option.
    """
    show = sys.excepthook

    def explain(kind: Any, error: BaseException, trace: Any) -> None:
        show(kind, error, trace)
        of_torch = isinstance(error, (RuntimeError, AssertionError)) and re.search("(?i)cuda|nvidia", str(error))
        if of_torch and not importlib.import_module("torch").cuda.is_available():
            say("no CUDA device is there, and this trainer's own code asks for one; `dsmoe train` needs none")

    sys.excepthook = explain


def is_installed(module: str) -> bool:
    """Whether a package, with this module of it, can be imported from elsewhere; then it replaces its stand-in."""
    import torch  # noqa: F401  (its libraries are the extensions')
    name, path = module.partition(".")[0], sys.path[:]
    ours = sys.modules.pop(name)
    found_in = Path(str(ours.__file__)).resolve().parents[1]
    sys.path[:] = [folder for folder in path if Path(folder).resolve() != found_in]
    try:
        importlib.import_module(module)
        return True
    except Exception:  # an extension that was built for another torch fails in many ways
        for loaded in [loaded for loaded in sys.modules if (loaded + ".").startswith(name + ".")]:
            del sys.modules[loaded]
        sys.modules[name] = ours
        say(f"{name} could not be imported: this package's own takes its place")
        return False
    finally:
        sys.path[:] = path


def _check_renderer() -> None:
    """Raises RuntimeError if the trainer's renderer is not, or no longer, patched: it would ignore the mode."""
    theirs = getattr(sys.modules.get("gaussian_renderer"), "GaussianRasterizationSettings", None)
    if theirs is not None and "blend_mode" not in getattr(theirs, "_fields", ()):
        raise RuntimeError("gaussian_renderer uses another rasterizer, which has no blend modes: was it restored after "
                           "the patch? type: dsmoe patch check PATH")


def _is_typed(option: str) -> bool:
    """Whether an option is on the command line, as argparse takes it: also `--blend smoe`."""
    flag = "--" + option
    return any(word.startswith(flag[:4]) and flag.startswith(word.partition("=")[0]) for word in sys.argv)


def _saved(dataset: Any) -> Dict[str, Any]:
    """Returns what a model's cfg_args, a Namespace as text, records of the options."""
    path = Path(getattr(dataset, "model_path", "") or os.devnull, "cfg_args")
    text = path.read_text(errors="replace") if path.is_file() else ""
    found = re.findall(rf"(?:\(|, )({'|'.join(OPTIONS)})=('\w+'|None|[\d.e+-]+)", text)
    return {name: ast.literal_eval(value) for name, value in found}


@functools.lru_cache(maxsize=None)
def say(text: str) -> None:
    print("diff_smoe_rasterization: " + text, file=sys.stderr, flush=True)


def _warn(text: str) -> None:
    """By no `warnings`: trainers such as Scaffold-GS switch these off."""
    say("warning: " + text)
