"""The gate that this process learns: when it steps, what it adds up, and the files that bring it back."""
from __future__ import annotations

import contextlib
import json
import math
import os
import re
import stat
import struct
import threading
import time
import warnings
from collections import Counter

import numpy as np
import pytest
import torch
from scenes import random_scene

from diff_smoe_rasterization import learned_gate, rasterize, settings
from diff_smoe_rasterization.integrations import inria, records
from diff_smoe_rasterization.learned_gate import RATE, START, gate

HAS_HOOKS = learned_gate._HAS_HOOKS


@pytest.fixture(autouse=True)
def a_gate_of_its_own(monkeypatch):
    monkeypatch.setattr(settings, "blend_of_process", None)
    records._models_read.clear()
    gate.reset()
    yield
    gate.reset()


def scene(**more):
    """Settings with the learned gate, over white, and the Gaussians of a trainer: parameters of an Adam."""
    made = random_scene("smoe", 24, 24, 12, degree=0, dtype=torch.float32)
    gaussians = {name: torch.nn.Parameter(tensor.detach().clone()) for name, tensor in made.inputs.items()}
    return made.settings._replace(background_gate="learned", bg=torch.ones(3), **more), gaussians


def image(view, gaussians, **changes):
    return rasterize(settings=view, **{**gaussians, **changes}).color


def loss(view, gaussians, **changes):
    return image(view, gaussians, **changes).square().mean()


def by_hand(gradients, value=START):
    """lambda after steps of Adam on its logarithm by these gradients by lambda, in float64, by the paper's formula."""
    p, m, v = math.log(value), 0.0, 0.0
    for step, gradient in enumerate(gradients, 1):
        gradient *= math.exp(p)
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient * gradient
        p -= RATE * m / (1 - 0.9**step) / (math.sqrt(v / (1 - 0.999**step)) + 1e-8)
    return math.exp(p)


def gradient_at(value, view, gaussians, renderings=1):
    fixed = torch.tensor([value], requires_grad=True)
    sum(loss(view._replace(background_gate=fixed), gaussians) for _ in range(renderings)).backward()
    for tensor in gaussians.values():
        tensor.grad = None
    return fixed.grad.item()


def assert_the_next_step_adds_up(view, gaussians, optimizer, slopes):
    """After steps by these gradients comes one by the gradient at the value that they led to."""
    slope = gradient_at(gate.value(), view, gaussians)
    loss(view, gaussians).backward()
    optimizer.step()
    assert gate.value() == pytest.approx(by_hand([*slopes, slope]), rel=1e-5)


def test_a_gate_steps_once_for_each_step_of_an_optimizer():
    """By Adam on the logarithm, from START; a rendering without gradient and a backward pass alone change nothing."""
    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    slope = gradient_at(START, view, gaussians)
    with torch.no_grad():
        first = image(view, gaussians)
        assert torch.equal(first, image(view._replace(background_gate=torch.tensor([gate.value()])), gaussians))
    loss(view, gaussians).backward()
    if HAS_HOOKS:
        assert gate.value() == pytest.approx(START, rel=1e-6)
    with torch.no_grad():
        image(view, gaussians)  # an evaluation between backward pass and step
    optimizer.step()
    once = by_hand([slope])
    assert gate.value() == pytest.approx(once, rel=1e-5) and once != START
    optimizer.step()  # nothing was rendered since
    with torch.no_grad():
        image(view, gaussians)
    optimizer.step()
    assert gate.value() == pytest.approx(once, rel=1e-5)
    optimizer.zero_grad()
    assert_the_next_step_adds_up(view, gaussians, optimizer, [slope])


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
@pytest.mark.parametrize("at_once", [True, False])
def test_several_renderings_before_a_step_add_up(at_once):
    """Of one loss, and of several backward passes."""
    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    other = view._replace(bg=torch.tensor([0.5, 1.0, 0.0]))
    slopes = [gradient_at(START, view, gaussians), gradient_at(START, other, gaussians)]
    losses = [loss(view, gaussians), loss(other, gaussians)]
    for one in [sum(losses)] if at_once else losses:
        one.backward()
    optimizer.step()
    loss(view, gaussians).backward()
    optimizer.step()  # of equal gradients Adam's first steps are equal: only the second one shows the sum
    after = by_hand([sum(slopes)])
    assert gate.value() == pytest.approx(by_hand([sum(slopes), gradient_at(after, view, gaussians)]), rel=1e-5)


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
@pytest.mark.parametrize("computed", [False, True])
def test_of_several_optimizers_that_of_the_centres_counts(computed):
    """If the centres are computed, as in Scaffold-GS, the first one that steps."""
    view, gaussians = scene()
    others = torch.optim.Adam([gaussians["opacities"]], lr=0)
    own = torch.optim.Adam([gaussians["means3D"]], lr=0)
    expected = []
    for _ in range(3):
        expected.append(gradient_at(gate.value(), view, gaussians))
        means3D = gaussians["means3D"] + 0 if computed else gaussians["means3D"]
        loss(view, gaussians, means3D=means3D).backward()
        before = gate.value()
        others.step()
        assert (gate.value() != before) == computed
        own.step()
        assert gate.value() == pytest.approx(by_hand(expected), rel=1e-4)
        own.zero_grad()
        others.zero_grad()


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
@pytest.mark.parametrize("others", [1, 2, 3])
@pytest.mark.parametrize("set_to_none", [True, False])
def test_centres_that_no_optimizer_holds_wait_for_none(others, set_to_none):
    """They are a frozen Parameter, and their gradient is never dropped: the gate steps once in each iteration."""
    view, gaussians = scene()
    names = ["opacities", "scales", "rotations"][:others]
    optimizers = [torch.optim.Adam([gaussians[name]], lr=0) for name in names]
    expected = []
    for _ in range(4):
        expected.append(gradient_at(gate.value(), view, gaussians))
        loss(view, gaussians).backward()
        for optimizer in optimizers:
            optimizer.step()
            assert gate.value() == pytest.approx(by_hand(expected), rel=1e-4), "with the first one"
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=set_to_none)
    # Once an optimizer takes them, the gate steps with that one.
    own = torch.optim.Adam([gaussians["means3D"]], lr=0)
    loss(view, gaussians).backward()
    own.step()
    before = gate.value()
    loss(view, gaussians).backward()
    optimizers[0].step()
    assert gate.value() == before
    own.step()
    assert gate.value() != before


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
def test_an_optimizer_that_holds_the_centres_and_has_not_stepped_yet_is_waited_for():
    """From the first iteration on, whichever steps first."""
    view, gaussians = scene()
    own = torch.optim.Adam([gaussians["means3D"]], lr=0)
    others = [torch.optim.Adam([gaussians[name]], lr=0) for name in ("opacities", "scales")]
    for _ in range(2):  # the second time nothing was dropped: both passes add up
        loss(view, gaussians).backward()
        for optimizer in others * 2:
            optimizer.step()
        assert gate.value() == pytest.approx(START, rel=1e-6)
    own.step()
    assert gate.value() != pytest.approx(START, rel=1e-6)


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
@pytest.mark.parametrize("known", [True, False])
def test_an_optimizer_that_densification_makes_anew_costs_no_step(known):
    """With new centres, between the backward pass and the step; another optimizer steps beside it."""
    view, gaussians = scene()
    other = torch.optim.Adam([gaussians["opacities"]], lr=0)
    own = torch.optim.Adam([gaussians["means3D"]], lr=0)
    steps = 0
    for iteration in range(4):
        before = gate.value()
        loss(view, gaussians).backward()
        if iteration % 2 == known:
            gaussians["means3D"] = torch.nn.Parameter(gaussians["means3D"].detach().clone())
            own = torch.optim.Adam([gaussians["means3D"]], lr=0)
        for optimizer in (other, own):
            optimizer.step()
            optimizer.zero_grad()
        steps += gate.value() != before
    assert steps == 4 and gate.state_dict()["adam"]["step"] == 4


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
def test_densification_between_the_backward_pass_and_the_step_loses_no_step():
    """3DGS puts new centres into its optimizer there; before the first step nothing tells whose they are."""
    view, gaussians = scene()
    optimizer = torch.optim.Adam([gaussians["means3D"]], lr=0)
    for _ in range(3):
        loss(view, gaussians).backward()
        before = gate.value()
        optimizer.step()
        assert gate.value() != before
        loss(view, gaussians).backward()
        gaussians["means3D"] = torch.nn.Parameter(gaussians["means3D"].detach().clone())
        optimizer.param_groups[0]["params"][0] = gaussians["means3D"]
        before = gate.value()
        optimizer.step()
        assert gate.value() != before


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
@pytest.mark.parametrize("set_to_none", [True, False])
def test_gradients_that_the_trainer_drops_do_not_count(set_to_none):
    """A pass for scores: a backward pass, then zero_grad without a step."""
    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    slope = gradient_at(START, view, gaussians)
    (1000 * loss(view, gaussians)).backward()
    optimizer.zero_grad(set_to_none=set_to_none)
    loss(view, gaussians).backward()
    optimizer.step()
    assert_the_next_step_adds_up(view, gaussians, optimizer, [slope])


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
def test_an_optimizer_that_is_none_of_torchs_counts_too():
    """It has no hook; the next rendering finds other values in the centres."""
    view, gaussians = scene()
    slope = gradient_at(START, view, gaussians)
    loss(view, gaussians).backward()
    with torch.no_grad():
        gaussians["means3D"].mul_(1.0)
    for tensor in gaussians.values():
        tensor.grad = None
    loss(view, gaussians)
    assert gate.value() == pytest.approx(by_hand([slope]), rel=1e-5)


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
def test_an_edit_of_the_centres_is_no_step_of_their_optimizer():
    """A trainer may keep them in a box between two renderings of a step."""
    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    loss(view, gaussians).backward()
    optimizer.step()  # from now on it is known
    optimizer.zero_grad()
    before = gate.value()
    for _ in range(2):
        loss(view, gaussians).backward()
        with torch.no_grad():
            gaussians["means3D"].clamp_(-100, 100)
        assert gate.value() == before
    optimizer.step()
    assert gate.value() != before


def test_a_gate_of_0_that_was_found_is_rendered_until_the_first_step():
    """A script that renders a model without torch.no_grad() shows it as the model's file says."""
    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    gate.found(0.0)
    shown = image(view, gaussians)
    assert torch.equal(shown, image(view._replace(background_gate=0.0), gaussians)) and gate.value() == 0
    slope = gradient_at(0.0, view, gaussians)
    shown.square().mean().backward()
    optimizer.step()
    assert gate.value() == pytest.approx(by_hand([slope]), rel=1e-5)


def test_a_gate_that_was_found_without_gradients_has_one_later():
    view, gaussians = scene()
    with torch.inference_mode():
        gate.found(0.3, {"logarithm": math.log(0.3), "adam": {"step": 1, "exp_avg": 0.1, "exp_avg_sq": 0.1}})
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    loss(view, gaussians).backward()
    optimizer.step()
    assert gate.value() not in (0.3, START)


@pytest.mark.skipif(not HAS_HOOKS, reason="before torch 2.0 it steps in each backward pass")
def test_a_step_with_the_gate_launches_one_kernel_more_than_one_with_a_number():
    """Small trainings wait for the host: each launch beside the rasterizer is time of a step."""
    from torch.utils._python_dispatch import TorchDispatchMode

    class Calls(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
            self.names[str(function)] += 1
            return function(*arguments, **(keywords or {}))

    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    found = []
    for background_gate in (0.5, "learned"):
        for _ in range(2):  # the first one makes Adam's state
            with Calls() as calls:
                calls.names = Counter()
                loss(view._replace(background_gate=background_gate), gaussians).backward()
                optimizer.step()
            optimizer.zero_grad()
        found.append(calls.names)
    more = found[1] - found[0]
    for name in ("aten.view.default", "aten.empty_like.default", "aten.detach.default"):  # nothing runs on the device
        more.pop(name, None)
    assert more == {"diff_smoe_rasterization.gate_adam.default": 1}


def test_a_rendering_keeps_its_gate_while_others_step_it():
    """Its backward pass is of the value that it was rendered with, and counts at the next step."""
    view, gaussians = scene()
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0)
    first, second = gradient_at(START, view, gaussians), None
    waiting, other = (loss(view, gaussians, means3D=gaussians["means3D"] + 0) for _ in range(2))
    other.backward()
    optimizer.step()
    second = gate.value()
    assert second == pytest.approx(by_hand([first]), rel=1e-5)
    waiting.backward()
    optimizer.step()
    assert gate.value() == pytest.approx(by_hand([first, first]), rel=1e-5) and gate.value() != second


def test_a_gradient_that_is_not_finite_counts_as_0():
    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    (math.inf * loss(view, gaussians)).backward()
    optimizer.step()
    assert gate.value() == pytest.approx(START, rel=1e-6)


def test_before_hooks_of_optimizers_it_steps_in_the_backward_pass(monkeypatch):
    """As with torch 1.13; several renderings of one loss are one step."""
    monkeypatch.setattr(learned_gate, "_HAS_HOOKS", False)
    gate.reset()
    view, gaussians = scene()
    slope = gradient_at(START, view, gaussians, 2)
    (loss(view, gaussians) + loss(view, gaussians)).backward()
    assert gate.value() == pytest.approx(by_hand([slope]), rel=1e-5)
    second = gradient_at(gate.value(), view, gaussians)
    loss(view, gaussians).backward()
    assert gate.value() == pytest.approx(by_hand([slope, second]), rel=1e-5)


def test_a_step_before_the_backward_pass_of_another_rendering_is_no_error():
    view, gaussians = scene()
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0)  # that of a camera, which steps first
    waiting, other = (loss(view, gaussians, means3D=gaussians["means3D"] + 0) for _ in range(2))
    other.backward()
    before = gate.value()
    optimizer.step()
    assert gate.value() != before
    waiting.backward()


def test_processes_that_each_learn_a_gate_are_told_so(tmp_path):
    """Once, and only where there are several."""
    view, gaussians = scene()
    torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/meeting", rank=0, world_size=1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loss(view, gaussians)
    finally:
        torch.distributed.destroy_process_group()
    gate.reset()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.distributed, "is_initialized", lambda: True)
        patch.setattr(torch.distributed, "get_world_size", lambda: 4)
        with pytest.warns(UserWarning, match="each of the 4 processes of this training learns a background gate of"):
            loss(view, gaussians)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loss(view, gaussians)


def test_without_gradients_of_gaussians_an_image_has_none():
    """A viewer's Gaussians need none, and it calls numpy()."""
    view, gaussians = scene()
    image(view, {name: tensor.detach() for name, tensor in gaussians.items()}).numpy()


def test_integrations_take_it():
    view, gaussians = scene()
    made = inria.GaussianRasterizationSettings(**{**view._asdict(), "blend_mode": "smoe_eq7"})
    color, _ = inria.GaussianRasterizer(made)(**gaussians)
    color.square().mean().backward()
    before = gate.value()
    torch.optim.SGD(gaussians.values(), lr=0).step()
    assert gate.value() != before
    with pytest.raises(ValueError, match="'learnt'; it must be a number, 0 or more .*or 'learned'"):
        image(view._replace(background_gate="learnt"), gaussians)


def ply(path):
    plyfile = pytest.importorskip("plyfile")
    rows = np.zeros(1, dtype=[(name, "f4") for name in ("x", "opacity", "scale_0", "rot_0")])
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(path))


def read_ply(path):
    import plyfile
    return plyfile.PlyData.read(str(path))["vertex"]["x"]


KINDS = {".ply": (ply, read_ply),
         ".npz": (lambda path: np.savez(path, opacity=np.zeros(1)), lambda path: np.load(path)["opacity"]),
         # Of some size: torch cannot read an archive that is shorter than its comment.
         ".pth": (lambda path: torch.save((torch.zeros(9000), 7), path), lambda path: torch.load(path)[0])}


@pytest.fixture
def process(monkeypatch):
    """Makes this a process that blends so, as `dsmoe run` does."""
    def blends(mode, background_gate="learned"):
        gate.reset()
        records._models_read.clear()
        records._told.clear()
        monkeypatch.setenv("DSMOE_BLEND_MODE", mode)
        monkeypatch.setenv("DSMOE_BACKGROUND_GATE", str(background_gate))

    records.keep()
    records._told.clear()
    return blends


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_brings_the_gate_that_it_was_saved_with(kind, tmp_path, process, monkeypatch):
    """What it holds besides is what it was; the gate of a later iteration is in the later file."""
    save, load = KINDS[kind]
    path = tmp_path / ("model" + kind)
    process("alpha")
    save(path)
    plain = path.read_bytes()
    process("smoe")
    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    values = []
    for step in range(2):
        loss(view, gaussians).backward()
        optimizer.step()
        optimizer.zero_grad()
        values.append(gate.value())
        path = tmp_path / str(step) / ("model" + kind)
        path.parent.mkdir()
        save(path)
        assert [one.name for one in path.parent.iterdir()] == [path.name]
    assert b"background_gate" not in plain and b"background_gate" in path.read_bytes()
    assert kind == ".ply" or path.read_bytes().startswith(plain[:-2])  # the comment's length follows
    going_on = gate.state_dict()
    for own in "smoe", "":  # without the variable only settings say how a process blends
        for step, value in enumerate(values):
            process(own)
            gate.reset(frozen=True)
            with pytest.raises(RuntimeError, match="no file that was read says which .*number, --background_gate V"):
                image(view, gaussians)
            load(tmp_path / str(step) / ("model" + kind))
            assert gate.value() == value
            assert torch.equal(image(view, gaussians), image(view._replace(background_gate=value), gaussians))
    gate.reset()
    load(path)
    assert kind == ".ply" or gate.state_dict() == going_on
    if kind == ".ply":
        assert f"comment blend_mode smoe\ncomment background_gate {values[-1]}\n".encode() in path.read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_without_a_record_counts_as_one_of_alpha(kind, tmp_path, process, capfd):
    save, load = KINDS[kind]
    path = tmp_path / ("model" + kind)
    process("alpha")
    save(path)
    load(path)
    np.savez(tmp_path / "points.npz", x=np.zeros(1))
    assert not capfd.readouterr().err
    process("smoe_tn")
    load(path)
    assert "no blend mode, as a file of alpha, and this process blends by smoe_tn\n" in capfd.readouterr().err
    process("smoe")
    load(path)
    load(path)
    said = capfd.readouterr().err
    assert said.count("The gate is 0 where nothing is learned, and learning starts at 0.1;") == 1
    view, gaussians = scene()
    with torch.no_grad():
        assert torch.equal(image(view, gaussians), image(view._replace(background_gate=0.0), gaussians))
    np.load(tmp_path / "points.npz")  # no model
    assert not capfd.readouterr().err


def with_record(kind, path, record):
    """A model with a record, written by hand: text for a zip's comment, comments for a .ply."""
    if kind == ".ply":
        pytest.importorskip("plyfile")
        lines = "".join(f"comment {name} {value}\n" for name, value in record.items())
        properties = "".join(f"property float {name}\n" for name in ("x", "opacity", "scale_0", "rot_0"))
        header = f"ply\nformat ascii 1.0\n{lines}element vertex 1\n{properties}end_header\n0 0 0 0\n"
        path.write_bytes(header.encode("ascii", "surrogateescape"))
        return
    comment = b"diff_smoe_rasterization " + (record if isinstance(record, bytes) else json.dumps(record).encode())
    plain = path.read_bytes()
    path.write_bytes(plain[:-2] + struct.pack("<H", len(comment)) + comment)


OF_GATE = {"blend_mode": "smoe", "background_gate": 0.25}
ADAM = {"step": 3, "exp_avg": 0.0, "exp_avg_sq": 0.0}
DAMAGED = [
    *({**OF_GATE, "background_gate": value} for value in (math.nan, -1, -0.1, math.inf, 1e31, "0.25", None, True, [1])),
    *({**OF_GATE, "faint_below": value} for value in (math.nan, -1, "2", [])),
    *({**OF_GATE, "blend_mode": value} for value in ("smo", None, 3, ["smoe"], {})), {}, [], 3, "smoe", None,
    b"", b"{", b"\xff\xfe", b"[" * 3000, b"[" * 900 + b"]" * 900, b'{"blend_mode": "smoe", "background_gate": 1e999}',
    b'{"blend_mode": "smoe", "background_gate": ' + b"9" * 5000 + b"}",
    *({**OF_GATE, "learned": state} for state in (
        3, [], {}, "x", {"logarithm": 0.0}, {"logarithm": math.nan, "adam": {}}, {"logarithm": "0", "adam": {}},
        {"logarithm": 1e9, "adam": {}}, {"logarithm": 0.0, "adam": {"step": 3}}, {"logarithm": 0.0, "adam": [1]},
        {"logarithm": 0.0, "adam": {**ADAM, "step": -1}}, {"logarithm": 0.0, "adam": {**ADAM, "step": "3"}},
        {"logarithm": 0.0, "adam": {**ADAM, "exp_avg_sq": -1}}, {"logarithm": 0.0, "adam": {**ADAM, "exp_avg": None}}))]


@pytest.mark.parametrize("kind", (".npz", ".pth"))
def test_a_damaged_record_counts_as_none(kind, tmp_path, process, capfd):
    """The file itself is whole: what reads it gets it, and no damage is taken for a gate."""
    path = tmp_path / ("model" + kind)
    process("alpha")
    for record in DAMAGED:
        KINDS[kind][0](path)
        with_record(kind, path, record)
        process("smoe")
        assert KINDS[kind][1](path).shape
        said = capfd.readouterr().err
        assert ("record of mode and gate is damaged" in said) == (record is not None), record  # null is no record
        assert "it records no blend mode, as a file of alpha" in said and gate.value() == 0, record
        process("alpha")


@pytest.mark.parametrize("comments", [
    {"blend_mode": "smoe", "background_gate": value} for value in ("nan", "-1", "inf", "x", "", "1e31")] + [
    {"blend_mode": "smo", "background_gate": "0.25"}, {"blend_mode": ""}, {"blend_mode": "smoe smoe"},
    {"blend_mode": "smoe", "faint_below": "nan"}])
def test_damaged_comments_of_a_ply_count_as_none(comments, tmp_path, process, capfd):
    with_record(".ply", tmp_path / "a.ply", comments)
    process("smoe")
    assert read_ply(tmp_path / "a.ply").shape == (1,)
    assert "record of mode and gate is damaged (ValueError: " in capfd.readouterr().err and gate.value() == 0


def test_comments_that_are_no_record_are_not_read_as_one(tmp_path, process, capfd):
    """Of another program, and words of ours in the middle of a file; a .ply that names a mode and no gate has 0."""
    path = tmp_path / "model.npz"
    process("alpha")
    np.savez(path, opacity=np.frombuffer(b'diff_smoe_rasterization {"blend_mode": "smoe_tn"}', np.uint8))
    plain = path.read_bytes()
    process("smoe")
    for text in (b"", b"of another program", b"diff_smoe_rasterization_2 {}"):
        path.write_bytes(plain[:-2] + struct.pack("<H", len(text)) + text)
        np.load(path)
        assert "records no blend mode" in "".join(records._told) and "damaged" not in capfd.readouterr().err
        records._told.clear()
    with_record(".ply", tmp_path / "a.ply", {"blend_mode": "smoe"})
    read_ply(tmp_path / "a.ply")
    assert capfd.readouterr().err.endswith("a.ply records the background gate 0\n")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("own, record, said", [
    (("smoe_eq7", 0.0), ("smoe_eq7", 0.3), "of smoe_eq7, background gate 0.3, and this process blends by smoe_eq7, "
                                           "background gate 0.0; --blend_mode smoe_eq7 --background_gate 0.3 is as"),
    (("smoe", 0.5), ("smoe", 0.3), "gate 0.3, and this process blends by smoe, background gate 0.5; --blend_mode smoe"),
    (("smoe_eq7", 0.3), ("smoe", 0.3), "--blend_mode smoe --background_gate 0.3 is as it was"),
    (("smoe", "learned"), ("smoe_eq7", 0.3), "by smoe, background gate learned, in which its Gaussians show another"),
    (("alpha", ""), ("smoe", 0.3), "gate 0.3, and this process blends by alpha, in which its Gaussians show another"),
    (("smoe_tn", ""), ("smoe_std",), "by smoe_tn, in which its Gaussians show another scene; --blend_mode smoe_std is"),
    (("smoe", 0), ("smoe", 0.0, 2.0), "it is of smoe, background gate 0.0, faint_below 2.0, and this process blends by "
                                      "smoe, background gate 0.0; DSMOE_FAINT_BELOW=2.0 --blend_mode smoe --back"),
    (("smoe", 0.3), ("smoe", 0.3), ""), (("smoe_tn", ""), ("smoe_tn",), ""),
    (("smoe", "learned"), ("smoe", 0.3), "records the background gate 0.3")])
def test_a_model_of_another_blend_is_named(kind, own, record, said, tmp_path, process, capfd):
    path = tmp_path / ("model" + kind)
    process("alpha")
    if kind != ".ply":
        KINDS[kind][0](path)
    with_record(kind, path, dict(zip(("blend_mode", "background_gate", "faint_below"), record)))
    process(*own)
    KINDS[kind][1](path)
    told = capfd.readouterr().err
    assert said in told and told.count("\n") == bool(said)
    assert own[1] != "learned" or gate.value() == (0.3 if record[0] == "smoe" else 0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("blend", [("smoe", "learned"), ("", "")], ids=["smoe", "no blend chosen"])
@pytest.mark.parametrize("gates", [(0.192, 0.180), (0.3, 0.3)], ids=str)
def test_a_process_that_merges_models_records_what_they_record(kind, blend, gates, tmp_path, process, capfd):
    """It renders none: VastGaussian's blocks become one model. What cannot be kept is said."""
    process("alpha")
    paths = [tmp_path / (name + kind) for name in ("a", "b", "merged")]
    for path, value in zip(paths, gates):
        if kind != ".ply":
            KINDS[kind][0](path)
        with_record(kind, path, {"blend_mode": "smoe", "background_gate": value})
    process(*blend)
    for path in paths[:2]:
        KINDS[kind][1](path)
    KINDS[kind][0](paths[2])
    told = capfd.readouterr().err
    said = "a{0}: smoe, background gate 0.192; .*b{0}: smoe, background gate 0.18.*it records the last"
    assert bool(re.search("models that it has read differ .*" + said.format(kind), told)) == (gates[0] != gates[1])
    process("smoe")
    KINDS[kind][1](paths[2])
    assert gate.value() == gates[1]
    process(*blend)
    KINDS[kind][1](paths[0])
    view, gaussians = scene()
    with torch.no_grad():  # one that renders says how
        image(view._replace(blend_mode="smoe_tn", background_gate=None), gaussians)
    KINDS[kind][0](paths[2])
    assert (b"0.192" in paths[2].read_bytes()) is False


@pytest.mark.parametrize("kind", KINDS)
def test_faint_pairs_of_a_process_are_recorded_and_compared(kind, tmp_path, process, capfd, monkeypatch):
    """Only where they are unusual, so that other programs' files stay as they are."""
    path = tmp_path / ("model" + kind)
    process("smoe", 0.3)
    KINDS[kind][0](path)
    assert b"faint_below" not in path.read_bytes()
    monkeypatch.setenv("DSMOE_FAINT_BELOW", "2")
    KINDS[kind][0](path)
    KINDS[kind][1](path)
    assert not capfd.readouterr().err
    monkeypatch.setenv("DSMOE_FAINT_BELOW", "1")
    KINDS[kind][1](path)
    assert "faint_below 2.0, and this process blends by smoe, background gate 0.3, faint_below 1.0" in (
        capfd.readouterr().err)


@pytest.mark.parametrize("mode", ["smoe_tn", "smoe_eq7"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_mode_without_a_learned_gate_is_recorded_too(kind, mode, tmp_path, process, capfd):
    process(mode, 0.3)
    KINDS[kind][0](tmp_path / ("model" + kind))
    KINDS[kind][1](tmp_path / ("model" + kind))
    assert not capfd.readouterr().err
    process("smoe", 0.3)
    KINDS[kind][1](tmp_path / ("model" + kind))
    said = capfd.readouterr().err
    assert re.search(f"it is of {mode}(, background gate 0.3)?, and this process blends by smoe,", said)


def test_a_save_that_is_killed_leaves_the_file_of_before(tmp_path, process):
    """Or a whole one with its record; never one without."""
    process("smoe_tn")
    path = tmp_path / "model.pth"
    torch.save((torch.zeros(3), 7), path)
    before = path.read_bytes()

    class Dies:
        def __reduce__(self):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        torch.save((torch.ones(3), Dies()), path)
    assert path.read_bytes() == before and [one.name for one in tmp_path.iterdir()] == ["model.pth"]


def test_a_save_removes_what_a_killed_one_left_long_ago(tmp_path, process):
    """Not what is young: a process, on this host or another, may be writing there."""
    process("smoe_tn")
    for name, days in (("old", 2), ("new", 0)):
        (tmp_path / f".dsmoe_part-{name}").mkdir()
        os.utime(tmp_path / f".dsmoe_part-{name}", (time.time() - days * 86400,) * 2)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("precious")
    os.utime(tmp_path / "mine", (0, 0))
    (tmp_path / ".dsmoe_part-link").symlink_to("mine")
    torch.save(torch.zeros(3), tmp_path / "model.pth")
    assert {one.name for one in tmp_path.iterdir()} == {".dsmoe_part-new", ".dsmoe_part-link", "mine", "model.pth"}
    assert (tmp_path / "mine" / "file").exists()


def test_a_file_is_written_where_and_as_it_would_be_without_a_record(tmp_path, process):
    """Through a link, with the mode of before, into a pipe, and the errors are those of torch."""
    process("smoe_tn")
    real, link, pipe = tmp_path / "real.pth", tmp_path / "link.pth", tmp_path / "pipe"
    torch.save(torch.zeros(1), real)
    real.chmod(0o640)
    link.symlink_to(real.name)
    torch.save(torch.ones(1), f=link)
    assert link.is_symlink() and real.stat().st_mode & 0o777 == 0o640 and torch.load(real) == 1
    assert b"smoe_tn" in real.read_bytes()
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: received.append(pipe.read_bytes()))
    received = []
    reader.start()
    with contextlib.suppress(RuntimeError):  # torch may want to go back in it
        torch.save(torch.zeros(1), pipe)
    reader.join()
    assert received and stat.S_ISFIFO(pipe.stat().st_mode)
    for wrong in (tmp_path / "none" / "a.pth", tmp_path):
        with pytest.raises((RuntimeError, OSError)) as with_records:
            torch.save(torch.zeros(1), wrong)
        with pytest.raises((RuntimeError, OSError)) as without:
            torch.save.__wrapped__(torch.zeros(1), wrong)
        assert str(with_records.value) == str(without.value)
    with pytest.raises(TypeError, match="save"):
        torch.save(torch.zeros(1))


def test_a_file_with_a_comment_of_another_program_stays(tmp_path):
    """And one that is too short, or torch's older format, is no error."""
    records.keep()
    view, gaussians = scene()
    image(view, gaussians)
    torch.save(torch.zeros(1), tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    torch.load(tmp_path / "old.pth")
    np.savez(tmp_path / "a", x=np.zeros(1))
    saved = (tmp_path / "a.npz").read_bytes()
    length, = struct.unpack("<H", saved[saved.rindex(b"PK\x05\x06") + 20:][:2])
    assert saved[-length:].startswith(b"diff_smoe_rasterization {")
    np.testing.assert_array_equal(np.load(tmp_path / "a.npz")["x"], np.zeros(1))
