"""A watched training is the same training, and its record says what happened in it."""
from __future__ import annotations

import json
import os

import pytest
import torch

from diff_smoe_rasterization.benchmarks.errors import BenchError
from diff_smoe_rasterization.benchmarks.mechanism import record as mechanism
from diff_smoe_rasterization.benchmarks.mechanism.probe import Probe
from diff_smoe_rasterization.trainer.config import TrainConfig
from diff_smoe_rasterization.trainer.results.modelfile import model_path
from diff_smoe_rasterization.trainer.scenes.scene import load_scene
from diff_smoe_rasterization.trainer.training.checkpoint import CHECKPOINT_NAME, load_checkpoint
from diff_smoe_rasterization.trainer.training.loop import Trainer, train

RESETS = [60, 120, 180]
DENSIFICATIONS = list(range(40, 200, 20))


def config_of(scene, output, blend_mode, **options):
    """300 steps with densifications and resets as above, in which Gaussians are cloned, split and pruned; Eq. 7."""
    if blend_mode == "smoe":
        options.setdefault("background_gate", 0.0)
    return TrainConfig(**{**dict(
        scene=scene, output=str(output), blend_mode=blend_mode, iterations=300, sh_degree_interval=100,
        densify_from_iter=20, densify_until_iter=200, densification_interval=20, opacity_reset_interval=60,
        densify_grad_threshold=0.002, percent_dense=0.05), **options})


@pytest.fixture(scope="module")
def runs(tiny_scene, tmp_path_factory):
    """By blend mode: the config of a watched run, and its record."""
    found = {}
    for mode in ("alpha", "smoe"):
        config = config_of(tiny_scene, tmp_path_factory.mktemp("runs") / mode, mode)
        found[mode] = (config, mechanism.run(config, progress=False))
    return found


@pytest.fixture(params=["alpha", "smoe"])
def watched_run(request, runs):
    return runs[request.param]


def same(one, other):
    """Whether two nests of plain values and tensors are equal, tensors bit for bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


def test_a_watched_training_is_bit_equal_to_a_plain_one(watched_run, tmp_path):
    config, _ = watched_run
    plain = config.changed(output=str(tmp_path / "plain"))
    train(plain, progress=False)
    models = []
    for folder in (config.output, plain.output):
        with open(model_path(folder, config.iterations), "rb") as file:
            models.append(file.read())
    assert models[0] == models[1]
    watched, unwatched = (load_checkpoint(os.path.join(folder, CHECKPOINT_NAME), "cpu")
                          for folder in (config.output, plain.output))
    for part in ("raw", "optimizer", "strategy", "order", "random", "active_sh_degree"):
        assert same(watched[part], unwatched[part]), part


def test_counts_agree_with_the_sizes_of_the_model(watched_run):
    _, record = watched_run
    steps = record["densifications"]
    assert [step["iteration"] for step in steps] == DENSIFICATIONS
    for step, following in zip(steps, [*steps[1:], None]):
        # A clone adds one; a split puts two in the place of one.
        assert step["grown"] == step["before"] + step["cloned"] + step["split"]
        assert step["after"] == step["grown"] - step["faint"] - step["large"]
        assert step["after"] == (following["before"] if following else record["result"]["num_gaussians"])
    sizes = {step["iteration"]: step["before"] for step in steps}
    assert any(state["iteration"] in sizes for state in record["states"])
    for state in record["states"]:
        assert state["num_gaussians"] == sizes.get(state["iteration"], state["num_gaussians"])
    for name in ("cloned", "split", "large"):
        assert sum(step[name] for step in steps) > 0, f"nothing was shown of {name}"


def test_states_are_dense_after_a_reset(watched_run):
    _, record = watched_run
    assert [reset["iteration"] for reset in record["resets"]] == RESETS
    # Every 100; one step and every ten after a reset, up to the end: nothing is as far as 300 from the last reset.
    assert [state["iteration"] for state in record["states"]] == sorted(
        {100, 200, *(reset + 1 for reset in RESETS), *range(70, 300, 10)})


def test_opacities_after_a_reset(runs):
    """Nothing is above 0.01. In alpha all colours have become dark, and more opacity makes them brighter. In smoe a
    common factor of all opacities cancels but for T, which is nearly 1 where opacities are 0.01."""
    for mode, (_, record) in runs.items():
        first = [state for state in record["states"] if state["iteration"] - 1 in RESETS]
        for state, reset in zip(first, record["resets"]):
            assert state["opacities"][-1] == pytest.approx(0.01, rel=1e-4)  # a sigmoid of a logarithm in float32
            assert state["psnr"] == pytest.approx(reset["after"]["psnr"], abs=0.5)  # one step of all but opacities
            drop = reset["before"]["psnr"] - reset["after"]["psnr"]
            pull = state["net_pull"]
            assert (drop > 1 and pull > 0.9) if mode == "alpha" else (abs(drop) < 1 and abs(pull) < 0.1)


def test_the_summary_adds_up(watched_run):
    _, record = watched_run
    steps, found = record["densifications"], record["summary"]
    assert found["pruned"]["faint"] == sum(step["faint"] for step in steps)
    assert found["densified"]["parents"] == sum(step["cloned"] + step["split"] for step in steps)
    later = next(state["psnr"] for state in record["states"] if state["iteration"] == RESETS[0] + 100)
    assert found["resets"][0]["later"] == later
    # The prune at step 60 itself came before the reset.
    after = next(step for step in steps if step["iteration"] == 80)
    gained = after["after_prune"]["psnr"] - after["before_prune"]["psnr"]
    first, _, last = found["pruned"]["after_resets"]
    assert first["psnr"] == pytest.approx(gained, abs=1e-4)  # six digits are kept
    assert first["iteration"] == 80 and first["color"] == after["pruned_colors"]
    assert last is None  # densification ends with the last reset
    assert found["settled_opacity"] is None  # the run ends before


@pytest.fixture
def probe_of(tiny_scene, tmp_path):
    """From a blend mode to the probe of an untrained model."""
    def made(mode):
        config = config_of(tiny_scene, tmp_path, mode)
        trainer = Trainer(config, load_scene(config, progress=False))
        return Probe(trainer.renderer, trainer.scene)
    return made


def test_a_share_is_what_a_gaussian_alone_lights_up(probe_of, mode):
    probe = probe_of(mode)
    shares = probe.shares()
    for index in range(0, probe.model.num_gaussians, 40):
        lit = torch.zeros(probe.model.num_gaussians, 3)
        lit[index] = 1
        with torch.no_grad():
            total = sum(float(probe.renderer(camera, colors_precomp=lit)[0].color[1].sum())
                        for camera, _ in probe.train)
        assert float(shares[index]) == pytest.approx(total, rel=1e-3, abs=1e-6)  # float32 sums
    assert all(tensor.grad is None for tensor in probe.model.raw.values())


@pytest.mark.parametrize("text, told", [("{", "not valid json"), ("{}", "not the record"), ("[]", "not the record")])
def test_a_damaged_record_is_named(text, told, tmp_path):
    (tmp_path / mechanism.RECORD_NAME).write_text(text)
    with pytest.raises(BenchError, match=f"mechanism.json.*{told}"):
        mechanism.read_record(str(tmp_path))


def test_the_command_trains_and_explains_its_errors(tiny_scene, tmp_path, capsys):
    out = str(tmp_path / "out")
    assert mechanism.main(["run", tiny_scene, out, "--blend-mode", "smoe", "--iterations", "100", "--scale-recipe",
                           "--quiet"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["num_gaussians"] > 0
    assert f"written: {os.path.join(out, 'mechanism.json')}" in printed.err
    assert TrainConfig.load(out).opacity_reset_interval == 10
    assert mechanism.main(["run", tiny_scene, out, "--quiet"]) == 1
    assert "already holds" in capsys.readouterr().err


@pytest.mark.slow  # seconds of matplotlib
def test_three_figures_show_the_series_of_all_runs(runs, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib", reason="figures need matplotlib")
    from diff_smoe_rasterization.benchmarks.mechanism import plots as mechanism_plots

    monkeypatch.delitem(mechanism_plots.curves.THEMES, "dark")  # seconds; a report's tests draw both themes
    folders, records = [config.output for config, _ in runs.values()], [record for _, record in runs.values()]
    assert mechanism.main(["plot", str(tmp_path), "-o", str(tmp_path)]) == 1
    assert "mechanism.json" in capsys.readouterr().err
    assert mechanism.main(["plot", *folders, "-o", str(tmp_path)]) == 0
    assert sorted(os.listdir(tmp_path)) == sorted(
        f"mechanism-{name}{end}" for name in ("opacity", "pruning", "densification")
        for end in (".png", "-light.svg"))
    named = mechanism_plots.named(records)
    assert [run.label for run in named] == ["alpha", "smoe"]
    drawn = mechanism_plots.opacity(named)
    psnr, after = drawn.axes[4:6]
    for line, record in zip([line for line in psnr.lines if len(line.get_xdata()) > 2], records):
        assert line.get_ydata().tolist() == [state["psnr"] for state in record["states"]]
    # The last reset first; each from the state before it, where there is one, to the next reset.
    assert [line.get_xdata()[[0, 1, -1]].tolist() for line in after.lines[:3]] == [[0, 1, 110], [0, 1, 60], [1, 10, 60]]
    mechanism_plots.plt.close("all")
