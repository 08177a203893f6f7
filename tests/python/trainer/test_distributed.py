"""One scene trained by several processes, over gloo: the bits of one process, whatever dies on the way."""
from __future__ import annotations

import dataclasses
import datetime
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time

import pytest
import torch
import torch.distributed

import diff_smoe_rasterization
from dsmoe.cli import main
from dsmoe.distributed.shards import run_of
from dsmoe.errors import TrainerError
from dsmoe.results.modelfile import model_path
from dsmoe.system import group as group_module
from dsmoe.system import torchrun as torchrun_module
from dsmoe.system.group import ALONE, join_group
from dsmoe.train import train

HERE = os.path.dirname(os.path.abspath(__file__))
PACKAGES = os.path.dirname(os.path.dirname(os.path.abspath(diff_smoe_rasterization.__file__)))  # of the one under test

needs_gloo = pytest.mark.skipif(not torch.distributed.is_available() or not torch.distributed.is_gloo_available(),
                                reason="this torch has no gloo")
needs_torchrun = pytest.mark.skipif(torch.__version__.startswith("1.") and sys.version_info >= (3, 11),
                                    reason="torchrun of PyTorch 1 does not start with Python 3.11 or newer")


def torchrun(processes, *words, **environment):
    """Runs a program in so many processes. Returns its exit status, output and errors."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", str(processes),
               *words]
    path = os.pathsep.join([PACKAGES, os.environ.get("PYTHONPATH", "")])
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=HERE,
                            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **environment})
    return result.returncode, result.stdout, result.stderr


def words_of(config):
    """The options of a training on the command line."""
    names = ("batch", "budget", "strategy", "strategy_options", "iterations", "blend_mode", "sh_degree_interval",
             "densify_from_iter", "densify_until_iter", "densification_interval", "opacity_reset_interval",
             "densify_grad_threshold", "position_lr_max_steps", "checkpoint_every")
    return [config.scene, "-o", config.output, "--quiet",
            *(f"--{name.replace('_', '-')}={getattr(config, name)}" for name in names)]


def model_of(config):
    with open(model_path(config.output, config.iterations), "rb") as file:
        return file.read()


@needs_gloo
@needs_torchrun
def test_processes_die_and_others_resume_bit_for_bit(tiny_config, tmp_path):
    """Two processes train until one dies; from what they saved, three go on, and one does. 60 views in steps of 4.

    Growth is until 16, removals at 16, 19, 22, 25, moves until 40, an average from 42 on.
    """
    straight = tiny_config.changed(batch=4, output=str(tmp_path / "straight"), iterations=60, budget=60,
                                   strategy_options="removals=4,views=5,moves=0.2", strategy="importance")
    row = train(straight, progress=False)
    config = dataclasses.replace(straight, output=str(tmp_path / "several"))
    status, out, errors = torchrun(2, os.path.join(HERE, "dying_worker.py"), "train", *words_of(config), DYING_AT="56")
    assert status != 0 and "process 1: this process dies" in errors, errors
    assert out.count("in 2 processes") == 1
    assert not os.path.exists(model_path(config.output, 60)) and os.path.isfile(config.output + "/checkpoint.pt")
    alone = dataclasses.replace(config, output=str(tmp_path / "alone"))
    shutil.copytree(config.output, alone.output)

    status, out, errors = torchrun(3, "-m", "dsmoe", "train", "--resume", "-o", config.output)
    assert status == 0, errors
    assert "resumed at iteration 52" in out
    assert model_of(config) == model_of(straight)
    assert row["num_gaussians"] == 60

    torch.manual_seed(77)
    assert train(alone, resume=True, progress=False)["psnr"] == row["psnr"]
    assert model_of(alone) == model_of(straight)


@needs_gloo
@needs_torchrun
def test_three_processes_decide_as_one(tiny_config, tmp_path):
    """Splits, clones, prunes and resets of 3dgs; relocation, growth and noise of mcmc. The test above has importance.

    Of mcmc's steps, which have two views, one process blends nothing.
    """
    options = [dict(batch=4), dict(batch=2, strategy="mcmc", budget=200, blend_mode="alpha", densification_interval=4,
                                   opacity_lr=1.0)]  # so that some die
    configs = [tiny_config.changed(**each, output=str(tmp_path / f"one_{index}"))
               for index, each in enumerate(options)]
    others = [config.changed(output=str(tmp_path / f"three_{index}")) for index, config in enumerate(configs)]
    rows = [train(config, progress=False) for config in configs]
    assert rows[0]["num_gaussians"] != rows[0]["protocol"]["init_points"] and rows[1]["num_gaussians"] == 200
    status, _, errors = torchrun(3, os.path.join(HERE, "several_trainings.py"),
                                 *(json.dumps(config.record()) for config in others))
    assert status == 0, errors
    assert [model_of(config) for config in others] == [model_of(config) for config in configs]


@needs_gloo
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of its parent's end")
def test_a_process_saves_and_ends_where_torchrun_is_killed(tiny_config):
    """A program stands for torchrun that starts one process; it is killed as torchrun would be."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    worker = [sys.executable, "-m", "dsmoe", "train", tiny_config.scene, "-o", tiny_config.output,
              "--iterations", "1000000", "--batch", "1", "--quiet", "--checkpoint-every", "100"]
    checkpoint = os.path.join(tiny_config.output, "checkpoint.pt")
    launcher = f"import subprocess, sys; sys.exit(subprocess.call({worker!r}))"
    environment = {"PYTHONPATH": os.pathsep.join([PACKAGES, os.environ.get("PYTHONPATH", "")]), "RANK": "0",
                   "WORLD_SIZE": "1", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port,
                   "TORCHELASTIC_RUN_ID": "none", "OMP_NUM_THREADS": "1"}
    with subprocess.Popen([sys.executable, "-c", launcher], env={**os.environ, **environment}, text=True,
                          cwd=os.path.dirname(tiny_config.output),  # -m would find the sources in that of the tests
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.readline()
        while process.poll() is None and not os.path.isfile(checkpoint):  # it trains, and handles signals
            time.sleep(0.1)
        os.remove(checkpoint)
        process.kill()
        errors = process.stderr.read()  # to its end, at which the worker has ended
    assert f"train --resume -o {tiny_config.output}\n" in errors, errors
    assert os.path.isfile(checkpoint)


@pytest.mark.slow
@needs_gloo
@needs_torchrun
def test_a_budget_holds_for_all_processes_together(tiny_config, tmp_path):
    """One view a step, two processes, of which one blends nothing: the model of the usual training."""
    config = tiny_config.changed(strategy="steady", budget=170, iterations=20, output=str(tmp_path / "one"))
    row = train(config, progress=False)
    assert 165 < row["num_gaussians"] <= 170 and row["num_gaussians"] != row["protocol"]["init_points"]
    other = dataclasses.replace(config, output=str(tmp_path / "two"))
    status, out, errors = torchrun(
        2, "-m", "dsmoe", "train", config.scene, "-o", other.output, "--quiet",
        "--strategy", "steady", "--budget", "170", "--iterations", "20", "--blend-mode", "smoe",
        "--sh-degree-interval", "10", "--densify-from-iter", "4", "--densify-until-iter", "30",
        "--densification-interval", "8", "--densify-grad-threshold", "0.002")
    assert status == 0, errors
    assert "1 blend nothing; --batch 2 keeps all busy" in out
    assert model_of(other) == model_of(config)


@pytest.mark.parametrize("total, size", [(10, 3), (2, 4), (0, 2), (1000, 7)])
def test_runs_are_all_gaussians_and_equally_long(total, size):
    runs = [run_of(rank, size, total) for rank in range(size)]
    assert runs[0][0] == 0 and runs[-1][1] == total
    assert all(first[1] == second[0] for first, second in zip(runs, runs[1:]))
    lengths = [end - begin for begin, end in runs]
    assert max(lengths) - min(lengths) <= 1


def test_gpus_is_refused_on_the_cpu(tiny_config, capsys):
    assert main(["train", tiny_config.scene, "-o", tiny_config.output, "--gpus", "2", "--device", "cpu"]) == 1
    assert "--gpus is 2 with --device cpu; it needs --device cuda" in capsys.readouterr().err


def test_gpus_starts_torchrun_with_the_same_command(tiny_config, monkeypatch):
    """Without --device it is cuda."""
    seen = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torchrun_module, "launch", lambda gpus, words: seen.append((gpus, words)) or 3)
    words = ["train", tiny_config.scene, "-o", tiny_config.output, "--batch", "4"]
    assert main([*words, "--gpus", "2"]) == 3 and main([*words[:2], "--gpus=2", *words[2:], "--device", "cuda"]) == 3
    assert seen == [(2, [*words, "--device", "cuda"])] * 2


@needs_gloo
@needs_torchrun
def test_gpus_starts_this_package_not_one_of_the_current_folder(tmp_path):
    """As in the source folder of a package that is installed."""
    (tmp_path / "dsmoe").mkdir()
    (tmp_path / "dsmoe" / "__init__.py").write_text("raise SystemExit('the current folder')")
    command = torchrun_module.torchrun_command(2, ["train", "nothing here", "-o", "out", "--device", "cpu"])
    run = subprocess.run(command, cwd=tmp_path, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.PIPE,
                         stderr=subprocess.STDOUT, universal_newlines=True, timeout=120)
    assert run.stdout.count("nothing here") >= 1 and "the current folder" not in run.stdout, run.stdout


TORCHRUN = {"RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}


@pytest.mark.parametrize("changes, words", [
    *((dict.fromkeys({*TORCHRUN} - {name}), f"{name} is set and .* not; torchrun sets all of them")
      for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK")),
    *(({name: None}, rf"are set and {name} not; torchrun sets all of them: start with it, or unset RANK, WORLD_SIZE"
       ) for name in ("MASTER_ADDR", "MASTER_PORT")),
    ({"LOCAL_RANK": None}, "RANK, WORLD_SIZE are set and LOCAL_RANK not; torchrun sets all"),
    ({"RANK": "x"}, "RANK is 'x'; it must be a whole number from 0 to 0"),
    ({"RANK": "5"}, "RANK is '5'; it must be a whole number from 0 to 0: WORLD_SIZE is 1"),
    ({"RANK": "-1", "WORLD_SIZE": "4"}, "RANK is '-1'; it must be a whole number from 0 to 3"),
    *(({"WORLD_SIZE": value}, f"WORLD_SIZE is '{value}'; it must be a whole number from 1 to 1000000")
      for value in ("0", "-1", "", "1.5", "9" * 5000, "\u0661")),
    ({"LOCAL_RANK": "1"}, "LOCAL_RANK is '1'; it must be a whole number from 0 to 0"),
    *(({"MASTER_PORT": value}, f"MASTER_PORT is '{value}'; it must be a whole number from 1 to 65535")
      for value in ("-4", "0", "65536", "port")),
])
def test_variables_of_torchrun_that_cannot_be_are_named(tiny_config, monkeypatch, capsys, changes, words):
    for name, value in {**TORCHRUN, **changes}.items():
        monkeypatch.delenv(name, raising=False)
        if value is not None:
            monkeypatch.setenv(name, value)
    assert main(["train", tiny_config.scene, "-o", tiny_config.output]) == 1
    text = capsys.readouterr().err
    assert re.search(words, text) and text.count("\n") == 1
    assert not os.path.exists(tiny_config.output)


def test_an_address_of_all_programs_is_no_torchrun(monkeypatch):
    for name in TORCHRUN:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    monkeypatch.setenv("MASTER_PORT", "any")
    assert join_group("cpu") is ALONE


@needs_gloo
def test_processes_that_do_not_meet_say_so(monkeypatch, capsys):
    """The second of two, if the first never comes: a line while it waits, another one at its end."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for name, value in {**TORCHRUN, "RANK": "1", "WORLD_SIZE": "2", "MASTER_PORT": str(port)}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(group_module, "TIMEOUT", datetime.timedelta(seconds=1.5))
    monkeypatch.setattr(group_module, "PATIENCE", 0.1)
    with pytest.raises(TrainerError, match=f"the processes of the training do not meet at 127.0.0.1:{port} .*: ."):
        join_group("cpu")
    assert capsys.readouterr().err.startswith(f"note: process 1 of 2 waits for the others at 127.0.0.1:{port}\n")


@pytest.mark.parametrize("name", ["no-such-host.invalid", "a..b", "x" * 300, ""])
def test_an_address_that_leads_nowhere_is_refused(monkeypatch, name):
    """torch would try it for two hours; here a host that starts meanwhile has some seconds."""
    def unknown(*arguments, **options):
        raise socket.gaierror(-2, "Name or service not known")

    for variable, value in {**TORCHRUN, "MASTER_ADDR": name}.items():
        monkeypatch.setenv(variable, value)
    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    monkeypatch.setattr(group_module, "PATIENCE", 0.01)
    with pytest.raises(TrainerError, match=rf"do not meet at .* no host of the name {name!r} is known \(.*not known"):
        join_group("cpu")


def test_more_gpus_than_there_are_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(TrainerError, match="--gpus is 3; it must be auto, or at most 2: so many GPUs torch finds"):
        torchrun_module.chosen_gpus("3", "cuda", 4)
    for asked, device in (("0", "cuda"), ("-1", "cpu"), ("all", "cuda")):
        with pytest.raises(TrainerError, match=f"--gpus is {asked}; it must be auto or a whole number, at least 1"):
            torchrun_module.chosen_gpus(asked, device, 4)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    for asked in ("3", "auto"):
        with pytest.raises(TrainerError, match="torch finds no GPU here; on CPUs start torchrun with --device cpu"):
            torchrun_module.chosen_gpus(asked, "cuda", 4)


@pytest.mark.parametrize("batch, gpus", [(1, 1), (3, 3), (8, 4)])
def test_auto_takes_all_gpus_that_a_batch_keeps_busy(monkeypatch, batch, gpus):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert torchrun_module.chosen_gpus("auto", "cuda", batch) == gpus
