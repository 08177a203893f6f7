"""Batches of views on one process: gradients, the rule of the learning rates, milestones, resuming."""
from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from dsmoe.distributed.trainer import BatchTrainer
from dsmoe.errors import ConfigError, TrainerError
from dsmoe.options.config import LEARNED, GateOptions
from dsmoe.results.modelfile import model_path
from dsmoe.scenes.scene import load_scene
from dsmoe.system.group import ALONE
from dsmoe.train import train
from dsmoe.training.gate import LearnedGate
from dsmoe.training.trainer import Trainer


@pytest.fixture
def scene(tiny_config):
    return load_scene(tiny_config, progress=False)


def gradients_of(trainer):
    """Steps a trainer, and returns the gradients that its step had."""
    seen = {}

    def keep():
        seen.update({name: tensor.grad.clone() for name, tensor in trainer.model.raw.items()
                     if tensor.grad is not None})
        if trainer.gate:
            seen["gate"] = trainer.gate.gradient.clone()

    trainer.step(keep)
    return seen


@pytest.mark.parametrize("options", [
    dict(), dict(background_gate=0.2), dict(blend_mode="alpha", random_background=True)])
def test_gradients_of_a_batch_are_the_sums_of_those_of_its_views(tiny_config, scene, options):
    config = tiny_config.changed(iterations=40, **options)
    batched = BatchTrainer(config.changed(batch=4), scene, ALONE)
    start = {name: tensor.detach().clone() for name, tensor in batched.model.raw.items()}
    actual = gradients_of(batched)
    single, sums = Trainer(config, scene), {}
    gate = single.gate.state_dict() if single.gate else {}
    gate = {name: value.clone() if isinstance(value, torch.Tensor) else dict(value) for name, value in gate.items()}
    for _ in range(4):
        single.optimizer.replace_all(start)
        single.model.active_sh_degree = 0
        if single.gate:
            single.gate.load_state_dict(gate)
        for name, gradient in gradients_of(single).items():
            sums[name] = sums[name] + gradient if name in sums else gradient
    assert set(actual) == set(sums) and actual["means3D"].any()
    for name in sums:
        # The same numbers in the same order, but that activations are differentiated once for the sum.
        torch.testing.assert_close(actual[name], sums[name], rtol=1e-5, atol=1e-6 * float(sums[name].abs().max()))


@pytest.mark.parametrize("options", [
    dict(), dict(strategy="mcmc", budget=170),
    dict(strategy="importance", budget=60, iterations=50, strategy_options="views=4,moves=0.2,removals=4")], ids=str)
def test_a_batch_of_one_is_the_usual_training(tiny_config, scene, options):
    results, config = [], tiny_config.changed(**options)
    for new in (Trainer, lambda *arguments: BatchTrainer(*arguments, ALONE)):
        trainer = new(config, scene)
        losses = [float(trainer.step().loss.detach()) for _ in range(config.iterations)]
        results.append((losses, trainer.whole_model().raw, trainer.background_gate, trainer.evaluate().metrics))
    assert results[0][0] == results[1][0] and results[0][2:] == results[1][2:]
    assert len(results[0][1]["means3D"]) != len(scene.points.positions)
    for name, tensor in results[0][1].items():
        assert torch.equal(tensor, results[1][1][name]), name


def test_rates_and_betas_follow_the_square_root_rule(tiny_config, scene):
    one, four = (BatchTrainer(tiny_config.changed(batch=batch), scene, ALONE) for batch in (1, 4))
    four.step()
    for _ in range(4):
        one.step()
    for group, batched in zip(one.optimizer.adam.param_groups, four.optimizer.adam.param_groups):
        assert batched["lr"] == pytest.approx(2 * group["lr"], rel=1e-12)
        assert batched["betas"] == pytest.approx((0.9**4, 0.999**4), rel=1e-12) != group["betas"]


@pytest.mark.parametrize("batch", [1, 4])
def test_the_rate_of_the_gate_follows_the_same_rule(batch):
    """Adam's first step is the rate, against the gradient's sign."""
    gate = LearnedGate(GateOptions(LEARNED, 0.0, 0.1, 0.03), batch, "cpu")
    gate.gradient.fill_(0.7)
    before = float(gate.logarithm)
    gate.step()
    assert float(gate.logarithm) - before == pytest.approx(-0.03 * batch**0.5, rel=1e-5)


def test_milestones_count_views(tiny_config, scene):
    """A batch of 3 passes most milestones between two steps; each comes once all the same."""
    config = tiny_config.changed(iterations=39, batch=3, checkpoint_every=0)
    trainer, happened = BatchTrainer(config, scene, ALONE), []
    strategy = trainer.strategy
    densify, reset = strategy.densify, strategy.reset_opacities
    strategy.densify = lambda *arguments: happened.append(("densify", trainer.iteration)) or densify(*arguments)
    strategy.reset_opacities = lambda: happened.append(("reset", trainer.iteration)) or reset()
    degrees = []
    for _ in range(13):
        trainer.step()
        degrees.append(trainer.model.active_sh_degree)
    assert trainer.iteration == 39
    # Multiples of 8 from 5 to 29, and of 12 below 30.
    assert happened == [("densify", 9), ("reset", 12), ("densify", 18), ("densify", 24), ("reset", 24)]
    assert degrees == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 3]


@pytest.mark.parametrize("gate", ["learned", 0.3])
def test_a_batched_run_resumes_bit_for_bit(tiny_config, tmp_path, gate):
    straight = tiny_config.changed(batch=4, background_gate=gate, output=str(tmp_path / "straight"))
    row = train(straight, progress=False)
    halted = dataclasses.replace(straight, output=str(tmp_path / "halted"))
    steps, step = [], BatchTrainer.step

    class Killed(Exception):
        pass

    def dying(self, *arguments):
        steps.append(self.iteration)
        if len(steps) == 8:
            raise Killed
        return step(self, *arguments)

    BatchTrainer.step = dying
    try:
        with pytest.raises(Killed):
            train(halted, progress=False)
    finally:
        BatchTrainer.step = step
    torch.manual_seed(99)
    resumed = train(halted, resume=True, progress=False)
    contents = []
    for config in (straight, halted):
        with open(model_path(config.output, config.iterations), "rb") as file:
            contents.append(file.read())
    assert contents[0] == contents[1] and resumed["psnr"] == row["psnr"]
    assert row["num_gaussians"] != row["protocol"]["init_points"] and row["protocol"]["batch"] == 4


@pytest.mark.skipif(not hasattr(torch.library, "register_fake"), reason="this PyTorch has no ops on the device meta")
def test_a_gate_is_resumed_on_its_own_device(tiny_config):
    """A batch's checkpoint is read to the host. The device "meta" stands for a GPU: it has no numbers, but a place."""
    trained = LearnedGate(tiny_config.gate, 1, "cpu")
    trained.step()
    resumed = LearnedGate(tiny_config.gate, 1, "meta")
    state = trained.state_dict()
    resumed.load_state_dict(state)
    tensors = {name: value for name, value in resumed.state_dict()["adam"].items() if isinstance(value, torch.Tensor)}
    assert {*tensors} == {"exp_avg", "exp_avg_sq"} and {tensor.device.type for tensor in tensors.values()} == {"meta"}
    again = LearnedGate(tiny_config.gate, 1, "cpu")
    again.load_state_dict(state)
    again.gradient.fill_(3.0)
    again.step()
    assert not state["adam"]["exp_avg"].any(), "the state that it was given stays"


@pytest.mark.parametrize("batch, ends", [(2, [46, 48, 52, 54, 58]), (5, [50, 55])])
def test_the_first_terms_of_an_average_weigh_the_same_in_batches(tiny_config, scene, monkeypatch, batch, ends):
    """A term is due behind step 42 of each three steps, and of each batch of more."""
    monkeypatch.setattr("dsmoe.training.importance_strategy.TERMS", 10)
    trainer = BatchTrainer(tiny_config.changed(strategy="importance", budget=60, iterations=60, batch=batch,
                                               strategy_options="average=10"), scene, ALONE)
    terms = []
    while trainer.iteration < 60:
        trainer.step()
        if trainer.iteration in ends:
            terms.append(trainer.model.raw["means3D"].detach().double())
    average = trainer.optimizer.average["means3D"].double()
    torch.testing.assert_close(average, sum(terms) / len(ends), rtol=1e-6, atol=1e-6)  # roundings of float32


def test_training_lowers_the_loss(tiny_config, scene):
    trainer = BatchTrainer(tiny_config.changed(batch=4, iterations=120, densify_until_iter=0), scene, ALONE)
    losses = [float(trainer.step().loss) for _ in range(30)]
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5]) and all(map(math.isfinite, losses))


@pytest.mark.parametrize("options, text", [
    (dict(batch=0), "--batch is 0; it must be at least 1"),
    (dict(batch=3), "--iterations is 40; it must be a multiple of --batch, 3")])
def test_batches_that_do_not_fit_are_refused(tiny_config, options, text):
    with pytest.raises(ConfigError, match=text):
        tiny_config.changed(**options)


def test_another_rasterizer_is_refused(tiny_config):
    with pytest.raises(TrainerError, match="rasterize is given; batches of views"):
        train(dataclasses.replace(tiny_config, batch=2), progress=False, rasterize=print)


def test_a_disturbed_rendering_does_not_count_in_batches_either(tiny_config, scene, monkeypatch):
    """As in test_loop.py: of five passes the clock disturbs one."""
    clock = iter([0.0, 0.01, 1.0, 1.99, *(2 + 0.01 * (i % 2) for i in range(16))])
    monkeypatch.setattr("dsmoe.results.evaluation.synchronised_time", lambda _: next(clock))
    evaluation = BatchTrainer(tiny_config, scene, ALONE).evaluate()
    assert [row["milliseconds"] for row in evaluation.per_view] == pytest.approx([10, 10], rel=1e-9)
    assert next(clock, None) is None
