"""What a suite file may say, and what holds if it says nothing; expansion.py checks what goes together."""
from __future__ import annotations

import math
from dataclasses import fields
from typing import Any, Dict, List, Literal, Tuple, Type

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator
from typing_extensions import Annotated

from diff_smoe_rasterization.settings import BLEND_MODES, MAX_BACKGROUND_GATE, PAPER

from ..options.config import LEARNED, PRINCIPAL_POINTS, STRATEGY_NAMES, TrainConfig
from .errors import BenchError
from .names import CHECKOUTS, LPIPS_KINDS, NATIVE, RECIPE, VARIANTS

# The paper prints that its first of six thresholds is 0.005 and its fifth 0.0002.
THRESHOLDS = (0.005, 0.002, 0.001, 0.0005, 0.0002, 0.0001)


def must(holds: Any, words: str) -> AfterValidator:
    """Refuses values for which `holds` is false, in these words."""
    def check(value: Any) -> Any:
        if not holds(value):
            raise ValueError(words)
        return value
    return AfterValidator(check)


def one_of(names: Any) -> Any:
    return Literal[tuple(names)]  # type: ignore[misc]


def some(item: Any) -> Any:
    return Annotated[List[item], LEAST, DIFFERENT]


DIFFERENT = must(lambda values: all(value not in values[:index] for index, value in enumerate(values)),
                 "the same value must not be there twice")
LEAST = Field(min_length=1)
Text = Annotated[str, LEAST]
Name = Annotated[str, Field(pattern="^[A-Za-z0-9][A-Za-z0-9_+-]*$", max_length=64)]  # becomes a part of file names
Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Budget = Annotated[int, must(lambda value: value == 0 or value >= 4, "it must be 0, which is none, or at least 4")]
Threshold = Annotated[float, Field(gt=0, le=1e6)]  # its digits become a part of file names
Gate = Annotated[Any, must(lambda value: value == LEARNED or (type(value) in (int, float) and 0 <= value < math.inf),
                           f"it must be a number of at least 0, or {LEARNED!r}")]
Faint = Annotated[Any, must(lambda value: value is None or (
    type(value) in (int, float) and 0 <= value <= MAX_BACKGROUND_GATE), "it must be a number of at least 0, or null")]
Word = Annotated[Any, must(lambda value: type(value) in (str, int, float), "it must be text or a number")]
Resolution = Annotated[int, must(lambda value: value == -1 or value >= 1, "it must be -1 or at least 1")]
Background = Literal["black", "white"]


class Part(BaseModel):
    """A mapping of a suite file: values are of their types as they stand; what may be left out must not be null."""

    model_config = ConfigDict(strict=True)

    @model_validator(mode="before")
    @classmethod
    def knows_all_fields(cls, given: Any) -> Any:
        unknown = sorted(set(map(str, given)) - set(cls.model_fields)) if isinstance(given, dict) else []
        if unknown:
            raise ValueError(f"{unknown[0]!r} is not a field here; allowed are {', '.join(sorted(cls.model_fields))}")
        return given


class Axes(Part):
    """What a suite varies; the axes of a scene and of a method win."""

    blend_modes: some(one_of((*BLEND_MODES, PAPER))) = ["alpha", "smoe"]
    background_gates: some(Gate) = [0]
    faint_belows: some(Faint) = [None]
    densify_grad_thresholds: some(Threshold) = list(THRESHOLDS)
    strategies: some(one_of(STRATEGY_NAMES)) = ["3dgs"]
    budgets: some(Budget) = [0]
    seeds: some(Seed) = [0]


Options = create_model("Options", __base__=Part, **{
    option.name: ({"int": int, "float": float, "bool": bool, "str": str}[str(option.type)], None)
    for option in fields(TrainConfig) if option.name in RECIPE})


class Protocol(Part):
    iterations: Positive = 30_000
    batch: Positive = None  # views a step; this and gpus stand only if they are given, as in earlier rows
    gpus: Positive = None  # of each cell
    device: Literal["auto", "cpu", "cuda"] = "cuda"  # auto is resolved before the cells are made
    background: Background = "black"
    principal_point: one_of(PRINCIPAL_POINTS) = "centre"
    lpips: Annotated[List[one_of(LPIPS_KINDS)], DIFFERENT] = list(LPIPS_KINDS)
    evaluate_every: Count = 0
    checkpoint_every: Count = 1000
    scale_recipe: bool = False
    options: Options = {}


Synthetic = create_model("Synthetic", __base__=Part, seed=(Count, None), **dict.fromkeys(
    ("views", "width", "height", "points", "supersampling"), (Positive, None)))


Scene = create_model("Scene", __base__=Axes, name=(Name, ...), path=(Text, None), dataset=(Text, None),
                     images=(Text, "images"), resolution=(Resolution, -1), background=(Background, None),
                     init_points=(Count, 0), synthetic=(Synthetic, None))
Method = create_model(
    "Method", __base__=Axes, name=(one_of((NATIVE, *CHECKOUTS)), ...), variant=(one_of(VARIANTS), None),
    label=(Name, None), pythonpath=(List[Text], []), arguments=(List[Word], []), budget=(Positive, None),
    end=(one_of(("sparse", "dense")), None),
    **dict.fromkeys(("path", "base", "commit", "base_commit", "python"), (Text, None)))
SuiteFile = create_model(
    "SuiteFile", __base__=Axes, name=(Name, ...), protocol=(Protocol, None),
    scenes=(Annotated[List[Scene], LEAST], ...), methods=(Annotated[List[Method], LEAST], ...),
    images=(Count, 0), keep_models=(bool, False), headline=(Axes, None), headline_seeds=(some(Seed), []))


def check(content: Any) -> None:
    if content is None:
        raise BenchError("the file is empty")
    try:
        SuiteFile.model_validate(content)
    except ValidationError as error:
        where, what = first_mistake(error)
        raise BenchError(f"{where or 'the suite'}: {what}") from error


def first_mistake(error: ValidationError) -> Tuple[str, str]:
    """The place, such as scenes[0].name, and what is wrong there."""
    found = min(error.errors(), key=lambda one: list(map(str, one["loc"])))
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in found["loc"]).lstrip(".")
    kind, given, said = found["type"], found["input"], found["msg"]
    if kind == "missing" or " is not a field here" in said:
        return where, "is missing" if kind == "missing" else said.partition(", ")[2]
    words = said.partition(", ")[2] if kind == "value_error" else said.replace("Input should", "it must")
    what = f"is {given!r}; {words.partition(' or instance')[0]}"
    if kind == "list_type":
        what += f", such as [{given}]"
    return where, what


def defaults(part: Type[Part]) -> Dict[str, Any]:
    """The fields of a part that may be left out, with what holds then; its axes are not among them."""
    return {name: field.default for name, field in part.model_fields.items()
            if not field.is_required() and (part is Axes or name not in Axes.model_fields)}
