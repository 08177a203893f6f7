"""What a suite file may say, as a JSON schema; semantics are checked in suite.py, the meaning is in README.md."""
from __future__ import annotations

from dataclasses import fields
from typing import Any, Dict

from ..settings import BLEND_MODES
from ..trainer.config import LEARNED, PRINCIPAL_POINTS, SCHEDULES, TrainConfig
from .lpips import LPIPS_KINDS
from .methods.names import CHECKOUTS, NATIVE, VARIANTS
from .protocol import RECIPE


def _list(item: Dict[str, Any], least: int = 1) -> Dict[str, Any]:
    return {"type": "array", "items": item, "minItems": least, "uniqueItems": item.get("type") != "object"}


def _object(required: tuple, **properties: Any) -> Dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(required), "additionalProperties": False}


TEXT = {"type": "string", "minLength": 1}
# Becomes a part of file names. \Z: in Python $ is in front of a last newline too.
NAME = {"type": "string", "pattern": "^[A-Za-z0-9][A-Za-z0-9_+-]*\\Z", "maxLength": 64}
FLAG = {"type": "boolean"}
COUNT = {"type": "integer", "minimum": 0}
POSITIVE = {"type": "integer", "minimum": 1}
THRESHOLD = {"type": "number", "exclusiveMinimum": 0, "maximum": 1e6}  # its digits are a part of file names
AXES = {
    "blend_modes": _list({"enum": list(BLEND_MODES)}),
    "background_gates": _list({"type": ["number", "string"], "minimum": 0, "pattern": f"^{LEARNED}\\Z"}),
    "densify_grad_thresholds": _list(THRESHOLD),
    "schedules": _list({"enum": list(SCHEDULES)}),
    "seeds": _list({"type": "integer", "minimum": 0, "maximum": 2**32 - 1}),
}
TYPES = {"int": "integer", "float": "number", "bool": "boolean"}
OPTIONS = _object((), **{option.name: {"type": TYPES[str(option.type)]} for option in fields(TrainConfig)
                         if option.name in RECIPE})
PROTOCOL = _object(
    (), iterations=POSITIVE, device={"enum": ["cpu", "cuda"]}, background={"enum": ["black", "white"]},
    principal_point={"enum": list(PRINCIPAL_POINTS)}, lpips=_list({"enum": list(LPIPS_KINDS)}, 0),
    evaluate_every=COUNT, checkpoint_every=COUNT, scale_recipe=FLAG, options=OPTIONS)
SCENE = _object(
    ("name",), name=NAME, path=TEXT, dataset=TEXT, images=TEXT,
    resolution={"type": "integer", "anyOf": [{"const": -1}, {"minimum": 1}]},
    background={"enum": ["black", "white"]}, init_points=COUNT,
    synthetic=_object((), views=POSITIVE, width=POSITIVE, height=POSITIVE, points=POSITIVE, supersampling=POSITIVE,
                      seed=COUNT), **AXES)
METHOD = _object(
    ("name",), name={"enum": [NATIVE, *CHECKOUTS]}, label=NAME, variant={"enum": list(VARIANTS)}, path=TEXT, base=TEXT,
    commit=TEXT, base_commit=TEXT, python=TEXT, pythonpath=_list(TEXT, 0),
    arguments={"type": "array", "items": {"type": ["string", "number"]}}, end={"enum": ["sparse", "dense"]},
    budget=POSITIVE, **AXES)
SUITE = _object(
    ("name", "scenes", "methods"), name=NAME, protocol=PROTOCOL, scenes=_list(SCENE), methods=_list(METHOD),
    images=COUNT, keep_models=FLAG, headline=_object((), **AXES),
    headline_seeds=AXES["seeds"], **AXES)
