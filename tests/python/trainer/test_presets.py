"""What `dsmoe train` chooses where nothing is given: the strategy, a number of Gaussians, and the presets."""
from __future__ import annotations

import dataclasses

import pytest
from test_cli import fails, results_of
from test_scene_loading import nerf_folder  # noqa: F401

from dsmoe.cli import main
from dsmoe.options import presets
from dsmoe.options.config import TrainConfig
from dsmoe.options.presets import NUMBERS, Numbers, chosen_for_scene, iterations_for_scene, with_preset
from dsmoe.scenes import scene
from dsmoe.scenes.scene import read_layout


@pytest.mark.parametrize("words, budget, iterations, until, settings", [
    (["--iterations", "30"], 90, 30, 10, "overshoot=1.5,removals=4"),
    (["--iterations", "30", "--budget", "70"], 70, 30, 10, "overshoot=1.5,removals=4"),
    (["--iterations", "30", "--init-points", "20"], 60, 30, 10, "overshoot=1.5,removals=4"),
    (["--iterations", "30", "--strategy-options", "views=3,removals=2", "--densify-until-iter", "12"], 90, 30, 12,
     "views=3,removals=2,overshoot=1.5")])
@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_fast(tiny_scene, tmp_path, monkeypatch, mode, words, budget, iterations, until, settings):
    """The tiny scene has 144 points: three for each would be 432, more than the bound that is set here."""
    monkeypatch.setitem(NUMBERS, "cpu", Numbers(3, 10, 90, 20, 1000))
    output = str(tmp_path / "out")
    assert main(["train", tiny_scene, "-o", output, "--fast", "--blend-mode", mode, *words, "--quiet"]) == 0
    config, (row,) = TrainConfig.load(output), results_of(output)
    assert (config.budget, config.iterations, config.densify_until_iter) == (budget, iterations, until)
    assert config.strategy_options == settings and row["num_gaussians"] == budget
    assert config.position_lr_max_steps == 30 and config.sh_degree_interval == 1
    assert main(["train", tiny_scene, "--resume", "-o", output, "--fast", "--blend-mode", mode, *words, "--quiet"]) == 0


@pytest.mark.parametrize("preset", ["fast", "best"])
def test_presets_are_of_importance(tiny_scene, tmp_path, capsys, preset):
    text = fails(capsys, "train", tiny_scene, "-o", str(tmp_path / "out"), f"--{preset}", "--strategy", "mcmc")
    assert f"--strategy is 'mcmc'; it must be left out or importance with --{preset}" in text
    with pytest.raises(SystemExit):
        main(["train", "--resume", str(tmp_path / "out"), f"--{preset}"])
    assert f"--{preset} needs SCENE" in capsys.readouterr().err


def test_presets_have_defaults():
    assert with_preset({"seed": 3}, None, "cuda") == {"seed": 3, "strategy": "importance"}
    assert with_preset({}, "fast", "cuda") == {
        "strategy": "importance", "strategy_options": "overshoot=1.5,removals=4,pace=10", "iterations": 8400,
        "densify_until_iter": 2352}
    assert with_preset({}, "fast", "cpu") == {
        "strategy": "importance", "strategy_options": "overshoot=1.5,removals=4", "iterations": 3000,
        "densify_until_iter": 1050}
    best = {"strategy": "importance", "iterations": 60_000, "strategy_options": "views=255"}
    assert with_preset({}, "best", "cuda") == best
    assert with_preset({"scaling_lr": 0.01}, "best", "cpu") == {**best, "scaling_lr": 0.01}


def test_best_scales_all_milestones_and_takes_given_options(tiny_scene, tmp_path):
    output = str(tmp_path / "out")
    words = [tiny_scene, "-o", output, "--best", "--iterations", "30", "--budget", "70", "--quiet"]
    assert main(["train", *words]) == 0
    config = TrainConfig.load(output)
    assert (config.iterations, config.densify_until_iter, config.position_lr_max_steps) == (30, 15, 30)
    assert (config.strategy_options, config.budget) == ("views=255", 70)


@pytest.mark.parametrize("none", [[], ["--budget", "0"]])
def test_without_options_importance_takes_a_number_that_the_scene_says(tiny_scene, tmp_path, capsys, monkeypatch, none):
    monkeypatch.setitem(NUMBERS, "cpu", Numbers(2, 10, 1000, 20, 1000))
    output, words = str(tmp_path / "out"), ["--iterations", "30", "--quiet"]
    assert main(["train", tiny_scene, "-o", output, *words, *none]) == 0
    said, config = capsys.readouterr().out, TrainConfig.load(output)
    assert "strategy importance to 288 Gaussians" in said, "two for each of the 144 points"
    assert "--budget N makes more or fewer, and --strategy 3dgs is the densification of 3DGS" in said
    assert (config.strategy, config.densify_until_iter) == ("importance", 15)
    assert results_of(output)[0]["num_gaussians"] == 288
    for more in ([tiny_scene, *words], []):
        assert main(["train", *more, "--resume", "-o", output, "--quiet"]) == 0, "it keeps its number"
    assert main(["train", tiny_scene, "-o", str(tmp_path / "other"), "--strategy", "3dgs", *words]) == 0
    assert "--budget" not in capsys.readouterr().out
    assert TrainConfig.load(str(tmp_path / "other")).budget == 0


@pytest.mark.parametrize("words, reached", [(["--fast", "--iterations", "60"], 144 * 2**3),
                                            (["--iterations", "4"], 144)])
def test_a_chosen_number_is_one_that_growth_reaches(tiny_scene, tmp_path, monkeypatch, words, reached):
    """144 points; the least is 10,000. With 60 iterations growth ends before 11, and may double at 3, 6 and 9.

    4 iterations have no time to grow. The scene's points are read once for that and for the training.
    """
    output, read, reader = str(tmp_path / "out"), [], scene.read_colmap_layout
    monkeypatch.setattr(scene, "read_colmap_layout", lambda *given: read.append(1) or reader(*given))
    assert main(["train", tiny_scene, "-o", output, *words, "--quiet"]) == 0
    assert len(read) == 1
    assert TrainConfig.load(output).budget == reached


def test_a_number_does_not_follow_random_points(nerf_folder):
    def chosen(**options):
        config = TrainConfig(scene=nerf_folder, strategy="importance", blend_mode="smoe", **options)
        return chosen_for_scene(config, options, read_layout(config))

    assert chosen() == chosen(init_points=50_000) == {"budget": NUMBERS["cpu"].without_points}
    assert chosen(device="cuda")["budget"] == NUMBERS["cuda"].without_points
    assert chosen(budget=40) == {}


def test_as_many_points_are_taken_as_time_allows(tiny_scene, monkeypatch):
    monkeypatch.setitem(NUMBERS, "cpu", Numbers(2, 10, 1000, 20, 60))
    config = TrainConfig(scene=tiny_scene, strategy="importance", blend_mode="smoe")
    layout = read_layout(config)
    assert chosen_for_scene(config, (), layout) == {"init_points": 60, "budget": 120}
    given = dataclasses.replace(config, init_points=70)
    assert chosen_for_scene(given, ("init_points",), layout) == {"budget": 140}


@pytest.mark.parametrize("views, iterations", [(1, 15_000), (50, 15_000), (60, 18_000), (100, 30_000), (500, 30_000)])
def test_few_photographs_train_for_fewer_iterations(tiny_scene, monkeypatch, views, iterations):
    """A training view is seen 300 times, but for the bounds, and for a budget below the scene's two for each point."""
    monkeypatch.setitem(NUMBERS, "cpu", Numbers(2, 10, 1000, 20, 100))

    def chosen(**options):
        return iterations_with(tiny_scene, views, **options)

    assert chosen() == iterations
    assert chosen(batch=1000) == iterations, "a multiple of the batch"
    assert chosen(batch=16) == {15_000: 15_008, 18_000: 18_000, 30_000: 30_000}[iterations]
    assert chosen(budget=200) == chosen(init_points=144, budget=288) == iterations, "as with the number that is chosen"
    assert chosen(budget=199) == chosen(init_points=144, budget=287) == 30_000
    assert chosen(iterations=30_000) == chosen(densify_until_iter=15_000) == 30_000


def test_the_number_that_fewer_iterations_reach_trains_for_as_many_where_it_is_given(tiny_scene):
    """144 points double at 1,000, 2,000 and 3,000, then growth ends; with 30,000 iterations seven times, to 7,000."""
    options = {"densification_interval": 1000}
    assert iterations_with(tiny_scene, 30, **options) == 15_000
    layout = read_layout(TrainConfig(scene=tiny_scene))
    shorter = TrainConfig(strategy="importance", blend_mode="smoe", iterations=15_000, densify_until_iter=7500,
                          densify_from_iter=250, **options)
    chosen = chosen_for_scene(shorter, options, layout)["budget"]
    assert chosen == 144 * 2**3 < NUMBERS["cpu"].least
    assert iterations_with(tiny_scene, 30, budget=chosen, **options) == 15_000
    assert iterations_with(tiny_scene, 30, budget=chosen - 1, **options) == 30_000
    assert iterations_with(tiny_scene, 30, budget=chosen + 1, **options) == 30_000, "15,000 do not reach it"


def iterations_with(scene_folder, views, **options):
    """Chosen for a scene with so many training views."""
    options = {"scene": scene_folder, "strategy": "importance", "blend_mode": "smoe", **options}
    layout = read_layout(TrainConfig(**options))
    return iterations_for_scene(options, dataclasses.replace(layout, train=layout.train[:1] * views))


def test_the_milestones_follow_the_chosen_iterations(tiny_scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(presets, "LEAST_ITERATIONS", 20)
    monkeypatch.setattr(presets, "PER_VIEW", 1)
    monkeypatch.setitem(NUMBERS, "cpu", Numbers(8, 10, 2000, 20, 1000))
    output = str(tmp_path / "out")
    words = ["train", tiny_scene, "-o", output, "--quiet", "--rotation-lr", "0.003"]
    assert main(words) == 0
    assert "note: fewer iterations, as the scene has few photographs" in capsys.readouterr().out
    config = TrainConfig.load(output)
    assert (config.iterations, config.densify_until_iter, config.position_lr_max_steps) == (20, 10, 20)
    assert (config.rotation_lr, config.budget) == (0.003, 144 * 2**3), "growth doubles 144 points at 2, 3 and 4"
    assert main([*words[:3], output + "_budget", *words[4:], "--budget", "1152"]) == 0
    assert "note: fewer iterations, as the scene has few photographs" in capsys.readouterr().out
    assert TrainConfig.load(output + "_budget").iterations == 20
    for more in ([], ["--scale-recipe"]):
        assert main([*words, "--resume", *more]) == 0, "it keeps its length"
    assert main([*words, "--overwrite", "--iterations", "20"]) == 0
    assert "note: fewer iterations" not in capsys.readouterr().out
