"""Options: the defaults of 3DGS, validation, and a config file that never loses the blend mode."""
from __future__ import annotations

import argparse
import dataclasses
import json
import os

import pytest

from dsmoe.errors import ConfigError
from dsmoe.options.config import TrainConfig
from dsmoe.options.config_arguments import add_arguments, config_from_arguments

# The published defaults of 3DGS (2023).
PUBLISHED = {
    "iterations": 30_000, "position_lr_init": 0.00016, "position_lr_final": 0.0000016,
    "position_lr_max_steps": 30_000, "feature_lr": 0.0025, "opacity_lr": 0.05, "scaling_lr": 0.005,
    "rotation_lr": 0.001, "percent_dense": 0.01, "lambda_dssim": 0.2, "densification_interval": 100,
    "opacity_reset_interval": 3000, "densify_from_iter": 500, "densify_until_iter": 15_000,
    "densify_grad_threshold": 0.0002, "sh_degree": 3, "resolution": -1, "white_background": False,
}


def parse(*arguments):
    """With the recipe of 3DGS, which reads no scene, unless another strategy is named."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return config_from_arguments(parser.parse_args(["scene", "-o", "out", "--strategy", "3dgs", *arguments]))[0]


def test_defaults_are_those_of_3dgs():
    config = parse()
    assert {name: getattr(config, name) for name in PUBLISHED} == PUBLISHED
    assert (config.scene, config.output, config.blend_mode, config.strategy) == ("scene", "out", "alpha", "3dgs")


def test_every_option_is_on_the_command_line():
    config = parse("--blend-mode", "smoe_tn", "--iterations", "7", "--densify-grad-threshold", "5e-3",
                   "--white-background", "--strategy", "steady", "--principal-point", "centre", "--seed", "3",
                   "--init-points", "99", "--percent-dense", "0.5", "--sh-degree", "1")
    assert (config.blend_mode, config.iterations, config.densify_grad_threshold) == ("smoe_tn", 7, 0.005)
    assert (config.white_background, config.strategy, config.principal_point) == (True, "steady", "centre")
    assert (config.seed, config.init_points, config.percent_dense, config.sh_degree) == (3, 99, 0.5, 1)


def test_blend_mode_follows_the_environment_unless_given(monkeypatch):
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe_std")
    assert parse().blend_mode == "smoe_std"
    assert parse("--blend-mode", "smoe").blend_mode == "smoe"
    monkeypatch.setenv("DSMOE_BLEND_MODE", "cubist")
    with pytest.raises(ConfigError, match="DSMOE_BLEND_MODE is 'cubist'"):
        parse()


def test_background_gate_of_each_mode(monkeypatch):
    modes = ("alpha", "smoe", "smoe_eq7", "smoe_tn", "smoe_std")
    assert [parse("--blend-mode", mode).background_gate for mode in modes] == [1.0, "learned", "learned", 0.0, 0.0]
    assert parse("--blend-mode", "smoe", "--background-gate", "0").background_gate == 0.0, "the paper's"
    assert parse("--blend-mode", "smoe", "--background-gate", "learned").background_gate == "learned"
    assert parse("--blend-mode", "alpha", "--background-gate", "1").background_gate == 1.0
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.2")
    assert [parse("--blend-mode", mode).background_gate for mode in modes] == [1.0, 0.2, 0.2, 0.0, 0.0]
    assert parse("--blend-mode", "smoe", "--background-gate", "0.4").background_gate == 0.4
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "learned")
    assert parse("--blend-mode", "smoe").background_gate == "learned"
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "learnt")
    with pytest.raises(ConfigError, match="DSMOE_BACKGROUND_GATE is 'learnt'"):
        parse("--blend-mode", "smoe")


@pytest.mark.parametrize("mode, gate, words", [
    ("smoe", -0.1, "background_gate is -0.1"), ("smoe", float("inf"), "background_gate is inf"),
    *[(mode, gate, "only 'smoe' and 'smoe_eq7' know it")
      for mode, gate in (("alpha", 0.1), ("alpha", "learned"), ("smoe_tn", 0.1), ("smoe_std", 1.0))],
])
def test_a_background_gate_that_the_mode_does_not_know_is_refused(mode, gate, words):
    with pytest.raises(ConfigError, match=words):
        TrainConfig(blend_mode=mode, background_gate=gate)


def test_faint_below_is_of_the_gated_modes(monkeypatch):
    assert parse("--blend-mode", "smoe").faint_below == 0.25, "the mode's own"
    assert parse("--blend-mode", "smoe_eq7", "--faint-below", "0.9").faint_below == 0.9
    with pytest.raises(ConfigError, match="--faint-below is 0.9, but the blend mode is alpha; only smoe and smoe_eq7"):
        parse("--faint-below", "0.9")
    with pytest.raises(ConfigError, match="faint_below is -1.0; it must be a number, 0 or more"):
        parse("--blend-mode", "smoe", "--faint-below", "-1")
    monkeypatch.setenv("DSMOE_FAINT_BELOW", "0.5")
    assert (parse("--blend-mode", "smoe").faint_below, parse().faint_below) == (0.5, None)
    given = parse("--blend-mode", "smoe", "--faint-below", "2")
    assert given.faint_below == given.changed(seed=1).faint_below == 2 and given.changed(
        blend_mode="alpha").faint_below is None


@pytest.mark.parametrize("recorded", [0.25, None], ids=["as_recorded", "of_an_earlier_version"])
def test_the_rule_of_faint_pairs_of_a_run_is_not_of_the_variable(monkeypatch, tmp_path, recorded):
    config = parse("--blend-mode", "smoe")
    config.save(str(tmp_path))
    path = tmp_path / "config.json"
    values = json.loads(path.read_text())
    assert values["faint_below"] == 0.25
    path.write_text(json.dumps({**values, "faint_below": recorded}))
    monkeypatch.setenv("DSMOE_FAINT_BELOW", "0.5")
    loaded = TrainConfig.load(str(tmp_path), continues=True)
    assert loaded.faint_below == loaded.changed(iterations=40_000).faint_below == 0.25 and loaded.unusual_faint is None
    fresh = parse("--blend-mode", "smoe")
    assert fresh.unusual_faint == 0.5 and "--faint-below is 0.25, not 0.5" in loaded.differences(fresh)


def test_another_mode_takes_its_own_background_gate():
    config = TrainConfig(blend_mode="smoe", background_gate=0.3)
    assert config.changed(seed=1).background_gate == 0.3
    alpha = config.changed(blend_mode="alpha")
    assert (alpha.background_gate, alpha.changed(blend_mode="smoe").background_gate) == (1.0, "learned")
    assert alpha.changed(blend_mode="smoe", background_gate=0.2).background_gate == 0.2


def test_how_a_gate_is_learned_follows_the_mode_unless_given(tmp_path):
    def learned(config):
        return config.background_gate_bound, config.background_gate_start, config.background_gate_lr

    assert learned(parse("--blend-mode", "smoe")) == (0, 0.1, 0.03)
    assert learned(parse("--blend-mode", "smoe_eq7")) == learned(parse("--blend-mode", "alpha")) == (0.03, 1, 0.01)
    given = parse("--blend-mode", "smoe", "--background-gate-start", "0.5", "--background-gate-lr", "0.02")
    assert learned(given) == (0, 0.5, 0.02)
    assert learned(given.changed(blend_mode="smoe_eq7")) == (0.03, 0.5, 0.02), "what is given stays"
    texts = parse("--blend-mode", "smoe").differences(parse("--blend-mode", "smoe_eq7"))
    assert texts == ["--blend-mode is 'smoe', not 'smoe_eq7'"], "no text for what follows from the mode"
    assert len(given.differences(parse("--blend-mode", "smoe_eq7"))) == 3
    given.changed(scene="s", output=str(tmp_path)).save(str(tmp_path))
    assert learned(TrainConfig.load(str(tmp_path))) == (0, 0.5, 0.02)


@pytest.mark.parametrize("option", ["start", "bound", "lr"])
def test_how_a_gate_is_learned_is_refused_where_none_is(monkeypatch, option):
    given = [f"--background-gate-{option}", "0.05"]
    for mode in ("alpha", "smoe_tn"):
        with pytest.raises(ConfigError, match=f"{given[0]} is given, but in the blend mode {mode} no background gate "
                                              "is learned; --blend-mode smoe or smoe_eq7 learns one"):
            parse("--blend-mode", mode, *given)
    learns = "fixes the background gate at 0.2; --background-gate learned learns it"
    with pytest.raises(ConfigError, match=f"{given[0]} is given, but --background-gate {learns}"):
        parse("--blend-mode", "smoe", "--background-gate", "0.2", *given)
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.2")
    with pytest.raises(ConfigError, match=f"{given[0]} is given, but .DSMOE_BACKGROUND_GATE {learns}"):
        parse("--blend-mode", "smoe", *given)
    parse("--blend-mode", "smoe", "--background-gate", "learned", *given)


@pytest.mark.parametrize("option", ["background_gate", "blend_mode", "seed", "feature_lr"])
def test_an_option_that_the_file_lacks_gets_no_default(tmp_path, option):
    """But a run that is only looked at may lack what says nothing of its images."""
    TrainConfig(scene="s", output=str(tmp_path)).save(str(tmp_path))
    values = json.loads((tmp_path / "config.json").read_text())
    del values[option]
    (tmp_path / "config.json").write_text(json.dumps(values))
    for continues in (True, False):
        if option == "feature_lr" and not continues:
            assert TrainConfig.load(str(tmp_path)).feature_lr == TrainConfig().feature_lr
            continue
        with pytest.raises(ConfigError, match=f"config.json: .*{option} is "):
            TrainConfig.load(str(tmp_path), continues)


@pytest.mark.parametrize("option, value, words", [
    ("background_gate_bound", 1.0, "--background-gate-bound is 1.0; it must be at least 0 and below 1"),
    ("background_gate_bound", -0.1, "--background-gate-bound is -0.1"),
    ("background_gate_bound", "0", "--background-gate-bound is '0'; it must be a number"),
    ("background_gate_start", 0.03, "--background-gate-start is 0.03; it must be above --background-gate-bound, 0.03"),
    ("background_gate_start", float("inf"), "--background-gate-start is inf"),
    ("background_gate_lr", 0.0, "--background-gate-lr is 0.0; it must be a positive number"),
    ("iterations", 0, "--iterations is 0; it must be at least 1"),
    ("resolution", 0, "--resolution is 0"),
    ("resolution", -2, "--resolution is -2"),
    ("init_points", 3, "--init-points is 3"),
    ("sh_degree", 4, "--sh-degree is 4"),
    ("lambda_dssim", 1.5, "--lambda-dssim is 1.5"),
    ("seed", -1, "--seed is -1"),
    ("densification_interval", 0, "--densification-interval is 0"),
    ("opacity_reset_interval", 0, "--opacity-reset-interval is 0"),
    ("densify_grad_threshold", 0.0, "--densify-grad-threshold is 0.0"),
    ("position_lr_final", float("nan"), "--position-lr-final is nan"),
    ("checkpoint_every", -1, "--checkpoint-every is -1"),
    ("strategy", "fast", "--strategy is 'fast'; it must be one of 3dgs, steady, importance, mcmc"),
    ("device", "tpu", "--device is 'tpu'"),
    ("budget", "500", "--budget is '500'; it must be a whole number"),
    ("iterations", 1e3, "--iterations is 1000.0; it must be a whole number"),
    ("feature_lr", "0.1", "--feature-lr is '0.1'; it must be a number"),
    ("white_background", 1, "--white-background is 1; it must be true or false"),
])
def test_bad_values_name_the_option(option, value, words):
    with pytest.raises(ConfigError) as error:
        TrainConfig(**{option: value}).validate()
    assert words in str(error.value)


def test_file_round_trip(tmp_path, mode):
    config = TrainConfig(scene="s", output=str(tmp_path), blend_mode=mode, iterations=5, white_background=True)
    config.save(str(tmp_path))
    assert TrainConfig.load(str(tmp_path)) == dataclasses.replace(config, scene=os.path.abspath("s"))
    assert json.loads((tmp_path / "config.json").read_text())["blend_mode"] == mode


@pytest.mark.parametrize("edit, words", [
    (lambda values: values.pop("blend_mode"), "blend_mode is None"),
    (lambda values: values.update(blend_mode="Smoe"), "blend_mode is 'Smoe'"),
    (lambda values: values.update(blend_mode=None), "blend_mode is None"),
    (lambda values: values.update(colour="red"), "unknown option colour"),
    (lambda values: values.update(iterations=0), "--iterations is 0"),
    (lambda values: values.update(iterations=True), "--iterations is True; it must be a whole number"),
    (lambda values: values.update(iterations=10**400), "it must be at most 2^53"),
    (lambda values: values.update(feature_lr=10**400), "it must be at most 2^53"),
    *((lambda values, name=name, value=value: values.update({name: value}), words) for value in ([], {}, [5])
      for name, words in (("scene", "--scene is"), ("images", "--images is"), ("device", "--device is"),
                          ("background_gate", "background_gate"), ("strategy", "--strategy is"),
                          ("strategy_options", "--strategy-options is"))),
])
def test_a_wrong_file_is_refused(tmp_path, monkeypatch, edit, words):
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe")  # must not fill the gap
    TrainConfig(scene="s", output=str(tmp_path), blend_mode="smoe").save(str(tmp_path))
    values = json.loads((tmp_path / "config.json").read_text())
    edit(values)
    (tmp_path / "config.json").write_text(json.dumps(values))
    with pytest.raises(ConfigError) as error:
        TrainConfig.load(str(tmp_path))
    assert "config.json" in str(error.value) and words in str(error.value)


@pytest.mark.parametrize("content", ["[" * 100_000, '{"a":' * 100_000, "{", "[]", "\0", ""])
def test_what_is_no_file_of_options_is_named(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ConfigError, match="config.json: (not valid json|expected a json object)"):
        TrainConfig.load(str(tmp_path))


def test_a_folder_without_a_run(tmp_path):
    with pytest.raises(ConfigError, match="dsmoe train"):
        TrainConfig.load(str(tmp_path))
    with pytest.raises(ConfigError, match="nowhere: no such folder; name the output folder of `dsmoe train`"):
        TrainConfig.load(str(tmp_path / "nowhere"))
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ConfigError, match="config.json: not valid json"):
        TrainConfig.load(str(tmp_path))


def test_differences_ignore_where_and_when_things_are_written():
    one = TrainConfig(scene="a", output="b", seed=1, checkpoint_every=5)
    assert one.differences(TrainConfig(scene="c", output="d", seed=1, eval_every=7)) == []
    texts = one.differences(TrainConfig(seed=2, blend_mode="smoe_eq7"))
    assert len(texts) == 3 and any("--seed is 1, not 2" in text for text in texts)


@pytest.mark.parametrize("options, words", [
    (dict(iterations=500), ["--iterations 500 adds no Gaussians: that begins after step 500; --scale-recipe"]),
    (dict(iterations=501), []), (dict(iterations=500, densify_until_iter=0), []),
    (dict(iterations=20_000, budget=100), ["--densify-until-iter 15000 leaves no iterations to settle"]),
    (dict(iterations=20_001, budget=100), [])])
def test_what_may_surprise_is_noted(options, words):
    notes = TrainConfig(**options).notes()
    assert len(notes) == len(words) and all(note.startswith(word) for note, word in zip(notes, words))


def test_shortened_keeps_the_shares_of_the_recipe():
    assert TrainConfig(iterations=30_000).shortened() == TrainConfig(iterations=30_000)
    short = TrainConfig(iterations=3000).shortened()
    assert (short.densify_from_iter, short.densify_until_iter, short.opacity_reset_interval) == (50, 1500, 300)
    assert (short.position_lr_max_steps, short.sh_degree_interval, short.densification_interval) == (3000, 100, 100)
    assert TrainConfig(iterations=60).shortened().densification_interval == 3, "ten densifications in 30 steps"
    TrainConfig(iterations=1).shortened().validate()
    given = TrainConfig(iterations=3000, densify_until_iter=2000, densify_grad_threshold=0.01).shortened()
    assert (given.densify_until_iter, given.densify_grad_threshold, given.densify_from_iter) == (2000, 0.01, 50)
