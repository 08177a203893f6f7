"""One step and its order: SH degrees, learning rate, the last iteration, the hooks of a strategy, evaluation."""
from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from diff_smoe_rasterization.losses import l1_ssim_loss
from diff_smoe_rasterization.losses import l1_ssim_loss_and_gradient as l1_ssim
from dsmoe.errors import TrainerError
from dsmoe.results.rendering import package_rasterizer
from dsmoe.scenes.scene import load_scene
from dsmoe.train import Run, train
from dsmoe.training import strategy
from dsmoe.training.gate import LearnedGate
from dsmoe.training.strategies import STRATEGIES
from dsmoe.training.strategy import Strategy
from dsmoe.training.trainer import Trainer


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


@pytest.mark.parametrize("options, start, bound, rate", [
    ({}, 0.1, 0.0, 0.03), ({"blend_mode": "smoe_eq7"}, 1.0, 0.03, 0.01),
    ({"background_gate_bound": 0.2, "background_gate_start": 2.0, "background_gate_lr": 0.04}, 2.0, 0.2, 0.04)])
def test_a_learned_gate_is_stepped_by_adam_from_its_start(tiny_config, scene, options, start, bound, rate):
    trainer = Trainer(tiny_config.changed(background_gate="learned", **options), scene)
    assert trainer.background_gate == pytest.approx(start, abs=1e-6)  # float32
    trainer.step()
    # Adam's first step is its rate, in the logarithm of what lies above the bound.
    expected = [bound + (start - bound) * math.exp(sign * rate) for sign in (-1, 1)]
    assert min(abs(trainer.background_gate - value) for value in expected) < 1e-5  # float32
    assert trainer.renderer.background_gate is trainer.gate.value and not trainer.gate.value.requires_grad


def test_a_gate_that_a_rasterizer_leaves_out_stays(tiny_config, scene):
    def rasterize(means3D, opacities, settings, **arguments):
        return package_rasterizer()(means3D, opacities, settings._replace(background_gate=0.0), **arguments)

    trainer = Trainer(tiny_config.changed(background_gate="learned"), scene, rasterize)
    trainer.step()
    assert trainer.background_gate == pytest.approx(0.1, rel=1e-6)  # its start, in float32


@pytest.mark.parametrize("push", [1, -1])
def test_a_learned_gate_without_a_bound_stays_positive_and_finite(tiny_config, push):
    """Whatever the gradient: a hundred steps of a rate of 10 would leave float32 behind."""
    gate = LearnedGate(tiny_config.changed(background_gate="learned", background_gate_lr=10.0).gate, 1, "cpu")
    for _ in range(100):
        gate.gradient.fill_(float(push))
        gate.step()
    assert 0 < float(gate.value) < math.inf
    assert (float(gate.value) < 1e-20) if push > 0 else (float(gate.value) > 1e20)


@pytest.mark.parametrize("mode, gate, expected", [
    ("smoe", "learned", 0.1), ("smoe_eq7", "learned", 1.0), ("smoe", 0.3, 0.3), ("smoe", 0.0, 0.0),
    ("alpha", None, None), ("smoe_tn", None, None)])
def test_the_rasterizer_is_told_the_gate(tiny_config, scene, mode, gate, expected):
    seen = []

    def rasterize(means3D, opacities, settings, **arguments):
        seen.append(settings.background_gate)
        return package_rasterizer()(means3D, opacities, settings, **arguments)

    trainer = Trainer(tiny_config.changed(blend_mode=mode, background_gate=gate), scene, rasterize)
    trainer.step()
    trainer.evaluate()
    if expected is None:
        assert seen[0] is None
    else:
        assert float(torch.as_tensor(seen[0]).detach()) == pytest.approx(expected, abs=1e-6)  # float32
    if gate == "learned":
        assert seen[0].requires_grad and not any(value.requires_grad for value in seen[1:])


def transparent_scene(scene):
    """The scene, its images half transparent on the left."""
    opacity = torch.full((1, 24, 32), 255, dtype=torch.uint8)
    opacity[..., :16] = 102
    black = torch.where(opacity == 255, 255, 102)

    def seen(views):
        return [dataclasses.replace(view, image=(view.image.int() * black // 255).to(torch.uint8), opacity=opacity)
                for view in views]

    return dataclasses.replace(scene, train=seen(scene.train), test=seen(scene.test))


def test_random_backgrounds_are_behind_rendering_and_image(tiny_config, scene, monkeypatch):
    """Each step has a colour of its own, which both show; evaluation is over black."""
    backgrounds, targets = [], []

    def rasterize(means3D, opacities, settings, **arguments):
        backgrounds.append(settings.bg)
        return package_rasterizer()(means3D, opacities, settings, **arguments)

    monkeypatch.setattr(strategy, "l1_ssim_loss_and_gradient",
                        lambda image, target, *others: targets.append(target) or l1_ssim(image, target, *others))
    scene = transparent_scene(scene)
    trainer = Trainer(tiny_config.changed(blend_mode="alpha", random_background=True), scene, rasterize)
    views = [trainer.step().view.camera for _ in range(4)]
    assert len({tuple(color.tolist()) for color in backgrounds}) == 4
    assert all(0 <= float(value) <= 1 for color in backgrounds for value in color)
    for camera, color, target in zip(views, backgrounds, targets):
        image = next(view.image for view in scene.train if view.camera is camera).float() / 255
        torch.testing.assert_close(target[..., 16:], image[..., 16:])
        behind = (1 - 102 / 255) * color[:, None, None]
        torch.testing.assert_close(target[..., :16], image[..., :16] + behind)
    backgrounds.clear()
    trainer.evaluate()
    assert not any(color.any() for color in backgrounds)


@pytest.mark.parametrize("gate, warned", [(0.0, True), (0.05, False)])
def test_random_backgrounds_that_are_hardly_seen_are_warned_of(tiny_config, capsys, gate, warned):
    train(tiny_config.changed(background_gate=gate, random_background=True, iterations=1), progress=False)
    assert capsys.readouterr().out.count("warning: --random-background") == warned


def masked_scene(scene, mask):
    """The scene with the mask on every view, whose ignored pixels hold noise."""

    def seen(views):
        noise = [torch.randint(0, 256, view.image.shape, dtype=torch.uint8) for view in views]
        return [dataclasses.replace(view, image=torch.where(mask > 0, view.image, other), mask=mask)
                for view, other in zip(views, noise)]

    return dataclasses.replace(scene, train=seen(scene.train), test=seen(scene.test))


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_ignored_pixels_are_neither_learned_nor_measured(tiny_config, scene, mode):
    mask = torch.zeros(1, 24, 32, dtype=torch.uint8)
    mask[..., 12:] = 255
    config, results = tiny_config.changed(blend_mode=mode), []
    for seed in (1, 2):  # of what the ignored pixels hold
        torch.manual_seed(seed)
        trainer = Trainer(config, masked_scene(scene, mask))
        steps = [trainer.step() for _ in range(9)]
        results.append((raw_copy(trainer), [float(step.loss) for step in steps], trainer.training_psnr(),
                        trainer.evaluate().metrics))
    (raw, *rest), (other_raw, *other_rest) = results
    assert rest == other_rest and all(torch.equal(raw[name], other_raw[name]) for name in raw)


def test_the_gradient_of_a_masked_loss_is_masked(tiny_config, scene):
    mask = torch.zeros(1, 24, 32, dtype=torch.uint8)
    mask[..., 12:] = 255
    mask[..., 20:] = 51
    trainer = Trainer(tiny_config, masked_scene(scene, mask))
    trainer.strategy.before_backward = lambda step: step.rendering.color.retain_grad()
    step = trainer.step()
    view = step.view
    image, weights = step.rendering.color.detach().requires_grad_(), mask.float() / 255
    loss = l1_ssim_loss(image * weights, view.image.float() / 255 * weights, tiny_config.lambda_dssim)
    loss.backward()
    torch.testing.assert_close(step.loss, loss.detach())
    torch.testing.assert_close(step.rendering.color.grad, image.grad)
    assert not image.grad[..., :12].any() and image.grad[..., 20:].any()


def test_a_row_says_that_there_were_masks(tiny_config, scene):
    mask = torch.full((1, 24, 32), 255, dtype=torch.uint8)
    rows = [train(tiny_config.changed(iterations=2), overwrite=True, progress=False, scene=each)
            for each in (scene, masked_scene(scene, mask))]
    assert "masks" not in rows[0]["protocol"] and "kept pixels" in rows[1]["protocol"]["masks"]
    # All is kept: the same figures, SSIM in doubles by another program.
    assert rows[1]["psnr"] == pytest.approx(rows[0]["psnr"], abs=1e-4)
    assert rows[1]["ssim"] == pytest.approx(rows[0]["ssim"], abs=1e-5)


def test_a_step_makes_no_settings_of_a_training_view(tiny_config, scene, monkeypatch):
    """They are there from the start, and those that its camera gives; a step would wait for the device."""
    trainer = Trainer(tiny_config, scene)
    for view in trainer.scene.train:
        expected = view.camera.settings(torch.zeros(3), 0, "smoe")
        made = trainer.renderer.settings_of(view.camera)
        for name in ("viewmatrix", "projmatrix", "campos", "bg"):
            own, other = getattr(made, name), getattr(expected, name)
            assert torch.equal(own, other) and own.is_contiguous() and own.data_ptr() % 16 == 0
        assert made._replace(**{name: None for name in ("viewmatrix", "projmatrix", "campos", "bg", "background_gate")}
                             ) == expected._replace(viewmatrix=None, projmatrix=None, campos=None, bg=None,
                                                    background_gate=None, faint_below=0.25)  # smoe's number

    def forbidden(*arguments):
        raise AssertionError("settings are made")

    monkeypatch.setattr(type(view.camera), "settings", forbidden)
    for _ in range(9):
        trainer.step()


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
            seen.append(("before", step.iteration, self.context.model.raw["means3D"].grad is None, step.seen == []))

        def after_backward(self, step):
            (gradient, radii), = step.seen
            assert gradient.shape == (self.context.model.num_gaussians, 3) and gradient.any()
            assert radii is step.rendering.radii
            self.before_step = self.context.model.raw["means3D"].detach().clone()
            other = self.context.render(self.context.views[0].camera, outputs=("alpha",))
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


def test_a_disturbed_rendering_does_not_count(tiny_config, scene, monkeypatch):
    """The clock says 10 ms for each timed rendering, but 990 ms for the second one, which the median leaves out."""
    times = iter([0.0, 0.01, 1.0, 1.99, *(2 + 0.01 * (i % 2) for i in range(16))])
    monkeypatch.setattr("dsmoe.results.evaluation.synchronised_time", lambda _: next(times))
    evaluation = Trainer(tiny_config, scene).evaluate()
    assert [row["milliseconds"] for row in evaluation.per_view] == pytest.approx([10, 10], rel=1e-9)
    assert evaluation.fps == pytest.approx(100, rel=1e-9)
    assert next(times, None) is None  # two views, five passes


def test_a_long_evaluation_has_one_pass(tiny_config, scene, monkeypatch):
    times = iter([0.0, 1.0, 1.0, 2.0])
    monkeypatch.setattr("dsmoe.results.evaluation.synchronised_time", lambda _: next(times))
    assert Trainer(tiny_config, scene).evaluate().fps == 1


def test_evaluation_leaves_training_alone(tiny_config, scene):
    trainer, twin = Trainer(tiny_config, scene), Trainer(tiny_config, scene)
    trainer.evaluate()
    assert float(trainer.step().loss.detach()) == float(twin.step().loss.detach())


def test_training_seconds_are_those_of_the_steps(tiny_config, scene, monkeypatch):
    """Evaluation and checkpoints take no part of them."""
    clock = [0.0]
    monkeypatch.setattr("dsmoe.system.stopwatch.time.perf_counter", lambda: clock[0])
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
