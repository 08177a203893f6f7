"""One step and its order: SH degrees, learning rate, the last iteration, the hooks of a strategy, evaluation."""
from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from diff_smoe_rasterization.trainer.errors import TrainerError
from diff_smoe_rasterization.trainer.loop import Run, Trainer
from diff_smoe_rasterization.trainer.scene import load_scene
from diff_smoe_rasterization.trainer.strategy import STRATEGIES, Strategy


@pytest.fixture
def scene(tiny_config):
    return load_scene(tiny_config, progress=False)


def raw_copy(trainer):
    return {name: tensor.detach().clone() for name, tensor in trainer.model.raw.items()}


def test_sh_degrees_rise_at_their_interval(tiny_config, scene):
    trainer = Trainer(dataclasses.replace(tiny_config, sh_degree_interval=3, sh_degree=2), scene)
    degrees = []
    for _ in range(10):
        trainer.step()
        degrees.append(trainer.model.active_sh_degree)
    assert degrees == [0, 0, 1, 1, 1, 2, 2, 2, 2, 2]


def test_the_position_rate_follows_the_iteration(tiny_config, scene):
    config = dataclasses.replace(tiny_config, position_lr_max_steps=4)
    trainer = Trainer(config, scene)
    rates = []
    for _ in range(5):
        trainer.step()
        rates.append(trainer.optimizer.adam.param_groups[0]["lr"] / scene.extent)
    expected = [0.00016 * 0.01 ** (min(step, 4) / 4) for step in range(1, 6)]
    assert rates == pytest.approx(expected, rel=1e-9)


def test_the_last_iteration_does_not_step(tiny_config, scene):
    trainer = Trainer(dataclasses.replace(tiny_config, iterations=3, densify_until_iter=0), scene)
    states = [raw_copy(trainer)]
    for _ in range(3):
        trainer.step()
        states.append(raw_copy(trainer))
    assert not torch.equal(states[1]["means3D"], states[2]["means3D"])
    assert all(torch.equal(states[2][name], states[3][name]) for name in states[2])


def test_a_strategy_sees_every_stage_of_a_step(tiny_config, scene, monkeypatch):
    seen = []

    class Recorder(Strategy):
        def before_backward(self, step):
            seen.append(("before", step.iteration, self.context.model.raw["means3D"].grad is None,
                         step.means2D.grad is None))

        def after_backward(self, step):
            assert step.means2D.grad.shape == (self.context.model.num_gaussians, 3) and step.means2D.grad.any()
            self.before_step = self.context.model.raw["means3D"].detach().clone()
            other = self.context.render(self.context.cameras[0], outputs=("alpha",))
            seen.append(("after", tuple(other.alpha.shape), bool((step.rendering.radii > 0).any())))

        def after_step(self, step):
            seen.append(("stepped", not torch.equal(self.before_step, self.context.model.raw["means3D"])))

    monkeypatch.setitem(STRATEGIES, "3dgs", Recorder)
    trainer = Trainer(tiny_config, scene)
    trainer.step()
    assert seen == [("before", 1, True, True), ("after", (1, 24, 32), True), ("stepped", True)]


def test_evaluation_counts_every_view_once(tiny_config, scene):
    trainer = Trainer(tiny_config, scene)
    evaluation = trainer.evaluate()
    assert [row["name"] for row in evaluation.per_view] == ["view_000.png", "view_008.png"]
    for name in ("psnr", "ssim", "psnr_float"):
        values = [row[name] for row in evaluation.per_view]
        assert values[0] != values[1] and evaluation.metrics[name] == pytest.approx(sum(values) / 2, rel=1e-12)
    seconds = sum(row["milliseconds"] for row in evaluation.per_view) / 1000
    assert evaluation.fps == pytest.approx(2 / seconds, rel=1e-9)


def test_evaluation_leaves_training_alone(tiny_config, scene):
    trainer, twin = Trainer(tiny_config, scene), Trainer(tiny_config, scene)
    trainer.evaluate()
    assert float(trainer.step().loss.detach()) == float(twin.step().loss.detach())


def test_training_seconds_are_those_of_the_steps(tiny_config, scene, monkeypatch):
    """Evaluation and checkpoints take no part of them."""
    clock = [0.0]
    monkeypatch.setattr("diff_smoe_rasterization.trainer.stopwatch.time.perf_counter", lambda: clock[0])
    step, save = Trainer.step, Run.save_checkpoint

    def timed(function, seconds):
        def run(*arguments):
            clock[0] += seconds
            return function(*arguments)
        return run

    monkeypatch.setattr(Trainer, "step", timed(step, 1.0))
    monkeypatch.setattr(Trainer, "evaluate", timed(lambda self, progress=False: _Evaluation(), 1000.0))
    monkeypatch.setattr(Run, "save_checkpoint", timed(save, 10_000.0))
    config = dataclasses.replace(tiny_config, iterations=20, eval_every=7, checkpoint_every=5)
    assert Run(Trainer(config, scene), progress=False).train()["train_seconds"] == pytest.approx(20.0)


class _Evaluation:
    """An evaluation that found nothing."""

    metrics = {"psnr": None, "ssim": None, "psnr_float": None}
    fps = None
    per_view = []


def test_nothing_left_to_train_is_said(tiny_config, scene):
    trainer = Trainer(tiny_config, scene)
    trainer.optimizer.keep(torch.zeros(trainer.model.num_gaussians, dtype=torch.bool))
    with pytest.raises(TrainerError, match="every Gaussian has been pruned"):
        trainer.step()


def test_a_loss_that_is_not_finite_stops_the_run(tiny_config, scene):
    trainer = Trainer(tiny_config, scene)
    step = trainer.step

    def poisoned(*arguments):
        result = step(*arguments)
        result.loss = result.loss * math.nan
        return result

    trainer.step = poisoned
    with pytest.raises(TrainerError, match="iteration 10: the loss is nan"):
        Run(trainer, progress=False).train()
