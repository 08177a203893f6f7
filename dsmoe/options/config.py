"""Every option of a training run in one dataclass, its checks and its file OUT/config.json."""
from __future__ import annotations

import dataclasses
import glob
import json
import os
from dataclasses import dataclass, field
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Union

from diff_smoe_rasterization.settings import (
    BACKGROUND_GATE_VARIABLE,
    BLEND_MODES,
    GATED_MODES,
    LEARNED,
    MAX_BACKGROUND_GATE,
    resolve_background_gate,
    resolve_blend_mode,
    resolve_faint_below,
    usual_faint_below,
)

from ..errors import ConfigError
from ..system.files import is_file, is_folder, write_text_atomically
from ..system.process import typed
from .choices import DEVICES, LENSES, MODEL
from .importance_options import ImportanceOptions, parse_importance_options

CONFIG_NAME = "config.json"
CHECKPOINT_NAME = "checkpoint.pt"  # beside it
STRATEGY_NAMES = ("3dgs", "steady", "importance", "mcmc")
IMAGES = "images"  # folder of a COLMAP scene
PRINCIPAL_POINTS = ("scene", "centre")
KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}  # what an option must be
LARGEST = 2**53  # of whole numbers, up to which floats hold each
# Options without which a model is not rendered as it was trained.
OF_IMAGES = ("scene", "blend_mode", "background_gate", "antialiasing", "white_background", "resolution", "images",
             "principal_point", "test_every", "iterations", "sh_degree", "seed")
# Options of the recipe; every row names densify_grad_threshold, and all of strategy_options, besides.
RECIPE = ("sh_degree", "sh_degree_interval", "antialiasing", "lambda_dssim", "position_lr_init", "position_lr_final",
          "position_lr_max_steps", "feature_lr", "opacity_lr", "scaling_lr", "rotation_lr", "percent_dense",
          "densify_from_iter", "densify_until_iter", "densification_interval", "opacity_reset_interval")


def _option(default: Any, text: str, **extra: Any) -> Any:
    """A dataclass field whose metadata is what argparse needs to offer it."""
    return field(default=default, metadata={"help": text, **extra})


def _varied(text: str, usual: float, **others: float) -> Any:
    """A field that some strategies or blend modes, by name, set otherwise: None until `__post_init__` knows them."""
    said = "; ".join([f"default: {usual:g}", *(f"{name}: {value:g}" for name, value in others.items())])
    return _option(None, f"{text} ({said})", usual=usual, others=others)


class GateOptions(NamedTuple):
    """How a training comes by the background's gate."""

    gate: Union[float, str]  # a number, or LEARNED: then
    bound: float  # it stays above this
    start: float  # and begins with this;
    rate: float  # Adam steps the logarithm of what it has above its bound


@dataclass
class TrainConfig:
    """Options of one training run; defaults are those of 3D Gaussian Splatting (the 2023 release).

    The command `dsmoe train` has another default: the strategy importance (`config_arguments.py`).

    Raises ConfigError from `validate` with the option's name, its value and what it must be.
    """

    scene: str = _option("", "folder of a scene: COLMAP, transforms.json or NeRF-synthetic", positional=True)
    output: str = _option("", "folder to write", flags=("-o", "--output"), required=True)
    blend_mode: Optional[str] = _option(
        None, "how Gaussians make a pixel (default: $DSMOE_BLEND_MODE, else alpha)", choices=BLEND_MODES)
    background_gate: Union[float, str, None] = _option(
        None, "smoe, smoe_eq7: how much the background weighs against the Gaussians: 0 is the paper's rule, 1 about "
              f"alpha blending, `{LEARNED}` finds it with the scene (default: $DSMOE_BACKGROUND_GATE, else {LEARNED})",
        metavar=f"X|{LEARNED}")
    background_gate_bound: float = _varied("a learned background gate stays above this", 0.03, smoe=0.0)
    background_gate_start: float = _varied("a learned background gate starts with this", 1.0, smoe=0.1)
    background_gate_lr: float = _varied(
        "learning rate of the logarithm of what a learned background gate has above its bound", 0.01, smoe=0.03)
    faint_below: Optional[float] = _option(
        None, "smoe, smoe_eq7: where near pairs have a gate sum below this, faint pairs and tails count too; 2: "
              "everywhere, as in the program of the paper's authors (default: $DSMOE_FAINT_BELOW, else 0.25 in smoe, 2 "
              "in smoe_eq7)")
    iterations: int = _option(
        30_000, "views to train on, a view each step; with --batch B, B each step. importance takes fewer for few "
                "photographs, unless the budget is below the number that it would choose or above what they reach")
    batch: int = _option(
        1, "views a step, whose gradients add up; learning rates are those of one view times the square root")
    resolution: int = _option(
        -1, "1, 2, 4, 8: divide the image size by it; -1: cap the width at 1600; else the width in pixels")
    images: str = _option(IMAGES, "image folder inside a COLMAP scene")
    strict: bool = _option(False, "an image that the scene names and has not is an error; else it is left out")
    principal_point: str = _option(
        "scene", "scene: as calibrated; centre: moved to the image centre, as Inria's loader does",
        choices=PRINCIPAL_POINTS)
    lenses: str = _option(
        LENSES[0], "undistort: images of distorted lenses and fisheyes become those of a pinhole, by OpenCV; native: "
                   "they stay, and Gaussians are projected through the lens; auto: native where undistortion would cut "
                   "off more than a tenth of an image", choices=LENSES)
    test_every: int = _option(
        8, "every so many images, sorted by name, one is kept for testing, the first among them; 0: none. A scene that "
           "lists its test images itself keeps those")
    white_background: bool = _option(False, "white background instead of black")
    random_background: bool = _option(
        False, "each step's image with transparency lies over a colour of its own; measured over black or white")
    init_points: int = _option(
        0, "start from a random subset of this many points (NeRF-synthetic without points: this many random points); "
           "0: all points, respectively 100,000")
    init: str = _option(
        "", f"start from the Gaussians of a model, in place of the scene's points: {MODEL}. --blend-mode is then the "
            "model's by default", metavar="MODEL")
    budget: int = _option(
        0, "the number of Gaussians to end with, or with 3dgs and steady not to exceed (default: importance chooses it "
           "for the scene)")
    strategy: Optional[str] = _option(
        None, "how Gaussians are added and removed. 3dgs: the original densification; steady: no opacity reset and no "
              "size prune; importance: grow beyond the budget, remove what changes the images least, move the rest to "
              "where the error is; mcmc: relocation and noise (default: importance)",
        choices=STRATEGY_NAMES)
    strategy_options: str = _option("", "settings of `importance`: NAME=X,...", metavar="NAME=X,...")
    seed: int = _option(0, "seed of every random choice")
    device: str = _option("cpu", "where to train; auto: $DSMOE_DEVICE, else the GPU if it can be used",
                          choices=DEVICES[1:], typed_choices=DEVICES, typed_default=DEVICES[0])
    sh_degree: int = _option(3, "highest spherical-harmonics degree, 0 to 3")
    sh_degree_interval: int = _option(1000, "steps between two increments of the active degree")
    antialiasing: bool = _option(False, "compensate opacity for the 0.3 px low-pass")
    deterministic: bool = _option(
        False, "cuda: gradients of a step, and the scores of `importance`, equal bit for bit from run to run, and for "
               "any number of GPUs; slower")

    lambda_dssim: float = _option(0.2, "weight of D-SSIM; 1 minus it weighs L1")
    position_lr_init: float = _varied(
        "first learning rate of positions, times the scene extent", 0.00016, importance=0.00064)
    position_lr_final: float = _varied(
        "last learning rate of positions, times the scene extent", 0.0000016, importance=0.0000064)
    position_lr_max_steps: int = _option(30_000, "step at which the last position learning rate is reached")
    feature_lr: float = _varied(
        "learning rate of base colours; higher SH bands take a 20th of it, with importance a tenth", 0.0025,
        importance=0.005)
    opacity_lr: float = _option(0.05, "learning rate of opacity logits")
    scaling_lr: float = _varied("learning rate of log scales", 0.005, importance=0.01)
    rotation_lr: float = _option(0.001, "learning rate of quaternions")

    densify_grad_threshold: float = _option(
        0.0002, "mean screen-space gradient (NDC units) from which a Gaussian is cloned or split")
    percent_dense: float = _option(
        0.01, "largest scale, as a part of the scene extent, that is cloned; larger ones are split")
    densify_from_iter: int = _option(500, "densification starts after this step")
    densify_until_iter: int = _option(
        15_000, "densification stops before this step; all milestones of importance are parts of it")
    densification_interval: int = _option(100, "steps between two densifications")
    opacity_reset_interval: int = _option(3000, "steps between two opacity resets")

    eval_every: int = _option(0, "evaluate the test views every so many steps; 0: only at the end")
    checkpoint_every: int = _option(1000, "write a checkpoint every so many steps; 0: only at the end")

    def __post_init__(self) -> None:
        try:
            self.blend_mode = resolve_blend_mode(self.blend_mode)
            self.background_gate = _training_gate(self.blend_mode, self.background_gate)
            self.faint_below = _training_faint(self.blend_mode, self.faint_below)
            if self.strategy is None:
                self.strategy = "importance" if self.budget else "3dgs"
            for name, value in {**_recipe_of(self.strategy), **learned_gate_of(self.blend_mode)}.items():
                if getattr(self, name) is None:
                    setattr(self, name, value)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    def validate(self) -> TrainConfig:
        """Checks every option that needs no file; returns self."""
        for option in dataclasses.fields(self):
            value, choices = getattr(self, option.name), option.metadata.get("choices")
            kind = type(option.metadata.get("usual", option.default))
            fits = isinstance(value, (int, float) if kind is float else kind)
            if kind in KINDS and (not fits or isinstance(value, bool) != (kind is bool)):
                raise ConfigError(f"{_flag(option)} is {value!r}; it must be {KINDS[kind]}")
            if isinstance(value, int) and abs(value) > LARGEST:
                raise ConfigError(f"{_flag(option)} is {value}; it must be at most 2^53")
            if choices and value not in choices:
                raise ConfigError(f"{_flag(option)} is {value!r}; it must be one of {', '.join(choices)}")
        self._require("iterations", self.iterations >= 1, "at least 1")
        self._require("batch", self.batch >= 1, "at least 1")
        self._require("iterations", self.iterations % self.batch == 0, f"a multiple of --batch, {self.batch}")
        self._require("resolution", self.resolution == -1 or self.resolution >= 1, "-1 or at least 1")
        self._require("test_every", self.test_every == 0 or self.test_every >= 2, "0 or at least 2")
        self._require("init_points", self.init_points == 0 or self.init_points >= 4, "0 or at least 4")
        self._require("init_points", self.init_points == 0 or not self.init, "left out with --init")
        self._require("budget", self.budget >= 0, "at least 0")
        if self.strategy in ("importance", "mcmc"):
            if self.budget == 0:
                raise ConfigError(f"--strategy {self.strategy} needs --budget, the number of Gaussians to end with: "
                                  "for example --budget 30000")
            self._require("budget", self.budget >= 4, f"at least 4 with --strategy {self.strategy}")
        if self.strategy == "importance":
            self.importance_options()
            self._require("densify_until_iter", self.densify_until_iter >= 2, "at least 2 with --strategy importance; "
                          "left out it is half of --iterations")
            self._require("iterations", self.iterations >= self.densify_until_iter, "at least --densify-until-iter, "
                          f"{self.densify_until_iter}, with --strategy importance, whose removals end there")
        self._require("strategy_options", not self.strategy_options or self.strategy == "importance",
                      f"left out with --strategy {self.strategy}: only importance has some")
        self._require("sh_degree", 0 <= self.sh_degree <= 3, "0, 1, 2 or 3")
        self._require("lambda_dssim", 0.0 <= self.lambda_dssim <= 1.0, "between 0 and 1")
        self._require("background_gate_bound", 0.0 <= self.background_gate_bound < 1.0, "at least 0 and below 1")
        self._require("background_gate_start",
                      self.background_gate_bound < self.background_gate_start <= MAX_BACKGROUND_GATE,
                      f"above --background-gate-bound, {self.background_gate_bound}, and at most "
                      f"{MAX_BACKGROUND_GATE:g}")
        self._require("seed", 0 <= self.seed < 2**32, "between 0 and 2^32 - 1")
        for name in ("sh_degree_interval", "position_lr_max_steps", "densification_interval", "opacity_reset_interval"):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        for name in ("position_lr_init", "position_lr_final", "feature_lr", "opacity_lr", "scaling_lr", "rotation_lr",
                     "densify_grad_threshold", "percent_dense", "background_gate_lr"):
            self._require(name, 0.0 < getattr(self, name) < float("inf"), "a positive number")
        for name in ("densify_from_iter", "densify_until_iter", "eval_every", "checkpoint_every"):
            self._require(name, getattr(self, name) >= 0, "at least 0")
        return self

    @property
    def gate(self) -> GateOptions:
        """What a training needs of the background's gate."""
        assert self.background_gate is not None, "__post_init__ sets it"
        return GateOptions(self.background_gate, self.background_gate_bound, self.background_gate_start,
                           self.background_gate_lr)

    def importance_options(self) -> ImportanceOptions:
        """The settings of the strategy `importance`. Raises ConfigError."""
        return parse_importance_options(self.strategy_options)

    @property
    def most_points(self) -> int:
        """How many points to start from at most, 0: any number. Only `importance` starts from more than the budget."""
        return 0 if self.strategy == "importance" else self.budget

    def _require(self, name: str, holds: bool, requirement: str) -> None:
        if not holds:
            flag = "--" + name.replace("_", "-")
            raise ConfigError(f"{flag} is {getattr(self, name)!r}; it must be {requirement}")

    def changed(self, **options: Any) -> TrainConfig:
        """A validated copy with some options set.

        Another blend mode brings its default gate and `faint_below`, and its defaults of learning one in place of the
        old mode's. Another strategy brings its defaults of the recipe in place of the old one's, and drops the old
        one's own options.
        """
        return self._changed(options).validate()

    @property
    def unusual_faint(self) -> Optional[float]:
        """`faint_below`, None if it is as usual in this blend mode."""
        return None if self.faint_below == usual_faint_below(str(self.blend_mode)) else self.faint_below

    def _changed(self, options: Dict[str, Any]) -> TrainConfig:
        if options.get("blend_mode", self.blend_mode) != self.blend_mode:
            usual = learned_gate_of(str(self.blend_mode))
            options = {"background_gate": None, "faint_below": None, **self._unset(usual), **options}
        if options.get("strategy", self.strategy) != self.strategy:
            usual = _recipe_of(str(self.strategy))
            options = {**self._unset(usual), "strategy_options": "", **options}
        return dataclasses.replace(self, **options)

    def _unset(self, usual: Dict[str, Any]) -> Dict[str, None]:
        """None for each option that is as usual."""
        return {name: None for name in usual if getattr(self, name) == usual[name]}

    def unusual_recipe(self) -> Dict[str, Any]:
        """What of the recipe differs from the strategy's defaults."""
        usual = {**{option.name: option.default for option in dataclasses.fields(self)},
                 **_recipe_of(str(self.strategy))}
        return {name: getattr(self, name) for name in RECIPE if getattr(self, name) != usual[name]}

    def notes(self) -> List[str]:
        """What may surprise in a run with these options, in a line each."""
        notes = []
        if self.iterations <= self.densify_from_iter < self.densify_until_iter:
            notes.append(f"--iterations {self.iterations} adds no Gaussians: that begins after step "
                         f"{self.densify_from_iter}; --scale-recipe squeezes the schedule into so few")
        if self.strategy == "importance" and 4 * self.densify_until_iter >= 3 * self.iterations:
            notes.append(f"--densify-until-iter {self.densify_until_iter} leaves no iterations to settle; below three "
                         "quarters of --iterations it does; left out it is half of them")
        return notes

    def shortened(self) -> TrainConfig:
        """The same schedule squeezed into `iterations` steps: each milestone keeps its share of the 30,000 of 3DGS.

        The densification interval stays, as far as ten densifications fit. What is not at its default is kept.
        """
        default = TrainConfig(blend_mode=self.blend_mode, strategy=self.strategy)
        share = self.iterations / default.iterations
        milestones = {name: max(1, round(getattr(default, name) * share)) for name in (
            "position_lr_max_steps", "sh_degree_interval", "densify_from_iter", "densify_until_iter",
            "opacity_reset_interval")}
        if self.strategy == "importance":
            milestones["densify_until_iter"] = max(2, milestones["densify_until_iter"])
        fitting = max(1, milestones["densify_until_iter"] // 10)
        milestones["densification_interval"] = min(default.densification_interval, fitting)
        return dataclasses.replace(self, **{name: value for name, value in milestones.items()
                                            if getattr(self, name) == getattr(default, name)})

    def save(self, folder: str) -> None:
        """Writes OUT/config.json, with absolute paths of the scene and of the model to start from."""
        paths = {name: os.path.abspath(path) for name, path in (("scene", self.scene), ("init", self.init)) if path}
        text = json.dumps({**self.record(), **paths}, indent=2) + "\n"
        write_text_atomically(os.path.join(folder, CONFIG_NAME), text)

    def record(self) -> Dict[str, Any]:
        """The options as files hold them."""
        return dataclasses.asdict(self)

    @classmethod
    def of_record(cls, values: Dict[str, Any], continues: bool = True) -> TrainConfig:
        """The options that `record` gave. Raises ValueError if one is missing: a default would be another run.

        continues: False if the run is only looked at. Then those may be missing that say nothing of its images: another
        version wrote the record.
        """
        needed = {option.name for option in dataclasses.fields(cls)} if continues else {*OF_IMAGES}
        missing = sorted(needed - {*values})
        if missing:
            raise ValueError(f"the option {', '.join(missing)} is missing")
        if values["blend_mode"] in GATED_MODES and values.get("faint_below") is None:
            # $DSMOE_FAINT_BELOW is of new runs.
            values = {**values, "faint_below": usual_faint_below(values["blend_mode"])}
        return cls(**values)

    @classmethod
    def load(cls, folder: str, continues: bool = False) -> TrainConfig:
        """Reads OUT/config.json. Raises ConfigError if the file is absent or wrong, naming file and reason.

        continues: whether the run is to go on, which another version cannot do.
        """
        path = os.path.join(folder, CONFIG_NAME)
        if not is_folder(folder):
            raise ConfigError(f"{folder}: no such folder; name the output folder of `dsmoe train`")
        if not holds_run(folder):
            raise ConfigError(f"{folder} holds no {CONFIG_NAME}: it is not the output folder of `dsmoe train`"
                              + runs_below(folder))
        try:
            with open(path, encoding="utf-8") as file:
                values = json.load(file)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"{path}: not valid json ({error})") from error
        if not isinstance(values, dict):
            raise ConfigError(f"{path}: expected a json object of options")
        known = {option.name for option in dataclasses.fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise ConfigError(f"{path}: unknown option {', '.join(unknown)} (written by another version?)")
        # Rendering must use the mode of the training, so an absent mode is never replaced by a default.
        if values.get("blend_mode") not in BLEND_MODES:
            raise ConfigError(f"{path}: blend_mode is {values.get('blend_mode')!r}; "
                             f"it must be one of {', '.join(BLEND_MODES)}")
        values["output"] = folder  # the folder may have been moved
        try:
            return cls.of_record(values, continues).validate()
        except (TypeError, ValueError, OverflowError, ConfigError) as error:
            raise ConfigError(f"{path}: {error}") from error

    @classmethod
    def of_run(cls, folder: str, scene_option: str, resumes: bool = False, **options: Any) -> TrainConfig:
        """The options of the run in a folder with some set. Raises ConfigError, also if its scene is not there.

        scene_option: what says where the scene lies now, for that error. resumes: whether that run goes on with them.
        """
        earlier = cls.load(folder, continues=resumes)
        config = earlier._changed(options)
        if resumes:
            earlier.check_continued_by(config)
        config.validate()
        if "scene" not in options and not is_folder(config.scene):
            here = "" if os.path.isabs(config.scene) else " here, and the path is relative to where it was trained"
            raise ConfigError(f"scene {config.scene}, on which {folder} was trained: no such folder{here}; "
                              f"name with {scene_option} where it lies now")
        return config

    def differences(self, later: TrainConfig) -> List[str]:
        """Options that keep `later` from continuing this run, one text each; more iterations do not."""
        # These alter when something is written or where, never the trained Gaussians.
        harmless = {"scene", "init", "output", "strict", "eval_every", "checkpoint_every"}
        if later.iterations > self.iterations:
            harmless.add("iterations")
        if self.blend_mode != later.blend_mode:  # what follows from that needs no text of its own
            before, after = learned_gate_of(self.blend_mode), learned_gate_of(later.blend_mode)
            harmless |= {name for name in before
                         if getattr(self, name) == before[name] and getattr(later, name) == after[name]}
            if self.unusual_faint is None and later.unusual_faint is None:
                harmless.add("faint_below")
        texts = []
        for option in dataclasses.fields(self):
            mine, theirs = getattr(self, option.name), getattr(later, option.name)
            if option.name not in harmless and mine != theirs:
                texts.append(f"{_flag(option)} is {mine!r}, not {theirs!r}")
        return texts

    def check_continued_by(self, later: TrainConfig) -> None:
        """Raises ConfigError if `later` cannot continue this run. Comes before `validate`, which knows no run."""
        differences = self.differences(later)
        if differences:
            raise ConfigError(f"{self.output} holds a run with other options: {'; '.join(differences)}. `dsmoe train "
                              f"--resume -o {typed(self.output)}` keeps the run's options; more --iterations "
                              "extend it")


def _recipe_of(strategy: str) -> Dict[str, Any]:
    """What a strategy sets of the options of the recipe in which strategies differ."""
    return _set_by(STRATEGY_NAMES, strategy)


def learned_gate_of(blend_mode: str) -> Dict[str, float]:
    """How a background gate is learned by default: the options in which blend modes differ."""
    return _set_by(BLEND_MODES, blend_mode)


def _set_by(names: Sequence[str], chosen: Any) -> Dict[str, Any]:
    """The defaults, for the chosen one, of the options that some of these names set otherwise.

    chosen: as a file has it, so perhaps none of the names.
    """
    varied = {option.name: option.metadata for option in dataclasses.fields(TrainConfig)
              if not set(names).isdisjoint(option.metadata.get("others", ()))}
    return {option: next((value for name, value in about["others"].items() if name == chosen), about["usual"])
            for option, about in varied.items()}


def holds_run(folder: str) -> bool:
    """Whether OUT/config.json is there. Raises TrainerError if that cannot be seen."""
    return is_file(os.path.join(folder, CONFIG_NAME))


def runs_below(folder: str) -> str:
    """What an error says of runs in the folder, where one was looked for."""
    runs = sorted(map(os.path.dirname, glob.glob(os.path.join(glob.escape(folder), "*", CONFIG_NAME))))
    return f"; such are {', '.join(runs[:3])}" if runs else ""


def _training_gate(blend_mode: str, asked: Union[float, str, None]) -> Union[float, str]:
    """The background gate that a training takes: a number, 1 in `alpha` and 0 in the ablations, or LEARNED.

    asked: None means in GATED_MODES $DSMOE_BACKGROUND_GATE, else LEARNED. Raises ValueError for a value that is no
    gate, and for one that the mode does not know.
    """
    if blend_mode not in GATED_MODES:
        fixed = float(resolve_background_gate(blend_mode, None))
        return fixed if asked in (None, fixed) else float(resolve_background_gate(blend_mode, asked))
    if (os.environ.get(BACKGROUND_GATE_VARIABLE) or LEARNED if asked is None else asked) == LEARNED:
        return LEARNED
    return float(resolve_background_gate(blend_mode, asked))


def _training_faint(blend_mode: str, asked: Optional[float]) -> Optional[float]:
    """The `faint_below` that a training takes and records; None in modes that know none. Raises ValueError."""
    if blend_mode not in GATED_MODES:
        if asked is not None:
            raise ValueError(f"--faint-below is {asked!r}, but the blend mode is {blend_mode}; only "
                             f"{' and '.join(GATED_MODES)} know it")
        return None
    return resolve_faint_below(blend_mode, asked)


def flags_of(option: dataclasses.Field[Any]) -> Sequence[str]:
    """How an option is typed; texts have the first of these."""
    return option.metadata.get("flags", ("--" + option.name.replace("_", "-"),))


def _flag(option: dataclasses.Field[Any]) -> str:
    return flags_of(option)[0]


def flags_text(options: Dict[str, Any]) -> str:
    """What to type for options by name."""
    known = {option.name: option for option in dataclasses.fields(TrainConfig)}
    return " ".join(f"{_flag(known[name])} {value}" for name, value in options.items())
