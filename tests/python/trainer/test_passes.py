"""The direct passes of a step against those of autograd: the same training, bit for bit, whatever happens in it."""
from __future__ import annotations

import contextlib
import dataclasses
import random
from types import SimpleNamespace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from dsmoe.model import PARAMETERS
from dsmoe.scenes.lens import lens_of
from dsmoe.scenes.scene import load_scene
from dsmoe.training.checkpoint import load_checkpoint, save_checkpoint
from dsmoe.training.graphs import IDLE, MOST_KINDS, MOST_SEEN, WARM_UP, Graphs
from dsmoe.training.passes import AutogradPasses, DirectPasses
from dsmoe.training.trainer import Trainer


@pytest.fixture
def scene(tiny_config):
    return load_scene(tiny_config, progress=False)


class Repeats(Graphs):
    """Graphs that run their functions anew at each replay, and count these."""

    def __init__(self):
        super().__init__()
        self.replays = 0

    def _record(self, function):
        def replay():
            self.replays += 1
            function()

        return replay


class Recorded(Repeats):
    """Graphs as CUDA's: a capture changes no memory, a replay runs the ops on it that were captured, and no Python."""

    def _record(self, function):
        recorder = Recorder()
        with recorder:
            function()
        recorder.forget()

        def replay():
            self.replays += 1
            recorder.replay()

        return replay


class Recorder(TorchDispatchMode):
    def __init__(self):
        super().__init__()
        self.calls, self.before = [], {}

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
        for tensor in tensors_in((arguments, keywords)):
            self.before.setdefault(id(tensor), (tensor, tensor.detach().clone()))
        results = function(*arguments, **(keywords or {}))
        self.calls.append((function, arguments, keywords or {}, results))
        return results

    def forget(self):
        """Makes memory what it was in front of the capture."""
        for tensor, value in self.before.values():
            with versions_stay([tensor]):
                tensor.detach().copy_(value)
        self.before = {}

    def replay(self):
        for function, arguments, keywords, results in self.calls:
            given = tensors_in((arguments, keywords))
            with versions_stay(given):
                now = function(*arguments, **keywords)
            for old, new in zip(tensors_in(results), tensors_in(now)):
                if all(old is not tensor for tensor in given):
                    with versions_stay([old]):
                        old.set_(new)  # the result that Python holds


@contextlib.contextmanager
def versions_stay(tensors):
    """As of what torch does not see: the kernels of a graph."""
    with contextlib.ExitStack() as stack:
        for tensor in tensors:
            stack.enter_context(torch.autograd._unsafe_preserve_version_counter(tensor))
        yield


def tensors_in(tree):
    return [leaf for leaf in tree_flatten(tree)[0] if isinstance(leaf, torch.Tensor)]


def make_direct(trainer, graphs=None):
    """On the CPU it is not by itself."""
    trainer.passes = DirectPasses(trainer.model, trainer.optimizer, trainer.renderer, trainer.gate,
                                  lambda iteration: trainer.strategy.loss_rule(iteration), graphs)


def trained(config, scene, direct, steps=40, graphs=None):
    trainer = Trainer(config, scene)
    if direct:
        make_direct(trainer, graphs)
    for _ in range(steps):
        trainer.step()
    return trainer


def assert_equal(one, other):
    states = [trainer.state_dict() for trainer in (one, other)]
    for name in PARAMETERS:
        assert torch.equal(states[0]["raw"][name], states[1]["raw"][name]), name
        of_one, of_other = (state["optimizer"].get(name, {}) for state in states)
        assert set(of_one) == set(of_other)
        for key, value in of_one.items():
            assert torch.equal(torch.as_tensor(value), torch.as_tensor(of_other[key])), (name, key)
    for key in ("gradient_sum", "view_count"):
        if key in states[0]["strategy"]:
            assert torch.equal(states[0]["strategy"][key], states[1]["strategy"][key])
    assert set(states[0]["average"]) == set(states[1]["average"])
    for name, tensor in states[0]["average"].items():
        assert torch.equal(tensor, states[1]["average"][name])
    assert one.background_gate == other.background_gate


@pytest.mark.parametrize("options", [
    dict(blend_mode="alpha"), dict(blend_mode="smoe", background_gate=0.0),
    dict(blend_mode="smoe", background_gate="learned", random_background=True),
    dict(blend_mode="alpha", antialiasing=True, white_background=True, sh_degree=1),
    dict(blend_mode="alpha", strategy="steady", sh_degree=0),
    dict(blend_mode="smoe", strategy="importance", budget=60)], ids=str)
def test_direct_passes_train_as_autograd_does(tiny_config, scene, options):
    """Densifications are at 8, 16, 24; an opacity reset without one, at 12, replaces only the opacities."""
    config = tiny_config.changed(**options)
    trainers = [trained(config, scene, direct) for direct in (False, True)]
    assert [type(trainer.passes) for trainer in trainers] == [AutogradPasses, DirectPasses]
    assert trainers[1].model.num_gaussians != len(scene.points.positions), "something must have been densified"
    assert_equal(*trainers)


@pytest.mark.parametrize("options", [
    dict(blend_mode="alpha"), dict(blend_mode="smoe", background_gate="learned", random_background=True),
    dict(blend_mode="alpha", strategy="mcmc", budget=60),
    dict(blend_mode="smoe", strategy="importance", budget=60, strategy_options="views=3,moves=0.2", iterations=50)],
    ids=str)
@pytest.mark.parametrize("images", ["plain", "masked", "bent"])
@pytest.mark.parametrize("graphs", [Repeats, pytest.param(Recorded, marks=pytest.mark.skipif(
    not hasattr(torch.autograd, "_unsafe_preserve_version_counter"), reason="this torch counts all changes"))])
def test_repeated_steps_are_those_that_are_launched(tiny_config, scene, monkeypatch, options, images, graphs):
    """Whatever comes between: densifications, looks, evaluations, other losses, degrees, backgrounds and an average."""
    monkeypatch.setattr("dsmoe.training.graphs.WARM_UP", 3)
    monkeypatch.setattr("diff_smoe_rasterization.lazy_adam._CAPACITY", 7)
    if images == "bent":  # some steps show them by a pinhole
        monkeypatch.setattr("dsmoe.scenes.straight.EVERY", 4)
        lens = lens_of("OPENCV_FISHEYE", True, {"k1": 0.02})
        scene = dataclasses.replace(scene, train=[dataclasses.replace(view, camera=dataclasses.replace(
            view.camera, lens=lens)) for view in scene.train])
    if images == "masked":
        mask = torch.randint(0, 256, (1, 24, 32), dtype=torch.uint8)
        views = [dataclasses.replace(view, mask=mask if index % 3 else None) for index, view in enumerate(scene.train)]
        scene = dataclasses.replace(scene, train=views)
    config = tiny_config.changed(**options)
    repeats = graphs()
    trainers, reports = [trained(config, scene, True, 0, captures) for captures in (None, repeats)], []
    if config.strategy != "mcmc":  # whose regulariser the two kinds of passes round otherwise
        trainers.append(trained(config, scene, False, 0))
    for trainer in trainers:
        torch.manual_seed(5)
        reports.append([])
        for step in range(config.iterations):
            trainer.step(trainer.evaluate if step % 7 == 6 else None)
            reports[-1].append((float(trainer.training_psnr()), trainer.num_gaussians))
    assert repeats.replays > 30
    assert bool(trainers[0].optimizer.average) == (config.iterations > 42)
    assert all(report == reports[0] for report in reports)
    for other in trainers[1:]:
        assert_equal(trainers[0], other)


class Counted(Graphs):
    """Steps that compute nothing: which are captured, replayed and launched."""

    def __init__(self):
        super().__init__()
        self.captures = []

    def _new(self, num_gaussians, capture):
        self.captures.append(self.kind_now)
        return SimpleNamespace(used=0)

    def run(self, memory, kinds):
        """Returns of each step whether it was a replay; the step of a capture is one."""
        replayed = []
        for self.kind_now in kinds:
            replayed.append(self._find(memory, self.kind_now, lambda: None) is not None)
        return replayed


def views_of(kinds, epochs):
    """The kinds of the views of each step, every view once in each epoch."""
    chance = random.Random(3)
    return [kind for _ in range(epochs) for kind in chance.sample(kinds, len(kinds))]


@pytest.mark.parametrize("num_kinds", [1, 4, 5, 8, 40])
@pytest.mark.parametrize("views", [40, 200])
def test_kinds_of_views_are_captured_once_and_not_in_turns(num_kinds, views):
    """As many as fit; a capture takes as long as several steps. 10 densifications, each over new parameters."""
    graphs, steps = Counted(), iter(views_of([view % num_kinds for view in range(views)], 1000 // views))
    graphs.run([torch.zeros(3)], [0] * WARM_UP)
    for _ in range(10):
        kinds, before = [next(steps) for _ in range(100)], len(graphs.captures)
        replayed = graphs.run([torch.zeros(3)], kinds)
        captured = graphs.captures[before:]
        twice = [kind for kind in dict.fromkeys(kinds) if kinds.count(kind) > 1]
        assert len(captured) == len(set(captured)) == min(MOST_KINDS, len(twice))
        assert sum(replayed) == sum(kinds.count(kind) - 1 for kind in captured), "all but the first of each"


def test_a_kind_that_comes_no_more_makes_place_for_another():
    """As the kinds of a loss that has changed."""
    graphs, memory = Counted(), [torch.zeros(3)]
    graphs.run(memory, [0] * WARM_UP)
    old, new = range(MOST_KINDS), range(MOST_KINDS, 2 * MOST_KINDS)
    assert all(graphs.run(memory, views_of(list(old), 20))[2 * MOST_KINDS:])
    later = graphs.run(memory, views_of(list(new), 2 + IDLE // MOST_KINDS + 1))
    assert not any(later[:IDLE - MOST_KINDS]) and all(later[-MOST_KINDS:])
    assert sorted(graphs.captures) == [*old, *new]


def test_kinds_that_never_repeat_are_not_all_remembered():
    graphs = Counted()
    assert not any(graphs.run([torch.zeros(3)], range(3 * MOST_SEEN)))
    assert len(graphs._seen) == MOST_SEEN


class Starved(Repeats):
    """Whose captures fail in their second part: as often as `failures`, and with `too_many` Gaussians or more."""

    def __init__(self, failures, too_many, words="CUDA out of memory. Tried to allocate 2.00 GiB"):
        super().__init__()
        self.failures, self.too_many, self.words, self.recorded, self.attempts = failures, too_many, words, 0, []

    def _new(self, num_gaussians, capture):
        self.recorded = 0
        self.attempts.append(num_gaussians)
        return super()._new(num_gaussians, capture)

    def _record(self, function):
        self.recorded += 1
        if self.recorded == 2 and (self.failures > 0 or self.attempts[-1] >= self.too_many):
            self.failures -= 1
            raise RuntimeError(self.words)
        return super()._record(function)


@pytest.mark.parametrize("failures, too_many", [(1, 10_000), (0, 61)])
def test_without_memory_for_a_capture_steps_are_launched(tiny_config, scene, monkeypatch, capsys, failures, too_many):
    """Once more with all other graphs gone, then only with fewer Gaussians: here those behind the removals."""
    monkeypatch.setattr("dsmoe.training.graphs.WARM_UP", 3)
    config = tiny_config.changed(strategy="importance", budget=60, strategy_options="views=3,moves=0.2", iterations=50)
    launched, starved = (trained(config, scene, True, 0, graphs) for graphs in (None, Starved(failures, too_many)))
    for trainer in (launched, starved):
        torch.manual_seed(5)
        for _ in range(config.iterations):
            trainer.step()
    graphs = starved.passes._graphs
    assert graphs.replays > 30
    said = capsys.readouterr().err
    if failures:
        assert graphs.attempts[0] == graphs.attempts[1] and not said
    else:
        refused = [count for count in graphs.attempts if count > 60]
        assert len(refused) == 2 and min(graphs.attempts) == 60 and said.count("\n") == 1
        assert f"at {refused[0]} Gaussians the GPU has no memory for steps as CUDA graphs" in said
    assert_equal(launched, starved)


def test_another_error_of_a_capture_is_raised(tiny_config, scene, monkeypatch):
    monkeypatch.setattr("dsmoe.training.graphs.WARM_UP", 3)
    with pytest.raises(RuntimeError, match="another one"):
        trained(tiny_config, scene, True, 20, Starved(1, 10_000, "another one"))


def test_who_reads_the_model_finds_it_up_to_date(tiny_config, scene):
    """At any time, and reading changes nothing of what follows."""
    quiet, disturbed = (Trainer(tiny_config, scene) for _ in range(2))
    dense = Trainer(tiny_config, scene)
    make_direct(quiet)
    make_direct(disturbed)
    waited = False
    for step in range(30):
        for trainer in (quiet, disturbed, dense):
            torch.manual_seed(step)  # splits draw from the one generator of the process
            trainer.step()
        waited |= not torch.equal(quiet.model.stored["dc"], dense.model.stored["dc"])
        if step % 4 == 0:
            assert torch.equal(disturbed.model.raw["dc"], dense.model.raw["dc"])
            assert disturbed.evaluate().metrics == dense.evaluate().metrics
    assert waited, "no row has waited"
    assert_equal(quiet, disturbed)


def test_a_checkpoint_on_the_way(tiny_config, scene, tmp_path):
    straight = trained(tiny_config, scene, True)
    broken = trained(tiny_config, scene, True, 21)
    path = str(tmp_path / "checkpoint.pt")
    save_checkpoint(path, broken.state_dict())
    resumed = Trainer(tiny_config, scene)
    make_direct(resumed)
    resumed.load_state_dict(load_checkpoint(path, "cpu"))
    for _ in range(19):
        resumed.step()
    assert_equal(straight, resumed)


def test_what_a_strategy_adds_reaches_all_gaussians(tiny_config, scene, monkeypatch):
    """By both passes alike, seen or not; a sum in another order is rounded otherwise."""
    monkeypatch.setattr("dsmoe.training.mcmc_strategy.NOISE_RATE", 0)
    config = tiny_config.changed(strategy="mcmc", budget=100)
    dense, direct = (trained(config, scene, direct, 2) for direct in (False, True))
    dense.step()
    assert (direct.step().rendering.radii == 0).any(), "all were seen"
    for name in PARAMETERS:
        torch.testing.assert_close(direct.model.raw[name], dense.model.raw[name], rtol=1e-5, atol=1e-5)
