"""The gate that this process learns: when it steps, what it adds up, and the files that bring it back."""
from __future__ import annotations

import math
import struct
import warnings

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
    second = gradient_at(gate.value(), view, gaussians)
    loss(view, gaussians).backward()
    optimizer.step()
    assert gate.value() == pytest.approx(by_hand([slope, second]), rel=1e-5)


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
    second = gradient_at(gate.value(), view, gaussians)
    loss(view, gaussians).backward()
    optimizer.step()
    assert gate.value() == pytest.approx(by_hand([slope, second]), rel=1e-5)


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
    plyfile.PlyData.read(str(path))


KINDS = {".ply": (ply, read_ply),
         ".npz": (lambda path: np.savez(path, opacity=np.zeros(1)), lambda path: np.load(path)),
         ".pth": (lambda path: torch.save((torch.zeros(3), 7), path), lambda path: torch.load(path))}


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_brings_the_gate_that_it_was_saved_with(kind, tmp_path, monkeypatch):
    """What it holds besides is what it was; the gate of a later iteration is in the later file."""
    save, load = KINDS[kind]
    path = tmp_path / ("model" + kind)
    records.keep()
    monkeypatch.setenv("DSMOE_BLEND_MODE", "alpha")
    save(path)
    plain = path.read_bytes()
    view, gaussians = scene()
    optimizer = torch.optim.SGD(gaussians.values(), lr=0)
    values = []
    for step in range(2):
        loss(view, gaussians).backward()
        optimizer.step()
        optimizer.zero_grad()
        values.append(gate.value())
        path = tmp_path / f"{step}{kind}"
        save(path)
    assert plain != path.read_bytes() and b"background_gate" not in plain
    going_on = gate.state_dict()
    for step, value in enumerate(values):
        gate.reset(frozen=True)
        with pytest.raises(RuntimeError, match="no file that was read says which .*as a number, --background_gate V"):
            image(view, gaussians)
        load(tmp_path / f"{step}{kind}")
        assert gate.value() == value
        assert torch.equal(image(view, gaussians), image(view._replace(background_gate=value), gaussians))
    gate.reset()
    load(path)
    assert kind == ".ply" or gate.state_dict() == going_on
    if kind == ".ply":
        assert f"comment blend_mode smoe\ncomment background_gate {values[-1]}\n".encode() in path.read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_without_a_record_has_0_and_says_so(kind, tmp_path, monkeypatch):
    save, load = KINDS[kind]
    path = tmp_path / ("model" + kind)
    records.keep()
    save(path)
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe")
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "learned")
    with pytest.warns(UserWarning, match="records no background gate, so it is 0 where nothing is learned"):
        load(path)
    view, gaussians = scene()
    with torch.no_grad():
        assert torch.equal(image(view, gaussians), image(view._replace(background_gate=0.0), gaussians))
    points = tmp_path / "points.npz"
    np.savez(points, x=np.zeros(1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.load(points)


def test_a_file_with_a_comment_of_another_program_stays(tmp_path):
    """And one that is too short, or torch's older format, is no error."""
    records.keep()
    view, gaussians = scene()
    image(view, gaussians)
    torch.save(torch.zeros(1), tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    torch.load(tmp_path / "old.pth")
    np.savez(tmp_path / "a.npz", x=np.zeros(1))
    saved = (tmp_path / "a.npz").read_bytes()
    length, = struct.unpack("<H", saved[saved.rindex(b"PK\x05\x06") + 20:][:2])
    assert saved[-length:].startswith(b"diff_smoe_rasterization {")
    np.testing.assert_array_equal(np.load(tmp_path / "a.npz")["x"], np.zeros(1))
