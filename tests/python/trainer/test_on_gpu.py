"""Training on a GPU: the same course as on the CPU, every option, resume, and no waiting for the device in a step."""
from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil

import pytest
import torch
from devices import without_cuda_because

from dsmoe.cli import main
from dsmoe.distributed.trainer import BatchTrainer, new_trainer
from dsmoe.inspection import evaluate_run
from dsmoe.model import PARAMETERS
from dsmoe.options.config import TrainConfig
from dsmoe.results.modelfile import model_path
from dsmoe.scenes.scene import load_scene
from dsmoe.simplify import simplify
from dsmoe.system.group import ALONE
from dsmoe.system.process import SPARE_BYTES, return_spare_memory
from dsmoe.train import Run, train
from dsmoe.training import graphs
from dsmoe.training.passes import Passes
from dsmoe.training.room import gaussian_bytes
from dsmoe.training.trainer import Trainer

pytestmark = pytest.mark.skipif(without_cuda_because() is not None, reason=f"without CUDA: {without_cuda_because()}")


@pytest.fixture
def config(tiny_config):
    return dataclasses.replace(tiny_config, device="cuda")


@pytest.fixture
def scene(tiny_config):
    return load_scene(tiny_config, progress=False)


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_the_first_steps_are_those_of_the_cpu(tiny_config, scene, mode):
    """Until something is densified or pruned, only rounding differs."""
    config = tiny_config.changed(blend_mode=mode, densify_until_iter=0)
    trainers = [Trainer(dataclasses.replace(config, device=device), scene) for device in ("cpu", "cuda")]
    for _ in range(5):
        losses = [float(trainer.step().loss) for trainer in trainers]
        assert losses[1] == pytest.approx(losses[0], rel=1e-3)
    for name in PARAMETERS:
        if name == "rotations":
            continue  # of round Gaussians: their gradient is rounding, and Adam steps by its sign
        start = Trainer(config, scene).model.raw[name].detach().double()
        cpu, gpu = (trainer.model.raw[name].detach().cpu().double() for trainer in trainers)
        # A step of Adam is about as large for a small gradient as for a large one, so that if a gradient is near 0
        # rounding decides on its direction: up to 1 % of all numbers may go the other way, twice the distance.
        assert float((cpu - gpu).norm()) <= 2 * math.sqrt(0.01) * float((cpu - start).norm()), name


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_a_fixed_set_of_gaussians_ends_as_good_as_on_the_cpu(tiny_config, scene, tmp_path, mode):
    scene = dataclasses.replace(scene, test=scene.train)  # measured on what it learns
    config = tiny_config.changed(blend_mode=mode, densify_until_iter=0, iterations=300)
    configs = [dataclasses.replace(config, device=device, output=str(tmp_path / device)) for device in ("cpu", "cuda")]
    rows = [train(config, scene=scene, progress=False) for config in configs]
    start = Trainer(config, scene).evaluate().metrics["psnr"]
    assert rows[0]["psnr"] > start + 1, "the run must learn something"
    # Rounding parts the courses, as another order of views does: seeds differ by up to 0.03 dB on the CPU.
    assert rows[1]["psnr"] == pytest.approx(rows[0]["psnr"], abs=0.1)


def steps_of(trainer, count):
    for _ in range(count):
        trainer.step()


@pytest.mark.parametrize("full", [0.8, 0.0], ids=["room", "each_replay_is_thought_to_have_filled_its_lists"])
@pytest.mark.parametrize("options", [
    dict(blend_mode="alpha"), dict(blend_mode="smoe", background_gate="learned", random_background=True),
    dict(blend_mode="alpha", strategy="mcmc", budget=60),
    dict(blend_mode="smoe", strategy="importance", budget=60, strategy_options="views=3,moves=0.2")], ids=str)
def test_captured_steps_give_the_bits_of_launched_ones(config, scene, monkeypatch, options, full):
    """Over densifications, moves, looks, evaluations, other losses, degrees and masks, and a break on the way."""
    monkeypatch.setattr(graphs, "WARM_UP", 3)
    monkeypatch.setattr(graphs, "FULL", full)
    mask = torch.randint(0, 256, (1, 24, 32), dtype=torch.uint8)
    views = [dataclasses.replace(view, mask=mask if index % 3 else None) for index, view in enumerate(scene.train)]
    scene, config = dataclasses.replace(scene, train=views), config.changed(deterministic=True, **options)
    launched, captured, broken, resumed = (Trainer(config, scene) for _ in range(4))
    launched.passes._graphs = graphs.NoGraphs()
    replays = []
    monkeypatch.setattr(graphs.Captured, "draw", lambda self, *arguments, real=graphs.Captured.draw: (
        replays.append(self), real(self, *arguments))[1])
    for trainer in (launched, captured):
        torch.manual_seed(7)
        for step in range(40):
            trainer.step(trainer.evaluate if step % 7 == 6 else None)
    assert len(replays) > 10 and len(set(replays)) > 2
    torch.manual_seed(7)
    steps_of(broken, 21)
    resumed.load_state_dict(broken.state_dict())
    steps_of(resumed, 19)
    for other in (captured, resumed):
        for name in PARAMETERS:
            assert torch.equal(launched.model.raw[name], other.model.raw[name]), name
        assert launched.training_psnr() == other.training_psnr()
        assert launched.background_gate == other.background_gate


@pytest.mark.parametrize("always", [False, True])
def test_without_memory_for_a_capture_the_bits_stay(config, scene, monkeypatch, capsys, always):
    """Torch refuses the first pool, which asks for a petabyte and more; the next one too, or else that is captured."""
    monkeypatch.setattr(graphs, "WARM_UP", 3)
    launched, short = (Trainer(dataclasses.replace(config, deterministic=True), scene) for _ in range(2))
    launched.passes._graphs, of_short = graphs.NoGraphs(), short.passes._graphs
    of_short._bytes = 2.0**50
    if always:
        monkeypatch.setattr(graphs.CudaGraphs, "_free", lambda self, free=graphs.CudaGraphs._free: (
            free(self), setattr(self, "_bytes", 2.0**50)))
    for trainer in (launched, short):
        torch.manual_seed(7)
        steps_of(trainer, 20)
    assert (of_short._keeper is None) == always
    assert ("no memory for steps as CUDA graphs" in capsys.readouterr().err) == always
    for name in PARAMETERS:
        assert torch.equal(launched.model.raw[name], short.model.raw[name]), name


@pytest.mark.parametrize("options", [dict(), dict(background_gate="learned", random_background=True)])
def test_a_step_does_not_wait_for_the_device(config, scene, monkeypatch, options):
    monkeypatch.setattr(graphs, "WARM_UP", 12)  # launched, captured and replayed below
    trainer = Trainer(dataclasses.replace(config, densify_until_iter=0, **options), scene)
    for _ in range(8):
        trainer.step()  # every view once: cameras are sent, memory is taken
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(8):
            trainer.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert all(torch.isfinite(trainer.model.raw[name]).all() for name in PARAMETERS)


def test_no_more_fit_than_the_gpu_has_memory_for(config, scene):
    trainer = Trainer(config, scene)
    size = gaussian_bytes(config)
    assert 0.5 * torch.cuda.mem_get_info()[0] < trainer.room() * size <= torch.cuda.mem_get_info()[1]


@pytest.mark.parametrize("strategy", ["3dgs", "steady", "importance", "mcmc"])
@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_a_whole_run(config, strategy, mode):
    budget = 100 if strategy in ("importance", "mcmc") else 0
    config = config.changed(strategy=strategy, budget=budget, blend_mode=mode, eval_every=10)
    row = train(config, progress=False)
    assert not budget or row["num_gaussians"] == budget
    assert row["protocol"]["device"] == "cuda" and math.isfinite(row["psnr"]) and row["fps"] > 0
    with open(os.path.join(config.output, "history.json"), encoding="utf-8") as file:
        assert [entry["iteration"] for entry in json.load(file)] == [10, 20, 30]


def test_a_run_with_few_points_and_other_options(config):
    # A few iterations after a reset of the opacities, on white, 20 Gaussians would be pruned: "steady" resets none.
    config = config.changed(init_points=20, white_background=True, antialiasing=True, sh_degree=1, strategy="steady")
    row = train(config, progress=False)
    assert row["protocol"]["init_points"] == 20 and row["num_gaussians"] > 0 and math.isfinite(row["psnr"])


@pytest.mark.parametrize("batch", [1, 5])
def test_a_resumed_run_goes_on_where_it_stopped(config, scene, batch):
    config = config.changed(checkpoint_every=15, batch=batch)
    run = Run(new_trainer(config, scene), progress=False)
    os.makedirs(config.output, exist_ok=True)
    for _ in range(15 // batch):
        run.trainer.step()
    run.save_checkpoint()
    twin = Run(new_trainer(config, scene), progress=False)
    assert twin.resume() and twin.trainer.iteration == 15
    for name in PARAMETERS:
        mine, theirs = run.trainer.model.raw[name], twin.trainer.model.raw[name]
        assert theirs.device.type == "cuda" and torch.equal(mine, theirs)
        assert torch.equal(run.trainer.optimizer.adam.state[mine]["exp_avg"],
                           twin.trainer.optimizer.adam.state[theirs]["exp_avg"])
    for mine, theirs in zip(run.trainer.gate._adam.values(), twin.trainer.gate._adam.values()):
        assert mine == theirs and torch.as_tensor(mine).device == torch.as_tensor(theirs).device
    assert twin.trainer.order.state_dict() == run.trainer.order.state_dict()
    assert math.isfinite(twin.train()["psnr"]) and twin.trainer.iteration == config.iterations


@pytest.mark.parametrize("photographs", [True, False])
def test_a_model_is_simplified_as_on_the_cpu(tiny_scene, tmp_path, photographs):
    """From the same image to as good a model; without photographs both have the model's renderings."""
    config = TrainConfig(scene=tiny_scene, output=str(tmp_path / "model"), blend_mode="alpha", iterations=250,
                         strategy="steady", densify_from_iter=20, densify_until_iter=200, densification_interval=20,
                         sh_degree=1, sh_degree_interval=50, checkpoint_every=0)
    train(config, progress=False)
    model = config.output if photographs else str(tmp_path / "3dgs")
    if not photographs:
        shutil.copytree(os.path.join(config.output, "point_cloud"), os.path.join(model, "point_cloud"))
        shutil.copy(os.path.join(config.output, "cameras.json"), model)
    quality = {}
    for device in ("cpu", "cuda"):
        row = simplify(model, str(tmp_path / device), keep=0.5, iterations=120, device=device, progress=False)
        if photographs:
            assert row["start"]["psnr"] == pytest.approx(results_psnr(config.output), abs=0.01), "8-bit rounding"
        quality[device] = evaluate_run(str(tmp_path / device), device, "train", progress=False)["psnr"]
    # Five seeds on the CPU lie within 0.1 dB of each other, and the model itself is 0.8 dB below them.
    assert quality["cuda"] == pytest.approx(quality["cpu"], abs=0.4)


def results_psnr(output):
    with open(os.path.join(output, "results.json"), encoding="utf-8") as file:
        return json.load(file)[0]["psnr"]


def test_memory_that_a_run_never_needed_goes_back():
    torch.cuda.empty_cache()
    torch.zeros(SPARE_BYTES + (1 << 29), dtype=torch.uint8, device="cuda")  # freed at once, and kept by torch
    return_spare_memory(torch.device("cuda"))  # all of it has been needed
    assert torch.cuda.memory_reserved() > SPARE_BYTES
    torch.cuda.reset_peak_memory_stats()
    return_spare_memory(torch.device("cuda"))
    assert torch.cuda.memory_reserved() < SPARE_BYTES


def test_targets_lie_on_the_device_as_bytes(config, scene):
    trainer = Trainer(config, scene)
    assert all(view.image.device.type == "cuda" and view.image.dtype == torch.uint8 for view in trainer.scene.train)


def test_a_deterministic_training_over_batches_repeats_bit_for_bit(config, scene):
    results = []
    for _ in range(2):
        trainer = BatchTrainer(config.changed(batch=4, deterministic=True), scene, ALONE)
        for _ in range(config.iterations // 4):
            trainer.step()
        results.append({name: tensor.detach().clone() for name, tensor in trainer.model.raw.items()})
    assert len(results[0]["means3D"]) != len(scene.points.positions)
    for name in PARAMETERS:
        assert torch.equal(results[0][name], results[1][name]), name


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_a_look_at_footprints_is_one_at_gaussians(config, scene, mode):
    """The same bits, of the same image."""
    trainer = BatchTrainer(config.changed(batch=4, deterministic=True, blend_mode=mode), scene, ALONE)
    steps_of(trainer, 3)
    looks = zip(Passes.look(trainer.passes, trainer.scene.train), trainer.passes.look(trainer.scene.train))
    for usual, by_footprints in looks:
        assert usual.costs.any() and torch.equal(usual.costs, by_footprints.costs)
        assert usual.errors.any() and torch.equal(usual.errors, by_footprints.errors)


def test_a_deterministic_training_to_a_budget_repeats_bit_for_bit(config, scene):
    """`importance` removes and moves by importance, so the sums of importance must repeat too."""
    results = []
    for _ in range(2):
        trainer = Trainer(config.changed(deterministic=True, strategy="importance", budget=60), scene)
        for _ in range(config.iterations):
            trainer.step()
        results.append({name: tensor.detach().clone() for name, tensor in trainer.model.raw.items()})
    assert len(results[0]["means3D"]) == 60
    for name in PARAMETERS:
        assert torch.equal(results[0][name], results[1][name]), name


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
@pytest.mark.parametrize("options", [
    dict(), dict(strategy="mcmc", budget=170),
    dict(strategy="importance", budget=60, iterations=60, strategy_options="removals=4,views=5,moves=0.2")], ids=str)
def test_two_gpus_train_the_bits_of_one(config, tmp_path, options):
    """From the same start, and from a checkpoint of one GPU. The background's gate is learned."""
    config = config.changed(batch=4, deterministic=True, output=str(tmp_path / "one"), checkpoint_every=20, **options)
    others = [dataclasses.replace(config, output=str(tmp_path / folder)) for folder in ("two", "resumed")]
    train(config, progress=False)
    broken = Run(new_trainer(others[1], load_scene(config, progress=False)), progress=False)
    os.makedirs(others[1].output)
    others[1].save(others[1].output)
    steps_of(broken.trainer, 5)
    broken.save_checkpoint()
    words = ["train", config.scene, "-o", others[0].output, "--gpus", "2", "--quiet", "--deterministic"]
    for name in ("batch", "budget", "strategy", "strategy_options", "iterations", "blend_mode", "sh_degree_interval",
                 "densify_from_iter", "densify_until_iter", "densification_interval", "opacity_reset_interval",
                 "densify_grad_threshold", "position_lr_max_steps"):
        words.append(f"--{name.replace('_', '-')}={getattr(config, name)}")
    assert main(words) == 0 and main(["train", "--resume", "-o", others[1].output, "--gpus", "2", "--quiet"]) == 0
    models = []
    for each in (config, *others):
        with open(model_path(each.output, config.iterations), "rb") as file:
            models.append(file.read())
    assert models[0] == models[1] == models[2]
