"""Checkouts of public trainers as methods: small trainers of the same structure, patched, trained and measured.

The small trainers are those of the patches' tests; they make up their scene, which is written here as images too.
"""
from __future__ import annotations

import importlib
import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import small_dbs
import torch
from bench_commands import ABOVE, wait_for
from PIL import Image

from diff_smoe_rasterization import io
from diff_smoe_rasterization.benchmarks import preparation
from diff_smoe_rasterization.benchmarks.cell import work
from diff_smoe_rasterization.benchmarks.log import last_line
from diff_smoe_rasterization.benchmarks.methods import checkout as shapes
from diff_smoe_rasterization.benchmarks.suite import expand

pytest.importorskip("jsonschema", reason="suites are checked by jsonschema: pip install jsonschema")
pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

PATCHES = Path(__file__).resolve().parents[1] / "patches"
ITERATIONS = 7


def small_trainers():
    """The modules of the patches' tests that make checkouts."""
    sys.path.insert(0, str(PATCHES))
    try:
        return importlib.import_module("checkouts")
    finally:
        sys.path.remove(str(PATCHES))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Written by a process of its own: the small trainers' modules have everyday names."""
    folder = tmp_path_factory.mktemp("bench") / "scene"
    small_trainers().make_scene(folder)
    program = ("import numpy, sys; from scene.dataset_readers import read_made_up_scene; "
               "made = read_made_up_scene(sys.argv[1]); "
               "numpy.savez(sys.argv[2], **{view.image_name: view.image for view in made.hidden + made.shown})")
    stored = folder.parent / "views.npz"
    made = folder.parent / "checkout"
    small_trainers().make_checkout("3dgs-2023", made)
    subprocess.run([sys.executable, "-c", program, str(folder), str(stored)], check=True, cwd=str(made),
                   env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, [made, PATCHES / "packages", ABOVE]))})
    with np.load(stored) as views:
        write_views(folder, {name: views[name] for name in views.files})
    return folder


def write_views(folder, views):
    """A COLMAP model whose images are these; the cameras are of no importance where a checkout has its own."""
    (folder / "images").mkdir()
    images = []
    for index, (name, view) in enumerate(sorted(views.items()), start=1):
        pixels = (np.clip(view, 0, 1) * 255).round().astype(np.uint8).transpose(1, 2, 0)
        Image.fromarray(pixels).save(folder / "images" / (name + ".png"))
        images.append(io.ColmapImage(index, name + ".png", 1, np.array([1.0, 0, 0, 0]), np.array([0.0, 0, index])))
    height, width = pixels.shape[:2]
    camera = io.ColmapCamera(1, "PINHOLE", width, height, np.array([30.0, 30.0, width / 2, height / 2]))
    points = io.Points(np.random.RandomState(0).rand(20, 3), np.zeros((20, 3), np.uint8))
    io.write_colmap(str(folder / "sparse" / "0"), io.ColmapModel({1: camera}, images, points), text=True)


class SmallTrainers:
    """Cells of small trainers, and their rows, each trained once."""

    def __init__(self, scene, folder):
        self.scene, self.folder = scene, folder
        self.rows = {}

    def checkout(self, name):
        path = self.folder / f"checkout-{name}"
        return str(path if path.is_dir() else small_trainers().make_checkout(name, path))

    def cell(self, name, variant="patched", scene=None, seed=0, blend_mode="smoe", options=None, **method):
        """A suite refuses checkouts on the CPU, as the public ones cannot train there: it is set afterwards."""
        method = {"name": name, "variant": variant, "pythonpath": [str(small_trainers().PACKAGES)],
                  "blend_modes": [blend_mode], **method}
        if "path" not in method:
            method["path"] = self.checkout(name)
        if name == "c3dgs":
            method["base"] = self.checkout("3dgs-2023")
        content = {"name": "checkouts", "protocol": {"iterations": ITERATIONS, "lpips": [], "options": options or {}},
                   "scenes": [{"name": "made-up", "path": str(scene or self.scene)}], "methods": [method],
                   "seeds": [seed], "densify_grad_thresholds": [0.0001], "images": 1}
        cell, = expand(content, "").cells
        cell["protocol"] = {**cell["protocol"], "device": "cpu"}
        return dict(cell, method=preparation.prepared_method(cell["method"], str(self.folder / "results")))

    def run(self, *words, **options):
        """(row, output folder) of a cell with these arguments of `cell`."""
        key = json.dumps([words, options], default=str, sort_keys=True)
        if key not in self.rows:
            output = self.folder / f"out {len(self.rows)}"
            self.rows[key] = row_of(self.cell(*words, **options), output), output
        return self.rows[key]


def row_of(cell, output):
    output.mkdir()
    work(cell, str(output), 0.0)
    return json.loads((output / "row.json").read_text())


@pytest.fixture(scope="module")
def small(scene, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", ABOVE)
        patch.setenv("OMP_NUM_THREADS", "1")
        patch.setattr(shapes.ThreeDGS, "container", "point_cloud.npz")  # the small trainers write no .ply,
        patch.setattr(shapes.HAC, "own_bytes", shapes.ThreeDGS.own_bytes)  # and no bitstreams
        yield SmallTrainers(scene, tmp_path_factory.mktemp("small"))


@pytest.mark.parametrize("name", ["3dgs-2023", "c3dgs", "hac"])
def test_a_patched_checkout_gives_a_row(name, small):
    row, output = small.run(name)
    assert row["ok"], row["reason"]
    assert (row["method"], row["variant"], row["blend_mode"]) == (name, "patched", "smoe")
    assert row["schedule"] == (None if name == "hac" else "3dgs")
    for figure in ("psnr", "psnr_float", "ssim", "fps", "num_gaussians"):
        assert row[figure] > 0, figure
    protocol = row["protocol"]
    assert protocol["schedule"] == row["schedule"] and protocol["recipe"] == {} and protocol["scale_recipe"] is False
    assert protocol["densify_grad_threshold"] == 0.0001 and protocol["sh_degree"] == (None if name == "hac" else 3)
    assert row["size_bytes"]["common"] == (None if name == "hac" else 236 * row["num_gaussians"])
    if name == "c3dgs":
        assert row["train_seconds"] is None  # the small one does not say how long compression took
    else:
        assert 0 < row["train_seconds"] < row["wall_seconds"]
    # The ground truth was rounded to 8 bits on its way here: a quarter of a grey level on average.
    assert 0 < row["protocol"]["ground_truth_difference"] < 0.5 / 255
    assert row["protocol"]["test_views"] == len(row["per_view"]) == 1
    assert (output / "images" / "render" / "view0.png").is_file()
    assert not (output / "renders").exists() and not (output / "run").exists()


def test_a_trainer_that_would_choose_on_the_test_views_is_kept_from_it(small, tmp_path):
    """Of Deformable Beta Splatting's --eval the split alone is taken; the mean of the training views is its model."""
    with np.load(small.scene.parent / "views.npz") as file:
        views = {name: file[name] for name in file.files}
    checkout = small_dbs.write(tmp_path / "dbs", views)
    row = row_of(small.cell("dbs", variant="unpatched", blend_mode="alpha", path=str(checkout),
                            arguments=["--cap_max", 12]), tmp_path / "out")
    assert row["ok"], row["reason"]
    rules = row["protocol"]
    assert rules["schedule"] is rules["densify_grad_threshold"] is rules["sh_degree"] is None and rules["recipe"] == {}
    assert row["size_bytes"]["common"] is None  # a Beta primitive is no Gaussian of 59 numbers
    assert row["num_gaussians"] == 12 and row["train_seconds"] > 0 and row["fps"] > 0 and row["schedule"] is None
    level = np.mean([views[name].mean() for name in sorted(views)[1:]])
    truth = np.asarray(Image.open(small.scene / "images" / "view0.png"), np.float64) / 255
    # float32 sums of some thousand values
    assert row["psnr_float"] == pytest.approx(-10 * np.log10(((truth - level) ** 2).mean()), abs=1e-4)


def test_the_figures_are_those_of_the_pictures(small):
    row, output = small.run("3dgs-2023")
    gt, render = (np.asarray(Image.open(output / "images" / kind / "view0.png"), np.float64) / 255
                  for kind in ("gt", "render"))
    # The definition, in float64; images are float32 in the program.
    assert row["psnr"] == pytest.approx(-10 * np.log10(((gt - render) ** 2).mean()), abs=1e-3)


@pytest.mark.parametrize("other", [{"seed": 1}, {"blend_mode": "alpha"}, {"background_gates": [0.3]}])
def test_blend_and_seed_reach_the_trainer(other, small):
    (one, _), (changed, _) = small.run("3dgs-2023"), small.run("3dgs-2023", **other)
    assert one["ok"] and changed["ok"] and one["psnr"] != changed["psnr"]


def test_no_variable_decides_a_blend(small, monkeypatch):
    variables = {"DSMOE_BLEND_MODE": "smoe", "DSMOE_BACKGROUND_GATE": "0.3"}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    cell = small.cell("3dgs-2023")
    assert not set(variables) & set(shapes.ThreeDGS(cell, shapes.config_of(cell), "out").environment())


def test_steady_means_neither_reset_nor_size_prune(small):
    cell = small.cell("3dgs-2023", schedules=["steady"])
    words = shapes.ThreeDGS(cell, shapes.config_of(cell), "out").train_arguments()
    assert words[words.index("--opacity_reset_interval") + 1] == str(ITERATIONS + 1)
    cell = small.cell("3dgs-2023")
    assert "--opacity_reset_interval" not in shapes.ThreeDGS(cell, shapes.config_of(cell), "out").train_arguments()


def rules_and_words(cell):
    """What the row's protocol would say, and the words of the trainer's command."""
    shape = shapes.SHAPES[cell["method"]["name"]](cell, shapes.config_of(cell), "out")
    return shape.rules(), shape.train_arguments()


def test_an_option_of_the_suite_reaches_a_checkout_also_where_it_is_our_default(small):
    """0.05 is not the default of 3DGS of 2024."""
    rules, words = rules_and_words(small.cell("3dgs-2024", options={"opacity_lr": 0.05, "antialiasing": True}))
    assert words[words.index("--opacity_lr") + 1] == "0.05" and "--antialiasing" in words and "True" not in words
    assert rules["recipe"] == {"opacity_lr": 0.05, "antialiasing": True} and rules["scale_recipe"] is False
    rules, words = rules_and_words(small.cell("3dgs-2024", options={"antialiasing": False, "sh_degree_interval": 1000}))
    assert not [word for word in words if "antialiasing" in word or "sh_degree" in word or word == "--opacity_lr"]


def test_an_option_that_a_method_has_a_value_of_its_own_for_is_not_said_of_its_row(small):
    cell = small.cell("taming", options={"densification_interval": 100, "opacity_lr": 0.05},
                      arguments=["--densification_interval=500"])
    rules, words = rules_and_words(cell)
    assert words[-1] == "--densification_interval=500"  # the last word counts
    assert rules["recipe"] == {"opacity_lr": 0.05} and rules["densify_grad_threshold"] is None
    assert "--densify_grad_threshold" not in words


def test_the_degree_of_a_checkout_with_another_default_is_said_where_the_suite_says_it(small):
    for options, degree in (({}, None), ({"sh_degree": 2}, 2)):
        method = {"variant": "unpatched", "blend_mode": "alpha", "path": "p", "arguments": ["--cap_max", 5]}
        assert rules_and_words(small.cell("dbs", options=options, **method))[0]["sh_degree"] == degree


def test_the_row_of_a_compression_says_what_decided_it(small, tmp_path):
    """Both commands with the recipe, both commits and the larger peak."""
    options, arguments = {"lambda_dssim": 0.3}, ["--finetune_iterations", 2]
    cell = small.cell("c3dgs", options=options, arguments=arguments, base_commit="1234567")
    row = row_of(cell, tmp_path / "out")
    assert row["ok"], row["reason"]
    rules = row["protocol"]
    trained, compressed = (rules["arguments"][:rules["arguments"].index("--model_path")],
                           rules["arguments"][rules["arguments"].index("--model_path"):])
    assert trained[:4] == ["-s", "scene", "-m", "base"] and compressed[:4] == ["--model_path", "base", "--output_vq",
                                                                              "compressed"]
    for words in (trained, compressed):
        assert words[words.index("--lambda_dssim") + 1] == "0.3"
    assert compressed[-2:] == ["--finetune_iterations", "2"] and rules["recipe"] == options
    assert rules["base_commit"] == "1234567"


@pytest.mark.parametrize("base, compression, peak", [(5.0, 7.0, 7.0), (7.0, 5.0, 7.0), (None, None, None)])
def test_the_peak_of_a_compression_is_that_of_both_its_commands(base, compression, peak, small, monkeypatch):
    records = iter([{"loop_seconds": 1.0, "peak_gpu_mib": base}, {"loop_seconds": None, "peak_gpu_mib": compression}])
    cell = small.cell("c3dgs")
    shape = shapes.C3DGS(cell, shapes.config_of(cell), "out")
    monkeypatch.setattr(shape, "command", lambda *words, **more: next(records))
    assert shape.train() == {"loop_seconds": 1.0, "peak_gpu_mib": peak}


def test_the_peak_of_a_command_ends_with_the_bar_of_its_training(monkeypatch):
    """compress.py measures LPIPS afterwards, whose networks are no part of it; a bar may be one that is disabled."""
    import tqdm

    from diff_smoe_rasterization.benchmarks.methods import observer

    held = iter([3, 9])
    monkeypatch.setattr(tqdm, "tqdm", tqdm.tqdm)  # is put back
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: next(held) * 2**20)
    found = observer.watch_loop(0, {})
    for keywords in ({"desc": "Calculating"}, {"disable": True}, {"desc": "Training progress"},
                     {"desc": "Training progress"}):
        tqdm.tqdm(range(5), **keywords).close()
    assert found == {"peak": 3.0}


def test_the_arguments_of_a_compression_are_not_those_of_the_training_before_it(small):
    mode = ["--blend_mode", "smoe", "--background_gate", "0.0"]
    for name, last in (("taming", [*mode, "--budget", "5"]), ("c3dgs", mode)):
        cell = small.cell(name, arguments=["--budget", 5])
        words = shapes.SHAPES[name](cell, shapes.config_of(cell), "out").train_arguments()
        assert words[-len(last):] == last


def test_a_checkout_that_was_trained_on_other_images_is_refused(small, scene, tmp_path):
    other = tmp_path / "other scene"
    shutil.copytree(scene, other)
    path = other / "images" / "view0.png"
    Image.fromarray(255 - np.asarray(Image.open(path))).save(path)
    row = row_of(small.cell("3dgs-2023", scene=other), tmp_path / "out")
    assert not row["ok"] and "ground truth differs" in row["reason"]


def test_a_checkout_with_another_split_is_refused(small, scene, tmp_path):
    other = tmp_path / "other scene"
    shutil.copytree(scene, other)
    shutil.rmtree(other / "sparse")
    shutil.rmtree(other / "images")
    write_views(other, {f"a_view{index}": np.zeros((3, 24, 32)) for index in range(4)})
    row = row_of(small.cell("3dgs-2023", scene=other), tmp_path / "out")
    assert not row["ok"] and "split" in row["reason"] and "view0" in row["reason"]


def test_a_trainer_that_fails_is_a_row_with_its_last_words(small, tmp_path):
    row = row_of(small.cell("3dgs-2023", arguments=["--no_such_flag"]), tmp_path / "out")
    assert not row["ok"] and "train.py of 3dgs-2023 ended with status 2" in row["reason"]
    assert "--no_such_flag" in row["reason"]


def test_a_trainer_ends_with_its_cell(small, tmp_path):
    (tmp_path / "2dgs").mkdir()
    (tmp_path / "2dgs" / "train.py").write_text(
        "import os, time\nopen('pid.part', 'w').write(str(os.getpid()))\nos.rename('pid.part', 'pid')\n"
        "time.sleep(600)\n")
    cell, pid = tmp_path / "cell.json", tmp_path / "2dgs" / "pid"
    cell.write_text(json.dumps(small.cell("2dgs", variant="unpatched", blend_mode="alpha",
                                          path=str(tmp_path / "2dgs"))))
    run = subprocess.Popen([sys.executable, "-m", "diff_smoe_rasterization.benchmarks.cell", str(cell),
                            str(tmp_path / "out")], cwd=str(tmp_path))
    wait_for(pid.is_file, 60)
    run.terminate()
    assert run.wait() == 143
    wait_for(lambda: not Path("/proc", pid.read_text()).exists(), 60)


def test_the_last_words_are_not_a_progress_bars(tmp_path):
    """tqdm draws a bar that was left open once more, after the error."""
    program = "import tqdm; bar = tqdm.tqdm(range(3), desc='Training progress'); raise KeyError('why')"
    log = tmp_path / "log"
    with open(log, "w") as file:
        subprocess.call([sys.executable, "-c", program], stderr=file)
    assert "Training progress" in log.read_text().splitlines()[-1]
    assert last_line(str(log)) == "KeyError: 'why'"


def test_a_patched_checkout_is_a_copy(small, tmp_path):
    cell = small.cell("3dgs-2023")
    original = small.folder / "checkout-3dgs-2023"
    assert cell["method"]["path"] == str(small.folder / "results" / "checkouts" / "3dgs-2023-path")
    assert preparation.patches.check(original) == "patchable"
    assert preparation.patches.check(cell["method"]["path"]) == "patched"


def test_a_fused_checkout_is_a_copy_of_its_own(small, tmp_path):
    cell = small.cell("3dgs-2023", variant="fused")
    assert cell["method"]["label"] == "3dgs-2023-fused" and "refused" not in cell["method"]
    patched = small.cell("3dgs-2023")["method"]["path"]
    losses = [Path(path, "utils", "loss_utils.py").read_text() for path in (cell["method"]["path"], patched)]
    assert ["@fused_where_equal" in text for text in losses] == [True, False]
    row = row_of(cell, tmp_path / "out")
    assert row["ok"] and row["variant"] == "fused"
    assert row["protocol"]["arguments"][-4:] == ["--blend_mode", "smoe", "--background_gate", "0.0"]
    # A checkout that was fused already is used as it is, and is not the patched one.
    without_record = str(tmp_path / "without record")
    shutil.copytree(cell["method"]["path"], without_record, ignore=shutil.ignore_patterns(".dsmoe_patch"))
    for path, variant, expected in ((cell["method"]["path"], "fused", cell["method"]["path"]),
                                    (without_record, "fused", without_record), (without_record, "patched", None),
                                    (cell["method"]["path"], "patched", None),
                                    (patched, "fused", str(tmp_path / "checkouts" / "fused-path"))):
        method = dict(cell["method"], label="fused", path=path, variant=variant)
        method = preparation.prepared_method(method, str(tmp_path))
        assert method["path"] == (expected or path)
        assert ("`variant: fused`" in method.get("refused", "")) == (expected is None)


def test_an_unpatched_checkout_must_be_one(small, tmp_path):
    cell = small.cell("3dgs-2023", variant="unpatched", blend_mode="alpha")
    assert "refused" not in cell["method"]
    patched = small.cell("3dgs-2023")["method"]["path"]
    method = preparation.prepared_method(dict(cell["method"], path=patched), str(tmp_path / "results"))
    assert "is patched" in method["refused"]
    row = row_of(dict(cell, method=method), tmp_path / "out")
    assert not row["ok"] and row["reason"] == method["refused"]


def test_a_checkout_that_cannot_be_patched_is_a_row(small, tmp_path):
    cell = small.cell("3dgs-2023")
    (tmp_path / "empty").mkdir()
    method = preparation.prepared_method(dict(cell["method"], path=str(tmp_path / "empty")), str(tmp_path))
    row = row_of(dict(cell, method=method), tmp_path / "out")
    assert not row["ok"] and "the checkout is unknown: there is no gaussian_renderer" in row["reason"]


def test_what_a_trainer_writes_beside_its_scene_stays_its_own(tmp_path):
    source, linked = tmp_path / "scene", tmp_path / "linked"
    read_over = ("sparse/0/points3D.ply", "points3d.ply")
    for file in ("images/0.png", "sparse/0/points3D.bin", "transforms_train.json", *read_over):
        (source / file).parent.mkdir(parents=True, exist_ok=True)
        (source / file).write_text(file)
    (source / read_over[0]).chmod(0o444)
    before = sorted(source.rglob("*"))
    shapes.linked_scene(str(source), str(linked))
    for file in ("sparse/0/points3D.ply", "points3d.ply", "input.ply"):
        (linked / file).write_text("made")
    assert (linked / "images/0.png").read_text() == "images/0.png"
    assert (linked / "sparse/0/points3D.bin").read_text() == "sparse/0/points3D.bin"
    shutil.rmtree(linked)
    assert sorted(source.rglob("*")) == before
    assert [(source / file).read_text() for file in read_over] == list(read_over)


def test_a_model_that_is_kept_names_a_scene_that_is_there(small, tmp_path):
    cell = {**small.cell("3dgs-2023"), "keep_models": True}
    assert row_of(cell, tmp_path / "out")["ok"]
    linked = tmp_path / "out" / "scene"
    assert f"source_path='{linked}'" in (tmp_path / "out" / "run" / "cfg_args").read_text()
    assert (linked / "images" / "view0.png").is_file()
    assert not (small.run("3dgs-2023")[1] / "scene").exists()


def test_a_row_says_the_arguments_without_the_folders_of_this_machine():
    words = ["-s", "/a/scene", "--model", "/a/b/", "--data=/a/c/", "--ratio=1/2", "--flag", "a/b", "/d=e/f"]
    assert shapes.portable(words) == ["-s", "scene", "--model", "b", "--data=c", "--ratio=1/2", "--flag", "a/b", "f"]


def test_modules_that_are_imported_and_not_used_may_be_absent():
    """2DGS imports what extracts meshes."""
    from diff_smoe_rasterization.benchmarks.methods import observer

    observer.stub("a_module_that_nobody_has")
    try:
        from a_module_that_nobody_has import part

        import a_module_that_nobody_has.other as other
        with pytest.raises(TypeError):
            part()
        assert other is not None
    finally:
        for name in [name for name in sys.modules if name.startswith("a_module_that_nobody_has")]:
            del sys.modules[name]
    observer.stub("json")
    assert sys.modules["json"] is json


def test_modules_that_end_the_process_are_stood_in_for(tmp_path):
    """In a process of its own, where they stay so."""
    (tmp_path / "leaver.py").write_text("raise SystemExit('no display')")
    program = ("import sys; sys.path[:0] = sys.argv[1:]; import observer; "
               "observer.stub('leaver'); import leaver; print(leaver.window)")
    subprocess.run([sys.executable, "-c", program, os.path.dirname(shapes.OBSERVER), str(tmp_path)], check=True)


def test_no_picture_is_written_where_renderings_are_kept(tmp_path):
    """With torchvision or without; in a process of its own, where it stays so."""
    program = ("import sys; sys.path.insert(0, sys.argv[1]); import observer; "
               "observer.write_no_pictures(); import torchvision; torchvision.utils.save_image(None, sys.argv[2])")
    subprocess.run([sys.executable, "-c", program, os.path.dirname(shapes.OBSERVER), str(tmp_path / "a.png")],
                   check=True)
    assert not list(tmp_path.iterdir())


def test_seeds_are_shifted_by_the_cells():
    """In a process of its own: the functions stay replaced."""
    program = ("import sys; sys.path.insert(0, sys.argv[1]); import observer, random, numpy, torch; "
               "observer.shift_seeds(5); random.seed(0); numpy.random.seed(0); torch.manual_seed(0); "
               "print(random.random(), numpy.random.rand(), torch.rand(1).item())")
    folder = os.path.dirname(shapes.OBSERVER)
    printed = subprocess.run([sys.executable, "-c", program, folder], stdout=subprocess.PIPE, check=True).stdout
    expected = (random.Random(5).random(), np.random.RandomState(5).rand(),
                torch.rand(1, generator=torch.Generator().manual_seed(5)).item())
    assert [float(word) for word in printed.split()] == list(expected)
