"""Checkouts of public trainers as methods: a small trainer of the same structure, patched, trained and measured.

The small trainer is that of the patches' tests.
"""
import importlib
import json
import random
import runpy
import shutil
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from bench_commands import python_that, wait_for
from checkouts import HERE, PACKAGE_PARENT, PACKAGES, contents, make_checkout, make_scene
from PIL import Image

from dsmoe.bench import preparation
from dsmoe.bench.cell import work
from dsmoe.bench.errors import BenchError
from dsmoe.bench.expansion import expand
from dsmoe.bench.methods import checkout as shapes
from dsmoe.bench.methods import observer

ITERATIONS = 7


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The small trainer's scene in NeRF's form; its cameras do not matter, as a checkout has its own."""
    folder = make_scene(tmp_path_factory.mktemp("bench") / "scene")
    made = runpy.run_path(str(HERE / "trainer" / "scene" / "dataset_readers.py"))["read_made_up_scene"](str(folder))
    for split, views in (("train", made.shown), ("test", made.hidden)):
        frames = [{"file_path": view.image_name, "transform_matrix": np.eye(4).tolist()} for view in views]
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.9, "frames": frames}))
        for view in views:
            pixels = (np.clip(view.image, 0, 1) * 255).round().astype(np.uint8).transpose(1, 2, 0)
            Image.fromarray(pixels).save(folder / f"{view.image_name}.png")
    return folder


@pytest.fixture(scope="module")
def small(scene, tmp_path_factory):
    """Makes cells of the small trainer."""
    folder = tmp_path_factory.mktemp("small")
    checkout = str(make_checkout(folder / "checkout"))

    def cell(name, variant="patched", seed=0, blend_mode="smoe", options=None, **method):
        """A suite refuses checkouts on the CPU, as the public ones cannot train there: it is set afterwards."""
        method = {"name": name, "variant": variant, "path": checkout, "pythonpath": [str(PACKAGES)],
                  "blend_modes": [blend_mode], **({"base": checkout} if name == "c3dgs" else {}), **method}
        content = {"name": "checkouts", "protocol": {"iterations": ITERATIONS, "lpips": [], "options": options or {}},
                   "scenes": [{"name": "made-up", "path": str(scene)}], "methods": [method], "seeds": [seed],
                   "densify_grad_thresholds": [0.0001], "images": 1}
        cell, = expand(content, "").cells
        return {**cell, "protocol": {**cell["protocol"], "device": "cpu"},
                "method": preparation.prepared_method(cell["method"], str(folder / "results"))}

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(PACKAGE_PARENT))
        patch.setenv("OMP_NUM_THREADS", "1")
        patch.setattr(shapes.ThreeDGS, "container", "point_cloud.npz")  # the small trainer writes no .ply
        yield cell


def row_of(cell, output):
    work(cell, str(output), 0.0)
    return json.loads((output / "row.json").read_text())


def test_a_patched_checkout_gives_a_row(small, tmp_path):
    """Its learned gate is the one that render.py found in the model."""
    row = row_of(small("3dgs-2023", background_gates=["learned"]), tmp_path)
    assert row["ok"], row["reason"]
    assert (row["method"], row["variant"], row["blend_mode"]) == ("3dgs-2023", "patched", "smoe")
    assert all(row[figure] > 0 for figure in ("psnr", "psnr_float", "ssim", "fps", "num_gaussians"))
    protocol = row["protocol"]
    assert protocol["strategy"] == row["strategy"] == "3dgs" and protocol["recipe"] == {}
    assert protocol["densify_grad_threshold"] == 0.0001 and protocol["sh_degree"] == 3
    assert row["background_gate"] == "learned" and 0.05 < protocol["background_gate"] < 0.2
    assert protocol["background_gate"] != 0.1  # it starts there
    assert 0 < row["train_seconds"] < row["wall_seconds"]
    # The ground truth was rounded to 8 bits on its way here: a quarter of a grey level on average.
    assert 0 < row["protocol"]["ground_truth_difference"] < 0.5 / 255
    assert row["protocol"]["test_views"] == len(row["per_view"]) == 1
    assert (tmp_path / "images" / "render" / "view0.png").is_file()
    assert not (tmp_path / "renders").exists() and not (tmp_path / "run").exists()


@pytest.fixture
def started(monkeypatch):
    """The words and the environment of each command that is started in place of running it."""
    found = []

    def call(line, env, **_):
        found.append((line, env))
        Path(line[2]).write_text(json.dumps({"loop_seconds": 5.0, "peak_gpu_mib": 10 * len(found)}))
        return 0

    monkeypatch.setattr(shapes.subprocess, "call", call)
    return found


def test_c3dgs_compresses_what_another_checkout_has_trained(small, started, tmp_path, monkeypatch):
    """The seed reaches both, and no variable does."""
    variables = {"DSMOE_BLEND_MODE": "smoe_tn", "DSMOE_BACKGROUND_GATE": "0.7"}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    cell = small("c3dgs", arguments=["--finetune_iterations", 3], seed=3)
    base, path = cell["method"]["base"], Path(cell["method"]["path"])
    (path / "compress.py").touch()
    shape = shapes.C3DGS(cell, shapes.config_of(cell), str(tmp_path))
    trained = shape.train()
    (train, _), (compress, _) = started
    for line, environment in started:
        assert line[:line.index("--")][line.index("--seed") + 1] == "3" and not set(variables) & set(environment)
    words = compress[compress.index("--") + 1:]
    assert train[train.index("--") + 1] == f"{base}/train.py" and words[0] == f"{path}/compress.py"
    assert train[train.index("-m") + 1] == words[words.index("--model_path") + 1]
    assert words[-2:] == ["--finetune_iterations", "3"] and trained["peak_gpu_mib"] == 20
    assert shape.train_seconds(trained) is None  # it does not say how long it took
    Path(shape.model).mkdir(parents=True)
    Path(shape.model, "times.json").write_text('{"total": 7}')
    assert shape.train_seconds(trained) == 12


@pytest.mark.parametrize("name, method, there, absent", [
    ("hac", {}, f"--eval --test_iterations {ITERATIONS}", ["--renders"]),
    ("dbs", {"variant": "unpatched", "blend_mode": "alpha", "arguments": ["--cap_max", 12]},
     "--cap_max 12 --disable_viewer --no-compress", ["--eval", "--blend_mode"])])
def test_trainers_of_one_process_have_rules_of_their_own(name, method, there, absent, small, started, tmp_path):
    """And no Gaussians of 59 numbers. Of Deformable Beta Splatting's --eval the observer takes only the split."""
    cell = small(name, **method)
    shape = shapes.SHAPES[name](cell, shapes.config_of(cell), str(tmp_path))
    assert shape.train() == shape.render() and len(started) == 1
    ours, words = " ".join(started[0][0]).split(" -- ")
    assert there in words and not {*absent} & {*words.split()} and f"--renders {shape.renders}" in ours
    assert ("--hold-out --model-renders beta_model" in ours) == (name == "dbs")
    rules = shape.rules()
    assert rules["strategy"] is rules["sh_degree"] is None and rules["recipe"] == {} and not shape.of_gaussians
    assert ("densify_grad_threshold" in rules) == (name == "dbs")


def test_views_are_held_out_and_rendered_by_the_model_itself(tmp_path, monkeypatch):
    view = SimpleNamespace(image_name="a", original_image=torch.full((4, 2, 3), 0.5))

    class Scene:
        def __init__(self, args):
            self.getTestCameras = lambda: [view] if was_held_out else []
            was_held_out = args.eval
            self.model = SimpleNamespace(get_xyz=torch.zeros(5, 3), render=lambda view: {"render": torch.ones(3, 2, 3)})

    monkeypatch.setitem(sys.modules, "scene", SimpleNamespace(Scene=Scene))
    made, args = observer.watch_scenes(hold_out=True), SimpleNamespace(eval=False)
    sys.modules["scene"].Scene(args)
    found = observer.renderings_of(made[-1], "model", str(tmp_path))
    assert not args.eval and found["num_gaussians"] == 5 and found["a"]["milliseconds"] > 0
    assert np.load(found["a"]["file"]).shape == np.load(found["a"]["truth"]).shape == (3, 2, 3)


def test_a_trainers_own_lpips_needs_no_weights(monkeypatch):
    """As HAC and HAC++ call it. If there is no network, the download of weights is an error."""
    for name in ("lpips", "lpipsPyTorch"):
        monkeypatch.setitem(sys.modules, name, None)
    observer.without_lpips()
    import lpips
    from lpipsPyTorch import lpips as function
    image = torch.zeros(3, 2, 2)
    assert lpips.LPIPS(net="vgg").to("cpu")(image, image, normalize=False).isnan()
    assert function(image, image, net_type="vgg").isnan() and "lpips" in shapes.HAC.stubs


def test_what_comes_before_a_rendering_is_a_part_of_its_time(tmp_path, monkeypatch):
    """HAC asks beforehand which anchors are visible. What is rendered for gradients is not kept."""
    slow, view = [], SimpleNamespace(image_name="a", original_image=torch.zeros(3, 2, 3))
    renderer = SimpleNamespace(render=lambda view, model: {"render": torch.ones(3, 2, 3)},
                               prefilter_voxel=lambda view, model: slow.append(time.sleep(0.05)))
    monkeypatch.setitem(sys.modules, "gaussian_renderer", renderer)
    found, model = observer.watch_renderings(str(tmp_path)), SimpleNamespace(get_anchor=torch.zeros(7, 3))
    renderer.render(view, model)
    assert found == {}
    with torch.no_grad():
        renderer.prefilter_voxel(view, model)
        renderer.render(view, model)
    assert found["num_gaussians"] == 7 and found["a"]["milliseconds"] >= 50 and len(slow) == 2  # one warms up


def test_seeds_are_shifted_by_the_cells(monkeypatch):
    for module, name in ((random, "seed"), (np.random, "seed"), (torch, "manual_seed")):
        monkeypatch.setattr(module, name, getattr(module, name))  # is put back
    observer.shift_seeds(5)
    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(0)
    assert (random.random(), np.random.rand(), torch.rand(1).item()) == (
        random.Random(5).random(), np.random.RandomState(5).rand(),
        torch.rand(1, generator=torch.Generator().manual_seed(5)).item())


@pytest.mark.parametrize("names, wrong", [(["a/view0.JPG", "view8"], None), (["view0"], "view8"),
                                          (["view0", "view9"], "view8, view9"), (["view0", "view8", "view1"], "view1")])
def test_a_checkout_must_have_the_same_split(names, wrong):
    """Without folder and extension, which trainers keep or drop."""
    test = [SimpleNamespace(camera=SimpleNamespace(name=name)) for name in ("view0.png", "view8.png")]
    seen = [{"name": name} for name in names]
    refused = pytest.raises(BenchError, match=f"taming rendered {len(names)} test views, .*{wrong}.*another split")
    with refused if wrong else nullcontext():
        assert shapes.matched(SimpleNamespace(test=test), seen, "taming") == list(zip(test, seen))


@pytest.mark.parametrize("name, axes, there, absent, recipe", [
    ("3dgs-2023", {"strategies": ["steady"]}, ["--opacity_reset_interval", str(ITERATIONS + 1)], [], {}),
    ("3dgs-2023", {}, ["--blend_mode", "smoe", "--background_gate", "0.0"], [], {}),
    ("3dgs-2023", {"background_gates": [0.3]}, ["--blend_mode", "smoe", "--background_gate", "0.3"], [], {}),
    ("compact-3dgs", {}, ["--comp", "--store_npz"], [], {}),
    ("3dgs-2023", {"blend_mode": "paper"}, ["--blend_mode", "smoe", "--background_gate", "0.0"], [], {}),
    ("3dgs-2023", {"blend_mode": "alpha"}, ["--blend_mode", "alpha"], ["--background_gate"], {}),
    ("3dgs-2023", {}, [], ["--opacity_reset_interval", "--opacity_lr"], {}),
    # 0.05, which is our default, is not that of 3DGS of 2024.
    ("3dgs-2024", {"options": {"opacity_lr": 0.05, "antialiasing": True}}, ["--opacity_lr", "0.05"], ["True"],
     {"opacity_lr": 0.05, "antialiasing": True}),
    ("3dgs-2024", {"options": {"antialiasing": False, "sh_degree_interval": 1000}}, [],
     ["--antialiasing", "--sh_degree_interval"], {"antialiasing": False, "sh_degree_interval": 1000})])
def test_the_protocol_reaches_a_checkout(name, axes, there, absent, recipe, small):
    """Steady means neither reset nor size prune. What the suite does not say of the recipe is the trainer's own."""
    cell = small(name, **axes)
    shape = shapes.SHAPES[name](cell, shapes.config_of(cell), "out")
    words = shape.train_arguments()
    assert " ".join(there) in " ".join(words) and not {*absent} & {*words}
    assert ("--antialiasing" in words) == recipe.get("antialiasing", False)
    assert shape.environment().get("DSMOE_FAINT_BELOW") == ("2.0" if axes.get("blend_mode") == "paper" else None)
    assert shape.rules()["recipe"] == recipe and shape.rules()["scale_recipe"] is False


@pytest.mark.parametrize("shape, value, said", [
    ((3, 16, 20), 0.01, "ground truth differs .* by 2.55 grey levels"), ((3, 16, 16), 0, "another resolution")])
def test_a_checkout_that_was_trained_on_other_images_is_refused(shape, value, said, tmp_path):
    np.save(tmp_path / "image.npy", np.full(shape, value, np.float32))
    view = SimpleNamespace(camera=SimpleNamespace(name="view0"), image_float=lambda: torch.zeros(3, 16, 20))
    seen = {"name": "view0", "milliseconds": 1.0, **dict.fromkeys(("file", "truth"), tmp_path / "image.npy")}
    with pytest.raises(BenchError, match=said):
        shapes.measured([(view, seen)], shapes.Measures("cpu"), "cpu")


def test_a_trainer_that_fails_is_a_row_with_its_last_words(small, tmp_path):
    python = python_that("echo told >&2\necho 'train.py: error: no such flag' >&2\nexit 2\n", tmp_path)
    row = row_of(small("3dgs-2023", python=python), tmp_path)
    assert not row["ok"]
    assert "train.py of 3dgs-2023 ended with status 2: train.py: error: no such flag (" in row["reason"]


@pytest.mark.slow
def test_a_trainer_ends_with_its_cell(small, tmp_path):
    cell, pid = tmp_path / "cell.json", tmp_path / "pid"
    python = python_that(f"echo $$ >{pid}.part\nmv {pid}.part {pid}\nexec sleep 600\n", tmp_path)
    cell.write_text(json.dumps(small("3dgs-2023", python=python)))
    run = subprocess.Popen([sys.executable, "-m", "dsmoe.bench.cell", str(cell),
                            str(tmp_path / "out")], cwd=str(tmp_path))
    wait_for(pid.is_file, 60)
    run.terminate()
    assert run.wait() == -15
    wait_for(lambda: not Path("/proc", pid.read_text()).exists(), 60)


@pytest.mark.slow
def test_a_fused_checkout_is_a_copy_of_its_own(small, tmp_path):
    cell = small("3dgs-2023", variant="fused")
    assert cell["method"]["label"] == "3dgs-2023-fused" and "refused" not in cell["method"]
    fused, patched = (small("3dgs-2023", variant=variant)["method"]["path"] for variant in ("fused", "patched"))
    assert ["fuse.start()" in Path(path, "train.py").read_text() for path in (fused, patched)] == [True, False]
    row = row_of(cell, tmp_path)
    assert row["ok"] and row["variant"] == "fused"
    assert row["protocol"]["arguments"][-4:] == ["--blend_mode", "smoe", "--background_gate", "0.0"]
    # A checkout that was fused already is used as it is, and is not the patched one.
    for path, variant, expected in ((fused, "fused", fused), (fused, "patched", None),
                                    (patched, "fused", str(tmp_path / "checkouts" / "fused-path"))):
        method = dict(cell["method"], label="fused", path=path, variant=variant)
        method = preparation.prepared_method(method, str(tmp_path))
        assert method["path"] == (expected or path)
        assert ("`variant: fused`" in method.get("refused", "")) == (expected is None)


def test_what_a_trainer_writes_beside_its_scene_stays_its_own(tmp_path):
    source, linked = tmp_path / "scene", tmp_path / "linked"
    read = ("images/0.png", "sparse/0/points3D.bin")
    for file in (*read, "transforms_train.json", "sparse/0/points3D.ply", "points3d.ply"):
        (source / file).parent.mkdir(parents=True, exist_ok=True)
        (source / file).write_text(file)
    (source / "sparse/0/points3D.ply").chmod(0o444)
    before = contents(source)
    shapes.linked_scene(str(source), str(linked))
    for file in ("sparse/0/points3D.ply", "points3d.ply", "input.ply"):
        (linked / file).write_text("made")
    assert [(linked / file).read_text() for file in read] == list(read)
    shutil.rmtree(linked)
    assert contents(source) == before


def test_modules_that_are_imported_and_not_used_may_be_absent():
    """2DGS imports what extracts meshes."""
    observer.stub("a_module_that_nobody_has")
    assert importlib.import_module("a_module_that_nobody_has.other")
    with pytest.raises(TypeError):
        importlib.import_module("a_module_that_nobody_has").part()
    observer.stub("json")
    assert importlib.import_module("json") is json
