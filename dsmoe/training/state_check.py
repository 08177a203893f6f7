"""Whether what a checkpoint holds can be a state of a run: all of it is looked at before anything is taken over."""
from __future__ import annotations

import math
import random
from typing import Any, Dict, Iterator, Sequence, Tuple

import numpy as np
import torch

from ..model import LARGEST_LOG, PARAMETERS, are_numbers
from ..options.config import LEARNED, TrainConfig

ROWS = {"means3D": (3,), "dc": (1, 3), "opacities": (1,), "scales": (3,), "rotations": (4,)}  # behind [N]
CHANGING = ("raw", "optimizer", "strategy", "gate", "average")  # what of a state has tensors that a step changes
MOMENTS = ("exp_avg", "exp_avg_sq")  # of Adam
MOST_STEPS = 2**53  # of Adam
LARGEST_LOGARITHM = 80.0  # whose exponential float32 holds


class Misfit(ValueError):
    """What of a state cannot be, and what it must be."""


def check_state(state: Dict[str, Any], config: TrainConfig, strategy: Dict[str, Any], views: int) -> None:
    """Raises Misfit if a state is none of the run with this config. What else may be raised means the same.

    strategy: the state of the run's strategy as it is now. views: number of training views.
    """
    most = state["config"]["iterations"]
    _require(_is_whole(most) and 1 <= most <= config.iterations, "config.iterations", most,
             f"a whole number from 1 to {config.iterations}")
    iteration = state["iteration"]
    _require(_is_whole(iteration) and 1 <= iteration <= most and iteration % config.batch == 0, "iteration", iteration,
             f"a multiple of {config.batch} from 1 to {most}")
    seconds = state["train_seconds"]
    _require(_is_number(seconds) and seconds >= 0, "train_seconds", seconds, "a number of seconds")
    check_model(state, config)
    count = len(state["raw"]["means3D"])
    _require(set(state["optimizer"]) <= set(PARAMETERS), "optimizer", sorted(state["optimizer"]), "of the tensors raw")
    for name, adam in state["optimizer"].items():
        _check_adam(f"optimizer/{name}", adam, state["raw"][name].shape)
    ages = {name: state["optimizer"][name]["step"] for name in ("dc", "shs") if name in state["optimizer"]}
    _require(len({*ages.values()}) < 2 and {*ages} != {"shs"}, "optimizer", ages, "steps of dc, and as many of shs")
    if state["gate"] is not None and state["gate"]["adam"]:
        _check_adam("gate/adam", state["gate"]["adam"], (1,))

    _require(set(state["strategy"]) == set(strategy), "strategy", sorted(state["strategy"]), str(sorted(strategy)))
    for name, now in strategy.items():
        value = state["strategy"][name]
        if isinstance(now, dict):
            _require(isinstance(value, dict) and all(map(_is_whole, value.values())), f"strategy/{name}", value,
                     "whole numbers by name")
        elif isinstance(now, int):
            _require(_is_whole(value) and value >= 0, f"strategy/{name}", value, "a whole number")
        else:
            _check_tensor(f"strategy/{name}", value, (count, *now.shape[1:]), now.dtype)

    check_numbers(state)
    places = sorted((tensor.data_ptr(), tensor.data_ptr() + tensor.numel() * tensor.element_size())
                    for _, tensor in _tensors(state, CHANGING) if tensor.numel())
    _require(all(end <= begin for (_, end), (begin, _) in zip(places, places[1:])), "tensors", "in the same memory",
             "apart")

    left = state["order"]["left"]
    _require(all(map(_is_whole, left)) and len(set(left)) == len(left) and set(left) <= set(range(views)), "order/left",
             left, f"different numbers below {views}, the number of training views")
    for name, numbers in (("order/random", state["order"]["random"]), ("random/python", state["random"]["python"])):
        version, key, gauss = numbers
        random.Random().setstate((version, tuple(key), gauss))
        _require(gauss is None or _is_number(gauss), name, gauss, "a number or nothing")
    kind, keys, position, has_gauss, gauss = state["random"]["numpy"]
    np.random.RandomState().set_state((kind, np.array(keys, np.uint32), position, has_gauss, gauss))
    torch.Generator().set_state(state["random"]["torch"].cpu())
    for generator in state["random"]["cuda"][:1]:
        _require(isinstance(generator, torch.Tensor), "random/cuda", type(generator).__name__, "a tensor")
        if config.device != "cpu":
            torch.Generator(config.device).set_state(generator.cpu())

    _require(isinstance(state["history"], list) and all(isinstance(row, dict) for row in state["history"]), "history",
             state["history"], "a list of evaluations")
    _require(all(_is_whole(step) and 0 <= step <= iteration and _is_number(loss) for step, loss in state["losses"]),
             "losses", state["losses"], "pairs of an iteration and a loss")


def check_model(state: Dict[str, Any], config: TrainConfig) -> None:
    """Raises Misfit if a state's Gaussians, or its background gate, are none of the run with this config."""
    degree = state["active_sh_degree"]
    _require(_is_whole(degree) and 0 <= degree <= config.sh_degree, "active_sh_degree", degree,
             f"0 to {config.sh_degree}")
    raw = state["raw"]
    _require(set(raw) == set(PARAMETERS), "raw", sorted(raw), f"the tensors {', '.join(PARAMETERS)}")
    count = len(raw["means3D"])
    _require(count >= 1, "raw/means3D", "empty", "one row for each Gaussian")
    for name, rows in {**ROWS, "shs": ((config.sh_degree + 1) ** 2 - 1, 3)}.items():
        _check_tensor(f"raw/{name}", raw[name], (count, *rows))
    _require((state["gate"] is not None) == (config.background_gate == LEARNED), "gate", state["gate"],
             "there where the background gate is learned, and only there")
    if state["gate"] is not None:
        _check_tensor("gate/logarithm", state["gate"]["logarithm"], (1,))
        logarithm = float(state["gate"]["logarithm"])
        _require(abs(logarithm) <= LARGEST_LOGARITHM, "gate/logarithm", logarithm,
                 f"between -{LARGEST_LOGARITHM} and {LARGEST_LOGARITHM}")
    average, names = state["average"], {*PARAMETERS, *(["background_gate"] if state["gate"] else [])}
    _require(isinstance(average, dict) and set(average) in (set(), names), "average", average,
             f"empty or the tensors {', '.join(sorted(names))}")
    for name, tensor in average.items():
        _check_tensor(f"average/{name}", tensor, raw[name].shape if name in raw else (1,))


def check_numbers(state: Dict[str, Any]) -> None:
    """Raises Misfit if a tensor of a state holds what no training has that goes on: NaN, infinities, overflows."""
    for name, tensor in _tensors(state, CHANGING):
        where, _, last = name.rpartition("/")
        fits, wanted = are_numbers(last, tensor) if where in ("raw", "average") else tensor.isfinite(), "finite"
        if where in ("raw", "average") and last == "scales":
            wanted = f"below {LARGEST_LOG}"
        if last == "exp_avg_sq":
            fits, wanted = fits & (tensor >= 0), "finite and not negative"
        bad = int((~fits).flatten(1).any(1).sum()) if tensor.dim() > 1 else int((~fits).sum())
        _require(bad == 0, name, f"NaN, infinite or out of range in {bad:,} of {len(tensor):,} rows", wanted)


def _tensors(state: Dict[str, Any], names: Sequence[str]) -> Iterator[Tuple[str, torch.Tensor]]:
    """The tensors below these names, by their paths."""
    for name in names:
        value = state[name]
        if isinstance(value, torch.Tensor):
            yield name, value
        elif isinstance(value, dict):
            for path, tensor in _tensors(value, list(value)):
                yield f"{name}/{path}", tensor


def _require(holds: bool, name: str, value: Any, wanted: str) -> None:
    if not holds:
        text = str(value)
        raise Misfit(f"its `{name}` is {text if len(text) < 60 else text[:57] + '...'}; it must be {wanted}")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _check_tensor(name: str, value: Any, shape: Sequence[int], dtype: torch.dtype = torch.float32) -> None:
    _require(isinstance(value, torch.Tensor), name, type(value).__name__, "a tensor")
    fits = tuple(value.shape) == tuple(shape) and value.dtype == dtype and value.layout == torch.strided
    found = f"{list(value.shape)} {value.dtype} {value.layout}"
    _require(fits, name, found, f"{list(shape)} {dtype} {torch.strided}")
    _require(value.is_contiguous(), name, f"a view of strides {list(value.stride())}", "contiguous")


def _check_adam(name: str, state: Dict[str, Any], shape: Sequence[int]) -> None:
    _require(set(state) == {"step", *MOMENTS}, name, sorted(state), f"step, {', '.join(MOMENTS)}")
    _require(_is_whole(state["step"]) and 0 <= state["step"] <= MOST_STEPS, f"{name}/step", state["step"],
             "a whole number")
    for moment in MOMENTS:
        _check_tensor(f"{name}/{moment}", state[moment], shape)
