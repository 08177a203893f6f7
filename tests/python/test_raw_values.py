"""Logits, logarithms and raw quaternions where values are expected: they render, wrongly, and a warning names them."""
from __future__ import annotations

import warnings

import pytest
import torch
from scenes import random_scene

from diff_smoe_rasterization import GaussianRasterizer, rasterize, rasterize_with_splats, raw_values
from diff_smoe_rasterization.direct import DirectRendering
from diff_smoe_rasterization.rasterizer import visible_radii

pytestmark = pytest.mark.usefixtures("device")
RAW = {"opacities": (torch.logit, "opacities are negative, as logits are; opacities are torch.sigmoid"),
       "scales": (torch.log, "scales are negative, as logarithms are; scales are torch.exp"),
       "rotations": (lambda rows: 3 * rows, "rotations are of another length than 1, and are used as given; torch.nn")}


@pytest.fixture(autouse=True)
def a_process_of_its_own(monkeypatch):
    monkeypatch.setattr(raw_values, "_looked", set())
    monkeypatch.setattr(raw_values, "_said", set())


def scene(*raw, **fields):
    made = random_scene("alpha", 20, 16, 16, dtype=torch.float32).with_settings(**fields)
    made = made.with_inputs(rotations=torch.nn.functional.normalize(made.inputs["rotations"]),
                            opacities=made.inputs["opacities"].clamp(0.01, 0.4))
    return made.with_inputs(**{name: RAW[name][0](made.inputs[name]) for name in raw})


def warned(call, made):
    """What the warnings of a call say."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call(made)
    return [str(one.message) for one in caught]


def module(made):
    return GaussianRasterizer(made.settings)(**made.inputs)


def radii(made):
    return visible_radii(made.inputs["means3D"], made.settings, made.inputs["scales"], made.inputs["rotations"])


CALLS = {"rasterize": lambda made: rasterize(settings=made.settings, **made.inputs),
         "rasterize_with_splats": lambda made: rasterize_with_splats(settings=made.settings, **made.inputs),
         "DirectRendering": lambda made: DirectRendering(settings=made.settings, **made.inputs),
         "visible_radii": radii}


@pytest.mark.parametrize("function", CALLS)
@pytest.mark.parametrize("name", RAW)
def test_the_first_call_of_a_function_names_raw_values(name, function):
    assert warned(CALLS[function], scene()) == []
    raw_values._looked.clear()
    said = warned(CALLS[function], scene(name))
    if function == "visible_radii" and name == "opacities":  # which are none of its arguments
        assert said == []
        return
    assert len(said) == 1 and RAW[name][1] in said[0] and said[0].startswith(f"{function}: ")
    assert warned(CALLS[function], scene(name)) == []


def test_under_debug_each_call_looks_and_each_argument_is_named_once():
    assert warned(module, scene()) == []
    assert warned(module, scene(*RAW)) == []  # no first call, no debug
    assert len(warned(module, scene("scales", debug=True))) == 1
    assert len(warned(module, scene(*RAW, debug=True))) == 2
    assert warned(module, scene(*RAW, debug=True)) == []


def test_a_warning_counts_the_gaussians():
    """One of several; and neither what is not finite nor what rounding or half precision leaves of a length of 1."""
    made = scene(debug=True)
    rotations = torch.nn.functional.normalize(made.inputs["rotations"]).half().float()
    scales = made.inputs["scales"].clone()
    scales[2, 1] = scales[5, 0] = -0.1
    scales[7] = -torch.inf
    said = warned(module, made.with_inputs(rotations=rotations, scales=scales))
    assert [text.partition(" are ")[0] for text in said] == ["rasterize: 2 of 20 scales"]


@pytest.mark.parametrize("name, tensor", [
    ("opacities", torch.zeros(0)), ("opacities", torch.tensor(-1.0)), ("opacities", -torch.ones(20, 1).int()),
    ("scales", -torch.ones(20, 3, dtype=torch.complex64)), ("rotations", torch.zeros(20, 0))])
def test_what_the_op_refuses_is_refused_by_it(name, tensor):
    made = scene()
    with pytest.raises((ValueError, TypeError), match=name):
        module(made.with_inputs(**{name: tensor.to(made.inputs[name].device)}))


def test_a_graph_that_is_captured_is_left_alone():
    """Reading a value would end it."""
    made = scene(*RAW)
    if made.inputs["scales"].device.type == "cpu":
        pytest.skip("only a GPU has graphs")
    warned(CALLS["DirectRendering"], made)
    raw_values._said.clear()
    raw_values._looked.clear()
    with torch.cuda.graph(torch.cuda.CUDAGraph()):
        assert warned(CALLS["DirectRendering"], made) == []
