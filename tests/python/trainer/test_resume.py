"""A killed run, resumed, ends bit for bit where an undisturbed one does; and runs are reproducible at all."""
from __future__ import annotations

import contextlib
import dataclasses
import json
import locale
import os
import resource
import shutil
import time

import pytest
import torch
from PIL import Image

from diff_smoe_rasterization import io
from dsmoe import train as runs
from dsmoe.errors import TrainerError, in_one_line
from dsmoe.options.config import TrainConfig
from dsmoe.results.modelfile import model_path
from dsmoe.scenes.scene import load_scene
from dsmoe.system import files
from dsmoe.train import train
from dsmoe.training import checkpoint, randomness, state_check
from dsmoe.training.checkpoint import load_checkpoint, save_checkpoint
from dsmoe.training.randomness import ViewOrder
from dsmoe.training.trainer import Trainer


class Killed(Exception):
    """Stands for the signal that ends a process between two steps."""


def ply_bytes(config):
    with open(model_path(config.output, config.iterations), "rb") as file:
        return file.read()


def kill_at(monkeypatch, iteration):
    """Makes the step of that iteration raise."""
    step = Trainer.step

    def dying_step(self, *arguments):
        if self.iteration + 1 == iteration:
            raise Killed
        return step(self, *arguments)

    monkeypatch.setattr(Trainer, "step", dying_step)


def killed_and_resumed(config, folder, killed_at, **options):
    """Trains undisturbed, and killed and resumed; asserts that the models are equal. Returns of both config and row."""
    straight = config.changed(output=str(folder / "straight"), **options)
    broken = dataclasses.replace(straight, output=str(folder / "broken"))
    row = train(straight, progress=False)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        kill_at(patch, killed_at)
        train(broken, progress=False)
    torch.manual_seed(12345)  # whatever happens to the generators in between must not matter
    resumed = train(broken, resume=True, progress=False)
    assert ply_bytes(broken) == ply_bytes(straight)
    return (straight, row), (broken, resumed)


@pytest.mark.parametrize("blend_mode, killed_at", [("alpha", 26), ("smoe", 26), ("smoe", 11), ("smoe", 39)])
def test_a_killed_run_resumes_bit_for_bit(tiny_config, tmp_path, blend_mode, killed_at):
    """Checkpoints are at 10, 20, 30; densifications at 8, 16, 24 and resets at 12, 24 lie on both sides."""
    (straight, row), (broken, resumed) = killed_and_resumed(tiny_config, tmp_path, killed_at, blend_mode=blend_mode)
    assert (resumed["psnr"], resumed["num_gaussians"]) == (row["psnr"], row["num_gaussians"])
    # The tiny scene must really have been densified, else nothing was shown.
    assert row["num_gaussians"] != row["protocol"]["init_points"]
    states = [load_checkpoint(os.path.join(config.output, "checkpoint.pt"), "cpu") for config in (straight, broken)]
    for name in states[0]["optimizer"]:
        for key, value in states[0]["optimizer"][name].items():
            assert torch.equal(torch.as_tensor(value), torch.as_tensor(states[1]["optimizer"][name][key])), (name, key)


@pytest.mark.parametrize("options", [
    dict(blend_mode="smoe", background_gate="learned"), dict(blend_mode="alpha", random_background=True)])
def test_a_learned_gate_and_random_backgrounds_resume_bit_for_bit(tiny_config, tmp_path, options):
    (_, row), (_, resumed) = killed_and_resumed(tiny_config, tmp_path, 26, **options)
    assert (resumed["psnr"], resumed["background_gate"]) == (row["psnr"], row["background_gate"])


@contextlib.contextmanager
def other_locale():
    before = locale.setlocale(locale.LC_ALL)
    for name in ("de_DE.UTF-8", "fr_FR.UTF-8", "C"):  # whose numbers have commas, if they are installed
        with contextlib.suppress(locale.Error):
            locale.setlocale(locale.LC_ALL, name)
            break
    yield
    locale.setlocale(locale.LC_ALL, before)


@contextlib.contextmanager
def other_time_zone():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", "Pacific/Kiritimati")
        time.tzset()
        yield
    time.tzset()


@contextlib.contextmanager
def other_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3 if before != 3 else 2)
    yield
    torch.set_num_threads(before)


@contextlib.contextmanager
def gpus(count):
    """A machine where torch sees so many GPUs. Each has a generator; those of others raise, as CUDA's do."""
    states = [torch.full((16,), number, dtype=torch.uint8) for number in range(count)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: count > 0)
        patch.setattr(torch.cuda, "device_count", lambda: count)
        patch.setattr(torch.cuda, "get_rng_state", lambda device=0: states[device])
        patch.setattr(torch.cuda, "get_rng_state_all", lambda: list(states))
        patch.setattr(torch.cuda, "set_rng_state", lambda state, device=0: states.__setitem__(device, state))
        patch.setattr(torch.cuda, "set_rng_state_all",
                      lambda all_of: [states.__setitem__(device, state) for device, state in enumerate(all_of)])
        yield states


@pytest.mark.parametrize("here, there", [
    (contextlib.nullcontext, other_locale), (contextlib.nullcontext, other_time_zone),
    (contextlib.nullcontext, other_threads), (lambda: gpus(4), lambda: gpus(1)), (lambda: gpus(4), lambda: gpus(0)),
    (lambda: gpus(0), lambda: gpus(2))], ids=["locale", "time zone", "threads", "1 of 4 GPUs", "no GPU", "new GPUs"])
def test_a_run_resumes_on_another_machine(tiny_config, tmp_path, here, there):
    """A checkpoint has nothing of the machine that wrote it."""
    config = dataclasses.replace(tiny_config, iterations=24)
    straight = dataclasses.replace(config, output=str(tmp_path / "straight"))
    train(straight, progress=False)
    with here(), pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        kill_at(patch, 21)
        train(config, progress=False)
    with there():
        train(config, resume=True, progress=False)
    assert ply_bytes(config) == ply_bytes(straight)


def test_the_generator_of_a_gpu_is_kept_and_older_files_have_those_of_all():
    with gpus(4) as others:
        others[0] = torch.full((16,), 9, dtype=torch.uint8)
        state = randomness.random_state("cuda")
        older = {**state, "cuda": torch.cuda.get_rng_state_all()}
    assert randomness.random_state("cpu")["cuda"] == []
    for each in (state, older):
        with gpus(1) as mine:
            randomness.restore_random_state(each, "cuda")
            assert len(mine) == 1 and mine[0].tolist() == [9] * 16


@pytest.mark.parametrize("error", [
    RuntimeError("CUDA error: an illegal memory access was encountered"), ModuleNotFoundError("No module named 'x'"),
    torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), MemoryError()], ids=repr)
@pytest.mark.parametrize("function", ["check_state", "load_state_dict"])
def test_a_machine_that_fails_does_not_make_a_checkpoint_damaged(tiny_config, monkeypatch, function, error):
    config = dataclasses.replace(tiny_config, iterations=2)
    train(config, progress=False)

    def fail(*_):
        raise error

    monkeypatch.setattr(Trainer, function, fail)
    with pytest.raises(type(error)) as raised:
        train(config, resume=True, progress=False)
    assert raised.value is error


def test_an_error_of_taking_a_checkpoint_over_is_no_damage(tiny_config, monkeypatch):
    """What was looked at and found whole is not to be removed, whatever happens behind that."""
    config = dataclasses.replace(tiny_config, iterations=2)
    train(config, progress=False)
    monkeypatch.setattr(Trainer, "load_state_dict", lambda *_: {}["of this program's own making"])
    with pytest.raises(KeyError, match="of this program's own making"):
        train(config, resume=True, progress=False)


def test_resume_before_the_first_checkpoint_starts_anew(tiny_config, tmp_path, monkeypatch, capsys):
    straight = dataclasses.replace(tiny_config, output=str(tmp_path / "straight"))
    train(straight, progress=False)
    with monkeypatch.context() as patch:
        kill_at(patch, 5)
        with pytest.raises(Killed):
            train(tiny_config, progress=False)
    train(tiny_config, resume=True, progress=False)
    assert "no checkpoint yet" in capsys.readouterr().out
    assert ply_bytes(tiny_config) == ply_bytes(straight)


def test_resuming_a_finished_run_changes_nothing(tiny_config):
    row = train(tiny_config, progress=False)
    before = ply_bytes(tiny_config)
    again = train(tiny_config, resume=True, progress=False)
    assert ply_bytes(tiny_config) == before
    assert again["psnr"] == row["psnr"] and again["train_seconds"] == pytest.approx(row["train_seconds"], abs=0.1)


def test_the_same_seed_gives_the_same_model_and_another_seed_another(tiny_config, tmp_path):
    models = []
    for index, seed in enumerate((5, 5, 6)):
        config = dataclasses.replace(tiny_config, seed=seed, output=str(tmp_path / str(index)))
        train(config, progress=False)
        models.append(ply_bytes(config))
    assert models[0] == models[1] != models[2]


def test_evaluations_on_the_way_do_not_change_the_result(tiny_config, tmp_path):
    other = dataclasses.replace(tiny_config, eval_every=7, checkpoint_every=0, output=str(tmp_path / "evaluated"))
    train(tiny_config, progress=False)
    train(other, progress=False)
    assert ply_bytes(other) == ply_bytes(tiny_config)
    assert os.path.isfile(os.path.join(other.output, "history.json"))


@pytest.mark.parametrize("option", ["opacity_reset_interval", "densification_interval"])
def test_the_last_iteration_neither_resets_nor_densifies(tiny_config, tmp_path, option):
    """Whether an event falls on it or after it makes no difference to what is saved."""
    models = []
    for interval in (20, 21):
        config = dataclasses.replace(tiny_config, iterations=20, output=str(tmp_path / str(interval)),
                                     **{option: interval})
        train(config, progress=False)
        models.append(ply_bytes(config))
    assert models[0] == models[1]


def test_an_evaluation_on_the_way_sees_the_model_before_its_opacity_reset(tiny_config, tmp_path):
    rows = []
    for interval in (8, 9):
        config = dataclasses.replace(tiny_config, iterations=10, eval_every=8, densification_interval=100,
                                     opacity_reset_interval=interval, output=str(tmp_path / str(interval)))
        train(config, progress=False)
        with open(os.path.join(config.output, "history.json"), encoding="utf-8") as file:
            row, = json.load(file)
        rows.append((row["iteration"], row["psnr"], row["num_gaussians"]))
    assert rows[0] == rows[1] and rows[0][0] == 8


def copied_scene(tiny_scene, folder):
    return shutil.copytree(tiny_scene, str(folder))


def rename_a_view(folder):
    model = io.read_colmap(folder)
    os.rename(os.path.join(folder, "images", "view_003.png"), os.path.join(folder, "images", "view_003b.png"))
    images = [dataclasses.replace(image, name=image.name.replace("view_003.png", "view_003b.png"))
              for image in model.images]
    io.write_colmap(model.folder, io.ColmapModel(model.cameras, images, model.points), text=True)


def move_a_point(folder):
    model = io.read_colmap(folder)
    model.points.positions[5, 1] += 0.01
    io.write_colmap(model.folder, model, text=True)


def remove_a_point(folder):
    model = io.read_colmap(folder)
    points = model.points
    io.write_colmap(model.folder, io.ColmapModel(
        model.cameras, model.images, io.Points(points.positions[1:], points.colors[1:])), text=True)


def move_a_test_camera(folder):
    model = io.read_colmap(folder)
    model.images[8].tvec[0] += 0.001  # of a training view would change the extent too
    io.write_colmap(model.folder, model, text=True)


def change_the_focal_length(folder):
    model = io.read_colmap(folder)
    model.cameras[1].params[0] += 0.01
    io.write_colmap(model.folder, model, text=True)


def darken(name):
    """An edit that makes one pixel of an image black."""
    def edit(folder):
        path = os.path.join(folder, "images", name)
        with Image.open(path) as image:
            image.load()
        image.putpixel((5, 5), (0, 0, 0))
        image.save(path)

    return edit


@pytest.mark.parametrize("edit, words", [
    (rename_a_view, "training views' names"), (move_a_point, "checksum of the points"),
    (remove_a_point, "number of points"), (move_a_test_camera, "checksum of the poses"),
    (change_the_focal_length, "checksum of the intrinsics"), (darken("view_003.png"), "of the training images"),
    (darken("view_008.png"), "of the test images")])
def test_another_scene_cannot_be_resumed(tiny_scene, tiny_config, tmp_path, edit, words):
    config = dataclasses.replace(tiny_config, iterations=2)
    train(config, progress=False)
    other = copied_scene(tiny_scene, tmp_path / "other")
    edit(other)
    with pytest.raises(TrainerError, match=f"another scene: .*{words}.*other"):
        train(dataclasses.replace(config, scene=other), resume=True, progress=False)


def test_a_moved_scene_resumes(tiny_scene, tiny_config, tmp_path):
    config = dataclasses.replace(tiny_config, iterations=2)
    row = train(config, progress=False)
    moved = copied_scene(tiny_scene, tmp_path / "moved")
    assert train(dataclasses.replace(config, scene=moved), resume=True, progress=False)["psnr"] == row["psnr"]


def test_a_killed_overwriting_run_leaves_nothing_of_the_old_one(tiny_config, monkeypatch):
    config = dataclasses.replace(tiny_config, eval_every=10)
    train(config, progress=False)
    assert sorted(os.listdir(config.output)) == [
        ".dsmoe.json", ".dsmoe.lock", "cameras.json", "checkpoint.pt", "config.json", "history.json", "loss.png",
        "per_view.json", "point_cloud", "results.json"]
    kill_at(monkeypatch, 5)
    with pytest.raises(Killed):
        train(dataclasses.replace(config, seed=1), overwrite=True, progress=False)
    assert sorted(os.listdir(config.output)) == [".dsmoe.json", ".dsmoe.lock", "config.json"]
    with pytest.raises(TrainerError, match="choose one"):
        train(config, overwrite=True, resume=True, progress=False)


def test_other_options_cannot_be_resumed(tiny_config):
    config = dataclasses.replace(tiny_config, output=f"{tiny_config.output} of mine")
    train(config, progress=False)
    words = r"--seed is 0, not 1\. `dsmoe train --resume -o '.*/out of mine'` keeps the run's options"
    with pytest.raises(TrainerError, match=words):
        train(dataclasses.replace(config, seed=1), resume=True, progress=False)
    with pytest.raises(TrainerError, match="--blend-mode"):
        train(config.changed(blend_mode="alpha"), resume=True, progress=False)


def test_a_run_is_not_overwritten_unasked(tiny_config):
    train(tiny_config, progress=False)
    with pytest.raises(TrainerError, match="--resume.*--overwrite"):
        train(tiny_config, progress=False)
    changed = dataclasses.replace(tiny_config, seed=1)
    before = ply_bytes(tiny_config)
    train(changed, overwrite=True, progress=False)
    assert ply_bytes(changed) != before


@pytest.mark.parametrize("name", ["results.json", "per_view.json", "point_cloud"])
def test_the_output_of_another_program_is_not_written_over(tiny_config, name):
    os.makedirs(tiny_config.output)
    if name == "point_cloud":
        os.makedirs(os.path.join(tiny_config.output, name))
    else:
        files.write_text_atomically(os.path.join(tiny_config.output, name), "{}")
    for options in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(TrainerError, match=f"out holds {name} but no config.json"):
            train(tiny_config, progress=False, **options)
    assert os.listdir(tiny_config.output) == [name]


def test_overwrite_removes_what_a_run_wrote_and_nothing_else(tiny_config, tmp_path):
    config = dataclasses.replace(tiny_config, iterations=3)
    output = config.output
    train(config, progress=False)
    mine = [os.path.join(output, "point_cloud", "iteration_7000", "point_cloud.ply"),
            os.path.join(output, "point_cloud", "notes.txt"), os.path.join(output, "notes.txt")]
    for path in mine:
        files.write_text_atomically(path, "mine")
    before = {name: os.path.getmtime(os.path.join(output, name)) for name in ("checkpoint.pt", "results.json")}
    with pytest.raises(TrainerError, match="no such folder"):
        train(dataclasses.replace(config, scene=str(tmp_path / "nowhere")), overwrite=True, progress=False)
    broken = copied_scene(config.scene, tmp_path / "broken")
    os.remove(os.path.join(broken, "images", "view_001.png"))
    files.write_text_atomically(os.path.join(broken, "images", "view_001.png"), "no image")
    with pytest.raises(TrainerError, match="view_001.png: not a readable image"):
        train(dataclasses.replace(config, scene=broken), overwrite=True, progress=False)
    with pytest.raises(TrainerError, match="iteration_7000.point_cloud.ply is there"):
        train(dataclasses.replace(config, iterations=7000), overwrite=True, progress=False)
    assert before == {name: os.path.getmtime(os.path.join(output, name)) for name in before}
    train(dataclasses.replace(config, iterations=2), overwrite=True, progress=False)
    assert sorted(os.listdir(os.path.join(output, "point_cloud"))) == ["iteration_2", "iteration_7000", "notes.txt"]
    for path in mine:
        with open(path, encoding="utf-8") as file:
            assert file.read() == "mine"


@pytest.mark.parametrize("name", ["point_cloud", "tensorboard"])
def test_nothing_is_written_or_removed_where_a_link_leads_out_of_the_folder(tiny_config, tmp_path, name):
    config = dataclasses.replace(tiny_config, iterations=2)
    output, elsewhere = config.output, tmp_path / "elsewhere"
    train(config, progress=False)
    elsewhere.mkdir()
    path = os.path.join(output, name)
    if os.path.isdir(path):
        os.rename(path, str(elsewhere / name))
    os.symlink(str(elsewhere / name), path)
    (elsewhere / name).mkdir(exist_ok=True)
    before = {path: os.path.getmtime(path) for path, _, _ in os.walk(elsewhere)}
    for options in ({"overwrite": True}, {"resume": True}):
        with pytest.raises(TrainerError, match=f"leads to {elsewhere / name}.* by a link"):
            train(config, progress=False, **options)
    assert before == {path: os.path.getmtime(path) for path, _, _ in os.walk(elsewhere)}
    os.remove(path)
    os.symlink(str(tmp_path / "nowhere"), path)
    with pytest.raises(TrainerError, match="nowhere.* by a link|point_cloud is not a folder"):
        train(config, overwrite=True, progress=False)
    os.rename(output, str(tmp_path / "real"))
    os.symlink(str(tmp_path / "real"), output)  # the folder itself may be one
    os.remove(path)
    train(config, overwrite=True, progress=False)


def test_a_link_in_the_place_of_a_product_is_named(tiny_config, tmp_path):
    config = dataclasses.replace(tiny_config, iterations=2)
    train(config, progress=False)
    path = os.path.join(config.output, "results.json")
    os.rename(path, str(tmp_path / "precious"))
    os.symlink(str(tmp_path / "precious"), path)
    with pytest.raises(TrainerError, match="results.json is a link, which is never replaced"):
        train(config, overwrite=True, progress=False)
    assert os.path.islink(path)


@pytest.mark.parametrize("step", [0, 1, 2])
def test_what_an_overwriting_run_leaves_that_is_killed_as_it_begins_is_not_gone_on_with(tiny_config, monkeypatch, step):
    """After 0, 1 or 2 of its removals: the old run whole, or none."""
    config, removals, remove = dataclasses.replace(tiny_config, iterations=4), [], runs.remove_files
    train(config, progress=False)

    def killed(*arguments):
        if len(removals) == step:
            raise Killed
        removals.append(arguments)
        remove(*arguments)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(runs, "remove_files", killed)
        patch.setattr(TrainConfig, "save", killed)
        train(dataclasses.replace(config, seed=1), overwrite=True, progress=False)
    assert os.path.isfile(os.path.join(config.output, "config.json")) == (step == 0)
    assert os.path.isfile(os.path.join(config.output, "checkpoint.pt")) == (step < 2)
    train(dataclasses.replace(config, seed=1), overwrite=step == 0, progress=False)
    assert TrainConfig.load(config.output).seed == 1


@pytest.mark.parametrize("moved", [True, False])
def test_a_folder_that_goes_during_the_training_ends_it(tiny_config, tmp_path, monkeypatch, moved):
    config, new, step = dataclasses.replace(tiny_config, checkpoint_every=2), str(tmp_path / "a new"), Trainer.step

    def step_without_folder(self, *arguments):
        if self.iteration == 2:
            os.rename(config.output, new)
            if not moved:
                shutil.rmtree(new)
                os.mkdir(config.output)  # such as another run's
        return step(self, *arguments)

    monkeypatch.setattr(Trainer, "step", step_without_folder)
    words = f"out has been moved to {new} .* --resume -o '{new}'" if moved else "out has been removed"
    with pytest.raises(TrainerError, match=words):
        train(config, progress=False)
    assert not os.path.isdir(config.output) or not os.listdir(config.output)


def test_a_run_has_its_folder_alone(tiny_config, monkeypatch):
    config, refused = dataclasses.replace(tiny_config, iterations=3), []
    step = Trainer.step

    def step_beside_others(self, *arguments):
        for options in ({"resume": True}, {"overwrite": True}):
            with pytest.raises(TrainerError, match=f"another run .*process {os.getpid()} on "):
                train(config, progress=False, **options)
            refused.append(options)
        return step(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", step_beside_others)
        train(config, progress=False)
    assert len(refused) == 6
    files.write_text_atomically(os.path.join(config.output, ".dsmoe.lock"), "process 1 on this machine, which crashed")
    train(config, resume=True, progress=False)
    os.remove(os.path.join(config.output, ".dsmoe.json"))  # the run is of an earlier version
    train(dataclasses.replace(config, iterations=2), overwrite=True, progress=False)
    assert os.listdir(os.path.join(config.output, "point_cloud")) == ["iteration_2"]


class Stranger:
    """What loading with weights_only=False would run."""

    def __reduce__(self):
        return exec, ("raise SystemExit",)


def test_a_damaged_checkpoint_is_named(tiny_config, tmp_path, monkeypatch):
    path = str(tmp_path / "checkpoint.pt")

    def refused(words="checkpoint.pt: not a readable checkpoint; remove it"):
        with pytest.raises(TrainerError, match=words) as error:
            load_checkpoint(path, "cpu")
        assert "weights_only" not in str(error.value)

    refused("no such checkpoint")
    save_checkpoint(path, {"tensor": torch.ones(1000)})
    with open(path, "rb") as file:
        content = file.read()
    middle = content.index(torch.ones(10).numpy().tobytes())
    flipped = content[:middle] + b"\1" + content[middle + 1:]
    for damaged in (b"", content[:len(content) // 2], flipped):
        with open(path, "wb") as file:
            file.write(damaged)
        refused()
    for strange in ({"format": checkpoint.FORMAT, "plain": "{", "tensors": {}}, Stranger()):
        torch.save(strange, path)
        refused()
    monkeypatch.setattr(checkpoint, "SAFE_LOAD", False)
    refused("remove it.*load no stranger")
    torch.save({"format": -1}, path)
    refused("another version; finish the run with that version, or begin anew with --overwrite")
    tiny_config.save(tiny_config.output)
    save_checkpoint(os.path.join(tiny_config.output, "checkpoint.pt"), {"config": {}})
    with pytest.raises(TrainerError, match="checkpoint.pt: not a readable checkpoint"):
        train(tiny_config, resume=True, progress=False)


def test_no_number_of_a_checkpoint_is_gone_on_with_that_no_training_has(tiny_config):
    """Each tensor that a step changes, for each strategy: NaN, infinities, and memory that a step cannot write into."""
    for options in ({"strategy": "3dgs"}, {"strategy": "importance", "budget": 60, "blend_mode": "smoe_eq7"},
                    {"strategy": "mcmc", "budget": 160}):
        config = tiny_config.changed(iterations=38, output=f"{tiny_config.output}_{options['strategy']}", **options)
        train(config, progress=False)
        path = os.path.join(config.output, "checkpoint.pt")
        state = load_checkpoint(path, "cpu")
        run = runs.Run(Trainer(config, load_scene(config, progress=False)), progress=False)
        assert run.resume()
        tensors = dict(state_check._tensors(state, state_check.CHANGING))
        assert len(tensors) > 6 * 3 and "gate/adam/exp_avg" in tensors
        for place, tensor in tensors.items():
            wrong = {"NaN": float("nan"), "infinity": float("inf")}
            if place.endswith("_sq"):
                wrong["negative"] = -1e-12
            if place == "raw/scales":
                wrong["overflows as a scale"] = 1e30
            alterations = {name: last_is(tensor, value) for name, value in wrong.items()}
            if len(tensor) > 1:
                alterations["strides"] = torch.stack([tensor, tensor], -1)[..., 0]
                alterations["expanded"] = tensor[:1].expand_as(tensor)
            for name, value in alterations.items():
                with pytest.raises(state_check.Misfit, match=f"its `{place}` is .*; it must be "):
                    run.trainer.check_state(altered(state, place, value))
                    pytest.fail(f"{place}: {name}")
    both = altered(state, "optimizer/dc/exp_avg_sq", state["optimizer"]["dc"]["exp_avg"].abs_())
    save_checkpoint(path, both)
    with pytest.raises(TrainerError, match="`tensors` is in the same memory; it must be apart"):
        run.resume()


def last_is(tensor, value):
    """A copy whose last element has another value."""
    copy = tensor.clone()
    copy.view(-1)[-1] = value
    return copy


@pytest.mark.parametrize("checkpoint_every", [10, 0])
@pytest.mark.parametrize("name, value, words", [
    ("means3D", float("nan"), "`raw/means3D` is NaN, infinite or out of range in 1 of"),
    ("scales", 100.0, "`raw/scales` is .*; it must be below 88.7")])
def test_a_training_that_diverges_in_its_parameters_ends_with_an_error(tiny_config, monkeypatch, name, value, words,
                                                                        checkpoint_every):
    """The rasterizer leaves out such a Gaussian, so the loss says nothing. The last good checkpoint stays."""
    step = Trainer.step

    def diverging_step(self, *arguments):
        done = step(self, *arguments)
        if self.iteration == 13:
            with torch.no_grad():
                self.model.raw[name][0, 0] = value
        return done

    monkeypatch.setattr(Trainer, "step", diverging_step)
    config = tiny_config.changed(checkpoint_every=checkpoint_every, iterations=20, densify_until_iter=0)
    with pytest.raises(TrainerError, match=f"iteration 20: the training has diverged, its {words}.*; lower the"):
        train(config, progress=False)
    assert not os.path.exists(os.path.join(config.output, "point_cloud"))
    checkpoint = os.path.join(config.output, "checkpoint.pt")
    assert os.path.exists(checkpoint) == bool(checkpoint_every)
    if checkpoint_every:
        assert load_checkpoint(checkpoint, "cpu")["iteration"] == 10


def altered(state, path, value):
    """A copy of nested dictionaries and lists with another value, or value(the old one), at a/b/0."""
    name, _, rest = path.partition("/")
    key = int(name) if isinstance(state, list) else name
    copy = list(state) if isinstance(state, list) else dict(state)
    copy[key] = altered(copy[key], rest, value) if rest else value(copy.get(key) if isinstance(copy, dict)
                                                                   else copy[key]) if callable(value) else value
    return copy


ALTERATIONS = [
    *(("iteration", value) for value in (-5, 0, 10**9, float("nan"), "10", None, True, [10], 39.5)),
    *(("train_seconds", value) for value in (float("nan"), float("inf"), -1, "1", None)),
    *(("active_sh_degree", value) for value in (-1, 4, 1.5, "1", None)),
    *((f"raw/{name}", change) for name in ("means3D", "shs", "rotations") for change in (
        lambda rows: rows[1:], lambda rows: rows[:, :2], lambda rows: rows.double(),
        lambda rows: rows.tolist(), lambda rows: None)),
    ("raw", lambda raw: {name: rows[:0] for name, rows in raw.items()}),
    ("raw", lambda raw: {name: rows for name, rows in raw.items() if name != "dc"}), ("raw/more", torch.ones(3)),
    ("optimizer/more", {}), ("optimizer/dc", {}), ("optimizer/dc/step", -1), ("optimizer/dc/step", float("nan")),
    ("optimizer/dc/step", "many"), ("optimizer/dc/step", "1"), ("optimizer/dc/step", 1.0), ("optimizer/dc/step", 3),
    ("optimizer/dc/exp_avg", lambda rows: rows[1:]), ("optimizer", [1]),
    ("optimizer/scales/exp_avg_sq", lambda rows: rows.half()), ("optimizer/scales/exp_avg_sq", 1.0),
    ("strategy", {}), ("strategy/more", 1), ("strategy/view_count", lambda rows: rows[1:]),
    ("strategy/gradient_sum", lambda rows: torch.stack([rows, rows], -1)[..., 0]),
    ("optimizer/dc/exp_avg", lambda rows: rows[:1].expand_as(rows)), ("strategy/gradient_sum", lambda rows: rows.int()),
    ("strategy/gradient_sum", None), ("strategy", None),
    ("average", None), ("average", {"dc": torch.ones(3)}), ("average", lambda _: {"background_gate": torch.ones(1)}),
    ("average/dc", lambda rows: rows[1:]), ("average/scales", lambda rows: rows + 1e3),
    ("average/shs", lambda rows: rows / 0), ("average/background_gate", torch.ones(2)),
    ("gate", None), ("gate/logarithm", torch.ones(2)), ("gate/logarithm", 1.0),
    ("gate/logarithm", torch.full((1,), float("nan"))), ("gate/logarithm", torch.full((1,), 1e3)),
    ("gate/adam/exp_avg", torch.ones(2)), ("gate/adam/exp_avg", [0.0]), ("gate/adam/step", "1"),
    ("gate/adam/step", True), ("gate/adam/exp_avg_sq", torch.full((1,), -1.0)), ("gate/adam/more", 1),
    ("gate/logarithm", torch.full((1,), -1e3)),
    ("order/left", [0, 0]), ("order/left", [7]), ("order/left", [-1]), ("order/left", ["0"]), ("order/left", None),
    ("order/random/1", lambda numbers: numbers[1:]), ("order/random/1/624", 10**6), ("order/random/2", "1"),
    ("random/python/1/0", -1), ("random/python/0", 9), ("random/numpy/0", "other"), ("random/numpy/1", [1, 2]),
    ("random/torch", torch.ones(3)), ("random/torch", lambda numbers: numbers[1:]), ("random/torch", "1"),
    ("random/cuda", [1]), ("random/cuda", None), ("random", {}),
    ("history", None), ("history", [1]), ("losses", [1]), ("losses", [[1, "2"]]), ("losses", [[1, float("nan")]]),
    ("losses", [[10**400, 1.0]]), ("losses", [[-1, 1.0]]),
   
    ("config/iterations", 10**6), ("config/iterations", "40"), ("config", None), ("config", {}), ("config/seed", "0"),
    ("config/more", 1), ("scene", None), ("scene", {}), ("scene/extent", None)]


def test_a_checkpoint_that_is_no_state_of_the_run_is_named_and_not_begun_with(tiny_config, monkeypatch):
    config = dataclasses.replace(tiny_config, iterations=20)
    train(config, progress=False)
    path, begun = os.path.join(config.output, "checkpoint.pt"), []
    state = load_checkpoint(path, "cpu")
    run = runs.Run(Trainer(config, load_scene(config, progress=False)), progress=False)
    monkeypatch.setattr(run.trainer, "load_state_dict", begun.append)
    state["average"] = {"background_gate": torch.ones(1), **{name: rows.clone() for name, rows in state["raw"].items()}}
    save_checkpoint(path, state)
    assert run.resume() and len(begun) == 1 and state["gate"]["adam"]
    for place, value in ALTERATIONS:
        save_checkpoint(path, altered(state, place, value))
        with pytest.raises(TrainerError, match="checkpoint.pt: (not a readable checkpoint|no state of this run: its `.*"
                                               "it must be )|of a run (with other options|on another scene)") as error:
            run.resume()
        assert len(begun) == 1, place
        assert "weights_only" not in str(error.value)


def test_a_checkpoint_returns_what_it_was_given(tmp_path):
    path = str(tmp_path / "checkpoint.pt")
    state = {"a": {"b": [1, 0.1, None, torch.arange(3)], "c": "text"}, "d": torch.ones(2, dtype=torch.uint8)}
    save_checkpoint(path, state)
    loaded = load_checkpoint(path, "cpu")
    assert loaded["a"]["b"][:3] == [1, 0.1, None] and loaded["a"]["c"] == "text"
    assert torch.equal(loaded["a"]["b"][3], torch.arange(3)) and torch.equal(loaded["d"], state["d"])


def test_a_write_that_fails_leaves_the_old_file(tmp_path):
    path = str(tmp_path / "file")
    files.write_text_atomically(path, "old")

    def fails(file):
        file.write(b"new, but not whole")
        raise OSError("disk full")

    with pytest.raises(OSError, match=f"disk full: '{path}'"):
        files.write_atomically(path, fails)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))  # like a full disk; torch has its own error for that
    try:
        with pytest.raises(OSError, match=f"File too large: '{path}'"):
            save_checkpoint(path, {"tensor": torch.ones(10_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with open(path, encoding="utf-8") as file:
        assert file.read() == "old"
    assert os.listdir(tmp_path) == ["file"]


def test_an_error_of_an_unfinished_file_names_the_file(tmp_path):
    path = str(tmp_path / "model.ply")
    with pytest.raises(OSError) as error, files.new_file(path) as temporary:
        os.mkdir(temporary)
        with open(temporary, "wb"):
            pass
    assert in_one_line(error.value) == f"{path}: Is a directory"


def test_processes_do_not_share_an_unfinished_file_and_what_a_killed_one_left_goes(tmp_path):
    """A file FILE.part may be the user's."""
    path, others = str(tmp_path / "file"), tmp_path / "file.part"
    left = tmp_path / f"{files.PART}0123456789abcdef-file"
    others.write_text("the user's")
    left.write_text("half")
    files.write_text_atomically(path, "mine")
    assert left.exists(), "it is not old: another process may be writing it"
    os.utime(left, (time.time() - 2 * files.ABANDONED,) * 2)
    with files.new_file(path) as mine:
        assert not left.exists()
        files.write_text_atomically(mine, "mine, the later one")
        files.write_text_atomically(path, "the other's")
        assert (tmp_path / "file").read_text() == "the other's"
    assert (tmp_path / "file").read_text() == "mine, the later one"
    (tmp_path / "file").unlink()
    with pytest.raises(TrainerError, match="file is there already"), files.new_file(path, overwrite=False) as mine:
        files.write_text_atomically(mine, "mine")
        files.write_text_atomically(path, "the other's, which is first")
    assert (tmp_path / "file").read_text() == "the other's, which is first"
    assert sorted(os.listdir(tmp_path)) == sorted(["file", "file.part"])


@pytest.mark.parametrize("what, make", [
    ("a link", lambda path: os.symlink("precious", path)), ("not a regular file", os.mkfifo), ("a folder", os.mkdir)])
def test_what_is_no_regular_file_is_never_replaced(tmp_path, what, make):
    path = str(tmp_path / "file")
    make(path)
    for overwrite in (True, False):
        with pytest.raises(TrainerError, match=f"file is {what}, which is never replaced"):
            files.write_atomically(path, lambda file: file.write(b"new"), overwrite)
    assert os.listdir(tmp_path) == ["file"] and not os.path.isfile(path)


def test_json_holds_null_where_it_has_no_number(tmp_path):
    path = str(tmp_path / "file.json")
    files.write_json_atomically(path, [{"psnr": float("inf"), "ssim": 1.0}, (float("nan"), 2)])
    with open(path, encoding="utf-8") as file:
        text = file.read()
    assert json.loads(text) == [{"psnr": None, "ssim": 1.0}, [None, 2]] and "NaN" not in text


def test_a_loss_that_is_not_finite_is_not_saved(tiny_config, monkeypatch):
    step = Trainer.step

    def diverging_step(self, *arguments):
        done = step(self, *arguments)
        if self.iteration == 3:
            done.loss = done.loss * float("nan")
        return done

    monkeypatch.setattr(Trainer, "step", diverging_step)
    with pytest.raises(TrainerError, match="iteration 3: the loss is nan"):
        train(dataclasses.replace(tiny_config, checkpoint_every=3), progress=False)
    assert sorted(os.listdir(tiny_config.output)) == [".dsmoe.json", ".dsmoe.lock", "config.json"]


def test_views_come_once_each_in_random_order():
    order = ViewOrder(10, seed=0)
    epochs = [[order.next() for _ in range(10)] for _ in range(5)]
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 5
    twin = ViewOrder(10, seed=1)
    order.next()
    twin.load_state_dict(order.state_dict())
    assert [order.next() for _ in range(25)] == [twin.next() for _ in range(25)]


def test_training_lowers_the_loss(tiny_config, mode):
    """The whole loop learns: a fixed set of Gaussians, the loss of the first and of a later pass over the views."""
    config = tiny_config.changed(blend_mode=mode, densify_until_iter=0, iterations=200)
    trainer = Trainer(config, load_scene(config, progress=False))
    losses = [float(trainer.step().loss.detach()) for _ in range(20 * 7)]
    assert sum(losses[-7:]) < 0.9 * sum(losses[:7]), losses
