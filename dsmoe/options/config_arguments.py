"""The options of TrainConfig on a command line: how they are offered, and the config that was typed."""
from __future__ import annotations

import argparse
import contextlib
import dataclasses
from typing import TYPE_CHECKING, Any, Callable, Dict, Optional, Sequence, Tuple, Union

from diff_smoe_rasterization.settings import BACKGROUND_GATE_VARIABLE, GATED_MODES, PAPER, PAPER_PROGRAM

from ..errors import ConfigError
from .config import KINDS, LEARNED, TrainConfig, flags_of, learned_gate_of
from .presets import NUMBERS, PRESETS, STRATEGY, chosen_for_scene, iterations_for_scene, scheduled, with_preset

if TYPE_CHECKING:
    from ..scenes.layout import Layout

# How `--help` groups the options; those that no group names are of the last one.
GROUPS = {
    "scene": ("images", "strict", "resolution", "test_every", "principal_point", "lenses", "init_points",
              "white_background", "random_background"),
    "blending": ("blend_mode", "background_gate", "background_gate_bound", "faint_below", "antialiasing"),
    "length, and number of Gaussians": ("iterations", "batch", "init", "budget", "strategy", "strategy_options"),
    "run": ("device", "seed", "deterministic", "eval_every", "checkpoint_every"),
    "recipe": (),
}


def _typed(kind: Callable[[str], Any], text: str, requirement: str) -> Any:
    try:
        return kind(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"is {text!r}; it must be {requirement}") from error


def whole_number(text: str) -> int:
    """What was typed, as the type of an option. Raises ArgumentTypeError."""
    return _typed(int, text, KINDS[int])


def number(text: str) -> float:
    """What was typed, as the type of an option. Raises ArgumentTypeError."""
    return _typed(float, text, KINDS[float])


def file_name(text: str) -> str:
    """What was typed, the name of a file or folder. Raises ArgumentTypeError if it is empty, as of a variable unset."""
    if not text:
        raise argparse.ArgumentTypeError("is empty; name a file or folder")
    return text


def blend_mode(text: str) -> str:
    """What was typed. Raises ArgumentTypeError if it is the word that patched trainers have for --paper."""
    if text == PAPER:
        raise argparse.ArgumentTypeError(f"{PAPER} is no blend mode here; for the paper's program type --paper")
    return text


def _number_or_learned(text: str) -> Union[float, str]:
    return text if text == LEARNED else _typed(float, text, f"{KINDS[float]} or `{LEARNED}`")


_TYPES = {"int": whole_number, "float": number, "str": str, "Optional[str]": str, "Optional[float]": number,
          "Union[float, str, None]": _number_or_learned}
_TYPES_OF = {"blend_mode": blend_mode, "init": file_name}  # that the field's own type does not say


def add_arguments(parser: argparse.ArgumentParser, skip: Sequence[str] = (),
                  defaults: bool = True) -> Dict[str, argparse._ArgumentGroup]:
    """Offers every option of TrainConfig, but those named in `skip`, on an argparse parser; returns their groups.

    Options that are not given are absent from the parsed arguments. defaults: whether the help text names what they
    are then.
    """
    groups = {title: parser.add_argument_group(title) for title in GROUPS}
    titles = {name: title for title, names in GROUPS.items() for name in names}
    for option in dataclasses.fields(TrainConfig):
        if option.name in skip:
            continue
        text = option.metadata["help"].replace("%", "%%")
        if option.metadata.get("positional"):
            parser.add_argument(option.name, metavar=option.name.upper(), help=text)
            continue
        flags, group = flags_of(option), groups[titles.get(option.name, "recipe")]
        if option.type == "bool":
            group.add_argument(*flags, action="store_true", help=text, default=argparse.SUPPRESS)
            continue
        kind = _TYPES_OF.get(option.name) or _TYPES[str(option.type)]
        keywords: Dict[str, Any] = {"type": kind, "default": argparse.SUPPRESS}
        if option.metadata.get("required"):
            keywords["required"] = True
        elif option.default not in (None, "") and defaults:
            text += f" (default: {option.metadata.get('typed_default', option.default)})"
        if option.metadata.get("choices"):
            keywords["choices"] = option.metadata.get("typed_choices", option.metadata["choices"])
        else:
            letter = "N" if option.type == "int" else "X" if "float" in str(option.type) else "NAME"
            keywords["metavar"] = option.metadata.get("metavar", letter)
        group.add_argument(*flags, help=text, dest=option.name, **keywords)
    return groups


def is_same(given: Any, value: Any) -> bool:
    """Whether what was typed, a word or a number, is this value: `0` is 0.0."""
    with contextlib.suppress(TypeError, ValueError):
        return float(given) == value
    return str(given) == str(value)


def take_paper(arguments: argparse.Namespace) -> None:
    """Sets the options that --paper stands for, where it is given. Raises ConfigError if one of them is another."""
    for name, value in PAPER_PROGRAM.items() if getattr(arguments, "paper", False) else ():
        given = getattr(arguments, name, None)
        if given not in (None, value) and not is_same(given, value):
            raise ConfigError(f"--{name.replace('_', '-')} is {given!r}; with --paper it is {value!r}, or left out")
        setattr(arguments, name, value)


def given_options(arguments: argparse.Namespace) -> Dict[str, Any]:
    """The options of TrainConfig among parsed arguments."""
    names = {option.name for option in dataclasses.fields(TrainConfig)}
    return {name: value for name, value in vars(arguments).items() if name in names}


def config_from_arguments(arguments: argparse.Namespace, earlier: Optional[TrainConfig] = None
                          ) -> Tuple[TrainConfig, Optional[Layout]]:
    """Builds a validated TrainConfig from parsed arguments; options that are not given keep their defaults.

    Also returns the scene's layout, if it was read.

    With the strategy importance, the default, and with --scale-recipe the milestones that are not given keep their
    share of the iterations. importance also chooses by the scene (`presets.py`). earlier: the run that goes on with
    these options. Raises ConfigError, SceneError.
    """
    given = given_options(arguments)
    preset = next((name for name in PRESETS if getattr(arguments, name, False)), None)
    options = with_preset(given, preset, given.get("device", "cpu"))
    chooses, layout = options["strategy"] == STRATEGY, None
    if chooses and earlier:
        options = {"iterations": earlier.iterations, **options}
    shortens = chooses or getattr(arguments, "scale_recipe", False)
    config = scheduled(options) if shortens else TrainConfig(**options)
    if chooses and earlier:
        kept = {"budget", "init_points"} - {*given}
        config = dataclasses.replace(config, **{name: getattr(earlier, name) for name in kept})
    elif chooses:
        dataclasses.replace(config, budget=config.budget or NUMBERS[config.device].least).validate()  # before it reads
        from diff_smoe_rasterization.extension import BACKENDS  # noqa: F401  (says if nothing was built)

        from ..scenes.scene import read_layout

        layout = read_layout(config)
        config = scheduled({**options, "iterations": iterations_for_scene(options, layout)})
        config = dataclasses.replace(config, **chosen_for_scene(config, given, layout))
    if earlier:
        earlier.check_continued_by(config)
    _check_learned(config, given)
    return config.validate(), layout


def _check_learned(config: TrainConfig, given: Dict[str, Any]) -> None:
    """Raises ConfigError if it is given how the background gate is learned, and the gate is not learned."""
    useless = [option for option in dataclasses.fields(TrainConfig)
               if option.name in learned_gate_of(config.blend_mode) and option.name in given]
    if not useless or config.background_gate == LEARNED:
        return
    if config.blend_mode in GATED_MODES:
        asked = "--background-gate" if "background_gate" in given else "$" + BACKGROUND_GATE_VARIABLE
        why = f"{asked} fixes the background gate at {config.background_gate}; --background-gate {LEARNED} learns it"
    else:
        why = (f"in the blend mode {config.blend_mode} no background gate is learned; --blend-mode "
               f"{' or '.join(GATED_MODES)} learns one")
    raise ConfigError(f"{flags_of(useless[0])[0]} is given, but {why}")
