"""Suites: what they expand to, and which mistakes are refused with the name of the field."""
from __future__ import annotations

import copy
import os
from pathlib import Path

import pytest

from diff_smoe_rasterization.benchmarks.errors import BenchError
from diff_smoe_rasterization.benchmarks.suite.expansion import expand, find_suite, load_suite
from diff_smoe_rasterization.benchmarks.suite.protocol import config_of
from diff_smoe_rasterization.benchmarks.suite.schema import THRESHOLDS
from diff_smoe_rasterization.benchmarks.suite.selection import earlier_rows

yaml = pytest.importorskip("yaml", reason="suites are YAML files: pip install pyyaml")

SHIPPED_NAMES = ("table1", "table2", "table3", "fig4", "fig5", "smoke", "captures", "captures_ablation",
                 "captures_baselines", "gate", "gate_equal")


def changed(content, **fields):
    return {**copy.deepcopy(content), **fields}


def on_cuda(content, **fields):
    """The suite with what a checkout needs: CUDA and a centred principal point."""
    protocol = {"device": "cuda", "principal_point": "centre", **fields.pop("protocol", {})}
    return changed(content, protocol=protocol, **fields)


def test_cells_are_every_combination(content):
    suite = expand(changed(content, densify_grad_thresholds=[0.005, 0.0002], seeds=[0, 1],
                           schedules=["3dgs", "steady"]), "")
    found = {(cell["blend_mode"], cell["densify_grad_threshold"], cell["seed"], cell["schedule"])
             for cell in suite.cells}
    assert len(suite.cells) == len(found) == len({cell["id"] for cell in suite.cells}) == 16


def test_gates_are_of_smoe_alone(content):
    """And a cell of gate 0 is the one that a suite without gates has, so that its rows stay."""
    cells = expand(changed(content, blend_modes=["smoe_tn", "smoe", "alpha"],
                           background_gates=["learned", 0, 0.05]), "").cells
    assert [(cell["blend_mode"], cell["background_gate"], config_of(cell).background_gate) for cell in cells] == [
        ("smoe_tn", 0, 0), ("smoe", "learned", "learned"), ("smoe", 0, 0), ("smoe", 0.05, 0.05), ("alpha", 1, 1)]
    names = [cell["id"] for cell in cells]
    assert [cell["id"] for cell in expand(content, "").cells] == [names[4], names[2]]
    assert names[1].startswith("native_tiny_smoe-learned_3dgs_") and names[3].startswith("native_tiny_smoe-0.05_3dgs_")


def test_an_axis_of_a_method_wins_over_the_scenes_over_the_suites(content, tiny_scene):
    scenes = [{"name": "one", "path": tiny_scene},
              {"name": "two", "path": tiny_scene, "densify_grad_thresholds": [0.001]}]
    methods = [{"name": "native"}, {"name": "native", "label": "other", "densify_grad_thresholds": [0.0001]}]
    suite = expand(changed(content, scenes=scenes, methods=methods, blend_modes=["smoe"]), "")
    found = {(cell["scene"]["name"], cell["method"]["label"]): cell["densify_grad_threshold"] for cell in suite.cells}
    assert found == {("one", "native"): 0.005, ("two", "native"): 0.001, ("one", "other"): 0.0001,
                     ("two", "other"): 0.0001}


def test_headline_cells_get_more_seeds(content):
    suite = expand(changed(content, densify_grad_thresholds=[0.005, 0.001], blend_modes=["smoe"],
                           headline={"densify_grad_thresholds": [0.005]}, headline_seeds=[1, 2]), "")
    assert sorted((cell["densify_grad_threshold"], cell["seed"], cell["headline"]) for cell in suite.cells) == [
        (0.001, 0, False), (0.005, 0, True), (0.005, 1, True), (0.005, 2, True)]


def test_the_name_of_a_cell_is_that_of_its_figures(content, tiny_scene, tmp_path):
    """Another protocol is another cell; another place of the same data is not."""
    one = expand(content, "").cells[0]["id"]
    longer = changed(content, protocol={**content["protocol"], "iterations": 13})
    assert expand(longer, "").cells[0]["id"] != one
    moved = changed(content, scenes=[{"name": "tiny", "path": str(tmp_path)}])
    assert expand(moved, "").cells[0]["id"] == one
    white = changed(content, scenes=[{"name": "tiny", "path": tiny_scene, "background": "white"}])
    assert expand(white, "").cells[0]["id"] != one


@pytest.mark.parametrize("change, words", [
    ({"blend_mode": ["alpha"]}, ["blend_mode", "allowed are background_gates, blend_modes"]),
    ({"blend_modes": ["smooth"]}, ["blend_modes[0]", "smooth"]),
    ({"background_gates": [-1]}, ["background_gates[0]", "-1"]),
    ({"background_gates": ["leanred"]}, ["background_gates[0]", "leanred"]),
    ({"densify_grad_thresholds": [0]}, ["densify_grad_thresholds[0]"]),
    ({"densify_grad_thresholds": ["5e-3"]}, ["densify_grad_thresholds[0]", "write 0.005"]),
    ({"seeds": []}, ["seeds"]),
    ({"seeds": 0}, ["seeds", "a valid list, such as [0]"]),
    ({"name": "../x"}, ["name"]),
    ({"name": "x\n"}, ["name", "x\\n"]),
    ({"name": 65 * "x"}, ["name", "at most 64"]),
    ({"densify_grad_thresholds": [1e300]}, ["densify_grad_thresholds[0]", "less than or equal to 1000000"]),
    ({"seeds": [1.0]}, ["seeds[0]", "1.0", "integer"]),
    ({"scenes": [{"name": "a"}]}, ["scenes[0]", "path", "synthetic"]),
    ({"scenes": [{"name": "a", "path": "p", "resolution": 0}]}, ["scenes[0].resolution"]),
    ({"scenes": [{"name": "a", "path": "p"}, {"name": "a", "path": "q"}]}, ["scenes[1].name", "'a'"]),
    ({"scenes": "nowhere.yaml"}, ["scenes", "nowhere.yaml"]),
    ({"methods": [{"name": "4dgs"}]}, ["methods[0].name", "4dgs"]),
    ({"methods": [{"name": "native"}, {"name": "native"}]}, ["methods[1].label", "native"]),
    ({"methods": [{"name": "native", "path": "p"}]}, ["methods[0].path"]),
    ({"methods": [{"name": "native", "path": "native"}]}, ["methods[0].path", "is for checkouts"]),
    ({"methods": [{"name": "native", "budget": 5}]}, ["methods[0].budget", "taming and dbs"]),
    ({"methods": [{"name": "native", "iterations": 7}]}, ["methods[0]", "iterations"]),
    ({"protocol": {"iterations": 0}}, ["protocol.iterations"]),
    ({"protocol": {"options": {"densify_until": 1}}}, ["protocol.options", "densify_until"]),
    ({"protocol": {"options": {"lambda_dssim": 2}}}, ["--lambda-dssim", "2"]),
    ({"protocol": {"options": {"densify_from_iter": "x"}}}, ["protocol.options.densify_from_iter"]),
])
def test_a_mistake_names_its_field(content, change, words):
    with pytest.raises(BenchError) as error:
        expand(changed(content, **change), "")
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "", "name: x", 2000 * "["])
def test_a_file_that_is_no_suite_is_named(tmp_path, text):
    path = tmp_path / "suite.yaml"
    path.write_text(text)
    with pytest.raises(BenchError, match="suite.yaml"):
        load_suite(str(path))


@pytest.mark.parametrize("text, words", [
    ("protocol: {iterations: 7}\nname: a\nprotocol: {}\n", "'protocol' is there twice.*line 3"),
    ("protocol: {options: {opacity_lr: 1, opacity_lr: 2}}\n", "'opacity_lr' is there twice.*line 1")])
def test_a_field_that_is_there_twice_is_refused(tmp_path, text, words):
    path = tmp_path / "suite.yaml"
    path.write_text(text)
    with pytest.raises(BenchError, match=words):
        load_suite(str(path))


def test_a_variable_that_is_not_set_is_named(content, monkeypatch):
    monkeypatch.delenv("NOT_THERE", raising=False)
    one, = {cell["id"] for cell in expand(changed(content, blend_modes=["alpha"]), "").cells}
    scenes = [{"name": "tiny", "path": "${NOT_THERE}/a"}]
    cell, = expand(changed(content, blend_modes=["alpha"], scenes=scenes), "").cells
    assert cell["scene"]["unset"] == "scenes[0].path: $NOT_THERE is not set; it is a part of '${NOT_THERE}/a'"
    assert cell["id"] == one


def test_a_relative_path_is_from_the_suites_folder_and_one_in_a_variable_from_the_folder_at_hand(
        content, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DATA", "data")
    scenes = [{"name": "a", "path": "data/a"}, {"name": "b", "path": "${DATA}/b"}]
    suite = expand(changed(content, scenes=scenes), "/suites")
    assert [scene["path"] for scene in suite.scenes] == ["/suites/data/a", str(tmp_path / "data" / "b")]


# What would put figures of two protocols into one table.

def test_a_checkout_whose_loader_moves_the_principal_point_is_not_compared_with_one_that_keeps_it(content):
    checkout = {"name": "3dgs-2023", "path": "p"}
    with pytest.raises(BenchError, match="principal_point"):
        expand(on_cuda(content, methods=[checkout], protocol={"principal_point": "scene"}), "")
    assert len(expand(on_cuda(content, methods=[checkout]), "").cells) == 2


@pytest.mark.parametrize("words", [["-r", 4], ["--images", "images_2"], ["--white_background"], ["--iterations", 7000],
                                   ["--resolution=2"], ["--densify_grad_threshold", 0.1], ["--train_test_exp"],
                                   ["--random_background"], ["--llffhold", 4], ["--start_checkpoint", "/x"],
                                   ["--lambda_dss", 0.5], ["--iter", 7000], ["--res=4"], ["-r4"], ["-wr4"],
                                   ["--load_iteration", 7], ["--densification", 7]])
def test_a_checkouts_arguments_cannot_change_the_protocol(content, words):
    with pytest.raises(BenchError, match=r"methods\[0\].arguments: " + words[0].partition("=")[0]):
        expand(on_cuda(content, methods=[{"name": "taming", "path": "p", "arguments": words}]), "")


def test_two_downscalers_are_refused(content):
    scenes = [{"name": "a", "path": "p", "images": "images_4"}, {"name": "b", "path": "q", "resolution": 2}]
    with pytest.raises(BenchError, match="two downscalers"):
        expand(changed(content, scenes=scenes), "")
    scenes[1]["resolution"] = 1
    assert expand(changed(content, scenes=scenes), "").cells


def test_recipes_that_a_checkout_cannot_follow_are_refused(content):
    methods = [{"name": "3dgs-2023", "path": "p"}]
    for protocol in ({"scale_recipe": True}, {"options": {"sh_degree_interval": 500}}, {"device": "cpu"}):
        with pytest.raises(BenchError, match="protocol"):
            expand(on_cuda(content, methods=methods, protocol=protocol), "")
    white = [{"name": "lego", "path": "p", "background": "white"}]
    with pytest.raises(BenchError, match="lego is white"):
        expand(on_cuda(content, methods=methods, scenes=white, schedules=["steady"]), "")
    few = [{"name": "lego", "path": "p", "init_points": 10}]
    with pytest.raises(BenchError, match="lego, methods: 3dgs-2023: init_points is 10"):
        expand(on_cuda(content, methods=[{"name": "native"}, *methods], scenes=few), "")
    assert expand(on_cuda(content, scenes=few), "").cells
    with pytest.raises(BenchError, match="methods: 3dgs-2023: background_gates: 'learned' is for the native"):
        expand(on_cuda(content, methods=methods, background_gates=["learned"]), "")


@pytest.mark.parametrize("name, option, value", [
    ("3dgs-2023", "antialiasing", True), ("2dgs", "antialiasing", True), ("taming", "feature_lr", 0.01),
    ("hac", "opacity_reset_interval", 500), ("hac-plus", "sh_degree", 2), ("dbs", "percent_dense", 0.1),
    ("dbs", "opacity_reset_interval", 3000), ("dbs", "feature_lr", 0.0025)])
def test_an_option_that_a_checkout_lacks_is_refused(name, option, value, content):
    method = {"name": name, "path": "p", "arguments": ["--cap_max", 5] if name == "dbs" else []}
    with pytest.raises(BenchError, match=rf"protocol.options.{option}: {name} \(methods\[0\]\)"):
        expand(on_cuda(content, methods=[method], protocol={"options": {option: value}}), "")
    assert expand(on_cuda(content, methods=[method], protocol={"options": {"antialiasing": False}}), "").cells
    assert expand(on_cuda(content, protocol={"options": {option: value}}), "").cells


def test_an_unpatched_checkout_has_its_own_blending_alone(content):
    methods = [{"name": "3dgs-2023", "path": "p", "variant": "unpatched"}]
    cells = expand(on_cuda(content, methods=methods), "").cells
    assert [(cell["blend_mode"], cell["method"]["label"]) for cell in cells] == [("alpha", "3dgs-2023-unpatched")]
    with pytest.raises(BenchError, match=r"methods\[0\].blend_modes"):
        expand(on_cuda(content, methods=[dict(methods[0], blend_modes=["smoe"])]), "")
    with pytest.raises(BenchError, match=r"methods\[0\].variant"):
        expand(on_cuda(content, methods=[{"name": "2dgs", "path": "p", "variant": "patched"}]), "")


@pytest.mark.parametrize("name, arguments", [("dbs", ["--cap_max", 3000]), ("taming", [])])
def test_a_method_without_a_threshold_is_trained_once(name, arguments, content):
    method = {"name": name, "path": "p", "arguments": arguments, "blend_modes": ["alpha"]}
    with pytest.raises(BenchError, match=f"scenes: tiny, methods: .*{name} has no threshold"):
        expand(on_cuda(content, methods=[method], densify_grad_thresholds=[0.005, 0.0002]), "")
    method["densify_grad_thresholds"] = [0.0002]
    assert len(expand(on_cuda(content, methods=[method], densify_grad_thresholds=[0.005, 0.0002]), "").cells) == 1


@pytest.mark.parametrize("name, arguments, right", [
    ("dbs", ["--cap_max", 3000], False), ("dbs", ["--cap_max", 999], True),
    ("taming", ["--mode", "final_count", "--budget", 3000], False), ("taming", [], False),
    ("taming", ["--budget", 999], False), ("taming", ["--mode", "multiplier", "--budget", 999], False),
    ("taming", ["--budget", 999, "--mode", "final_count"], True)])
def test_a_budget_is_that_of_the_arguments(name, arguments, right, content):
    """Taming's --budget is a count with --mode final_count, and else a multiple of the number of points."""
    suite = on_cuda(content, methods=[{"name": name, "path": "p", "arguments": arguments, "budget": 999}])
    if right:
        assert expand(suite, "").cells
    else:
        with pytest.raises(BenchError, match=r"methods\[0\].budget: is 999"):
            expand(suite, "")


@pytest.mark.parametrize("name", SHIPPED_NAMES)
def test_shipped_suites_are_valid(name, monkeypatch):
    for variable in ("DSMOE_SCENES", "DSMOE_TRAINERS", "DSMOE_DATA"):
        monkeypatch.setenv(variable, "/somewhere")
    suite = load_suite(find_suite(name))
    assert suite.name == name and suite.cells
    if name == "fig4":
        assert {cell["densify_grad_threshold"] for cell in suite.cells} == set(THRESHOLDS)
        assert len({cell["scene"]["name"] for cell in suite.cells}) == 13


def test_the_suite_of_the_readme_is_valid(monkeypatch):
    monkeypatch.setenv("DSMOE_DATA", "/somewhere")
    readme = Path(__file__).resolve().parents[3] / "benchmarks" / "README.md"  # which is not installed
    text = readme.read_text(encoding="utf-8").partition("```yaml")[2].partition("```")[0]
    cells = expand(yaml.safe_load(text), "").cells
    assert {cell["method"]["label"] for cell in cells} == {
        "native", "3dgs-2023", "3dgs-2023-unpatched", "3dgs-2023-fused", "c3dgs"}
    assert {cell["seed"] for cell in cells if cell["headline"]} == {0, 1, 2}


def test_rows_from_before_there_were_gates_are_of_todays_cells(monkeypatch):
    """They are of Eq. 7; the suite of gates has some of them."""
    monkeypatch.setenv("DSMOE_DATA", "/somewhere")
    monkeypatch.setenv("DSMOE_TRAINERS", "/somewhere")
    rows = str(Path(__file__).resolve().parents[3] / "benchmarks" / "results" / "captures_h200.jsonl")
    if not os.path.isfile(rows):
        pytest.skip("the rows are in the repository, not in its source distribution")
    for name, lacking in (("captures", set()), ("gate", {0.03, 0.3, "learned"})):
        cells = [cell for cell in load_suite(find_suite(name)).cells if cell["seed"] == 0]
        found = earlier_rows(rows, cells)
        assert {cell["background_gate"] for cell in cells if cell["id"] not in found} == lacking
