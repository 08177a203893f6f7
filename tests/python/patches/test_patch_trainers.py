"""The patch on trainers of each structure: recognised as what they are, and nothing but the statements changes."""
from __future__ import annotations

import ast
import os
import re
import shutil
from pathlib import Path

import pytest
from checkouts import ARGS, GR, PACKAGE_PARENT, RENDERER, TRAIN, contents, make, refused

from dsmoe import patches
from dsmoe.patches import facts


def only_statements_change(diff):
    """Asserts that a diff takes imports of the rasterizer away and adds lines of a patch."""
    lines = [line for line in diff.splitlines() if line[0] in "+-" and line[:3] not in ("+++", "---")]
    removed, added = ([line[1:].strip() for line in lines if line[0] == sign] for sign in "-+")
    assert removed and all(line.startswith("from diff_gaussian_rasterization import") for line in removed), removed
    ours = "from diff_smoe_rasterization.integrations.", "from dsmoe.patches.sparse_adam "
    assert all("# dsmoe patch" in line or line.startswith(ours) for line in added), added


@pytest.mark.parametrize("name", patches.TRAINERS)
def test_in_public_checkouts_only_the_statements_change(name):
    """Densification, optimizers, losses: no line of them is touched."""
    folder = Path(os.environ.get("DSMOE_TRAINERS", "."), name)
    if "DSMOE_TRAINERS" not in os.environ or not folder.is_dir():
        pytest.skip(f"DSMOE_TRAINERS names no folder with a public checkout {name}")
    before = contents(folder)
    only_statements_change(patches.diff(folder, fuse=True))
    assert (folder / "utils/loss_utils.py").is_file()  # whose ssim --fuse looks at
    assert contents(folder) == before


def test_recognised_by_structure_alone():
    base = {"imports GaussianRasterizationSettings", "sets bg", "sets debug"}
    for name, signs in (("taming", {"sets pixel_weights", "imports SparseGaussianAdam"}),
                        ("hac-plus", {"calls visible_filter", "imports encodings", "imports gpcc_utils"}),
                        ("hac", {"calls visible_filter", "imports encodings", "imports lpips"})):  # of lpipsPyTorch
        assert facts.recognise(base | signs)[0].name == name
    assert facts.recognise({"sets bg"})[0] is None


ONE_LINE = "    return GaussianRasterizer(raster_settings=settings)(means3D=pc.get_xyz)\n"
BY_NAME = "    draw = GaussianRasterizer(raster_settings=settings)\n    {} = draw(means3D=pc.get_xyz)\n"
DEPTH_LOSS = TRAIN + ("\n\ndef depth_loss(view, depth):\n    return abs(depth - view.invdepthmap).mean()\n\n\n"
                      "used = depth_loss\n")
SPARSE_ADAM = "from diff_gaussian_rasterization import SparseGaussianAdam\n"
ANTIALIASED = RENDERER.replace("prefiltered=False,", "antialiasing=pipe.antialiasing, prefiltered=False,")


@pytest.mark.parametrize("renderer, results, train, trainer", [
    (RENDERER, "color, radii", TRAIN, "3dgs-2023"), (RENDERER, "color, *rest", TRAIN, None),
    (RENDERER, "everything", TRAIN, None),
    (RENDERER, "color, radii, depth", DEPTH_LOSS, "3dgs-2024"),  # of August
    (ANTIALIASED, "color, radii, depth", TRAIN, "3dgs-2024"),  # of September
    (RENDERER, "color, radii, depth", TRAIN, "3dgs-depth"),  # of 4DGaussians and others
    (RENDERER, "color, _, _", TRAIN, "3dgs-depth"), (RENDERER, "color, radii, depth, alpha", TRAIN, "3dgs-depth-alpha"),
    (RENDERER, "color, radii, inv_depth", TRAIN, None), (RENDERER, "color, radii, weights", TRAIN, None),
    (RENDERER, "color, radii, count, score", TRAIN, None), (RENDERER, "color,", TRAIN, None),
    (RENDERER.replace("bg=bg_color", "kernel_size=0.1"), "color, radii", TRAIN, None),
    (RENDERER.replace("bg=bg_color", "blur=0.1"), "color, radii", TRAIN, None)])
def test_versions_and_forks_are_what_they_are_or_unknown(tmp_path, renderer, results, train, trainer):
    count = len(getattr(ast.parse(results).body[0].value, "elts", "12"))
    renderer = renderer.replace(ONE_LINE, BY_NAME.format(results))
    make(tmp_path, {GR: renderer, "train.py": train, "scene/gaussian_model.py": ""})
    if trainer:
        assert patches.apply(tmp_path).trainer == trainer and patches.check(tmp_path).state == "patched"
        return
    run = "for which there is no patch: type `dsmoe run --blend-mode smoe -- python train.py ...`"
    said = {"kernel_size": f"its rasterizer is mip_splatting, {run}",
            "inv_depth": f"its rasterizer is color,radii,inverse_depth, {run}",
            "everything": "what a call returns is not seen", "*rest": "what a call returns is not seen",
            "blur": "its GaussianRasterizationSettings have blur, which no rasterizer has that is known here"}
    runs = "kernel_size" in renderer or "inv_depth" in renderer
    refused(tmp_path, "supported" if runs else "unknown", next((said[name] for name in said if name in renderer),
                                      f"its rasterizer returns {count} "), "type `dsmoe run --blend-mode smoe ")


VISIBLE = """

def prefilter_voxel(camera, pc, pipe):
    settings = GaussianRasterizationSettings(
        bg=None, debug=pipe.debug)
    return GaussianRasterizer(raster_settings=settings).visible_filter(pc.get_xyz)


used = prefilter_voxel
"""
RENDERING = "\n\ndef render_sets(dataset, iteration, pipeline):\n    return render(None, None, pipeline, None)\n"
COMPRESS = TRAIN.replace("training(dataset, opt, pipe,", "run_vq(model_params, opt, pipeline_params,").replace(
    "None, pipe,", "None, pipeline_params,")


@pytest.mark.parametrize("name, files, entries", [
    ("scaffold-gs", {GR: RENDERER + VISIBLE, "train.py": TRAIN + RENDERING}, {"train.py": 2, "render.py": 1}),
    ("hac", {GR: RENDERER + VISIBLE, "train.py": "import utils.encodings\n" + TRAIN + RENDERING, "render.py": None,
             "utils/encodings.py": ""},
     {"train.py": 2}),
    ("c3dgs", {GR: RENDERER.replace("prefiltered=False,", "clamp_color=True,"), "train.py": None,
               "compress.py": COMPRESS}, {"compress.py": 1, "render.py": 1})])
def test_trainers_of_other_files_get_the_mode_in_each_function(name, files, entries, tmp_path):
    """Two renderers' settings, one file that trains and renders, and one whose parameters have other names."""
    make(tmp_path, files)
    before = contents(tmp_path)
    only_statements_change(patches.diff(tmp_path))
    planned = patches.apply(tmp_path)
    assert planned.trainer == name and not planned.notes
    assert (tmp_path / GR).read_text().count("**chosen_blend(pipe),") == files[GR].count("Settings(")
    for file, count in entries.items():
        text = (tmp_path / file).read_text()
        compile(text, file, "exec")
        assert len(re.findall(r"\.blend = (saved_)?blend_of\(", text)) == count
    patches.revert(tmp_path)
    assert contents(tmp_path) == before


AUTHORS = {
    GR: RENDERER.replace(ONE_LINE, BY_NAME.format("color, radii") + "    return color\n"),
    "scene/__init__.py": "class Scene:\n    def __init__(self, args, gaussians):\n        gaussians.load_init()\n",
    "train.py": "import types\nfrom scene import Scene\n" + TRAIN.replace("import torch\n", "") + (
        "def render(camera, pc, pipe, bg):\n    return pipe.blend\n"
        "dataset = types.SimpleNamespace(blend_mode='smoe', background_gate='')\n"
        "print(training(dataset, 0, types.SimpleNamespace(), 0))\n"),
    "render.py": f"try:\n    {SPARSE_ADAM}    AVAILABLE = True\nexcept:\n    AVAILABLE = False\n" + (
        "from gaussian_renderer import render\nfrom scene import Scene\n\n\n"
        "def images_to_video(folder, path, fps=30):\n    pass\n\n\n"
        "def render_sets(dataset, iteration, pipeline, skip_train, skip_test, separate_sh):\n"
        "    images_to_video('', '')\n    return render(None, None, pipeline, None)\n\n\nused = render_sets\n"),
    "generate_pose.py": f"try:\n    {SPARSE_ADAM}except:\n    pass\nfrom gaussian_renderer import render\n"}


def test_the_checkout_of_the_papers_authors_blends_by_smoe_with_tails_in_every_pixel(tmp_path, python):
    """As its own rasterizer does, which has no other mode; without the signs it is 3DGS of 2023, and alpha."""
    make(tmp_path, {**AUTHORS, "render.py": AUTHORS["render.py"].replace("    images_to_video", "    print")})
    assert patches.check(tmp_path).trainer == "3dgs-2023"
    make(tmp_path, AUTHORS)
    before = contents(tmp_path)
    only_statements_change(patches.diff(tmp_path))
    planned = patches.apply(tmp_path)
    assert planned.trainer == "3d-smoe" and not planned.notes
    for file, words in ((ARGS, "= default_smoe()"), ("train.py", "pipe.blend = smoe_of(dataset)"),
                        ("render.py", "pipeline.blend = saved_smoe_of(dataset)")):
        assert words in (tmp_path / file).read_text()
    result = python("train.py", cwd=tmp_path, PYTHONPATH=str(PACKAGE_PARENT))
    assert "{'blend_mode': 'smoe', 'background_gate': 0.0, 'faint_below': 2.0}" in result.out, result.err
    rendered = python("-c", "import render; print(render.AVAILABLE)", cwd=tmp_path, PYTHONPATH=str(PACKAGE_PARENT))
    assert rendered.out == "False\n", rendered.err
    patches.revert(tmp_path)
    for folder in tmp_path.rglob("__pycache__"):
        shutil.rmtree(folder)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("more, is_offered", [({}, False), ({"scene/gaussian_model.py": SPARSE_ADAM}, True)])
def test_a_patched_trainer_finds_sparse_adam_where_it_asks_or_was_written_for_it(more, is_offered, tmp_path, python):
    train = TRAIN + f"try:\n    {SPARSE_ADAM}    print(True)\nexcept ImportError:\n    print(False)\n"
    make(tmp_path, {GR: ANTIALIASED, "train.py": train.replace("from gaussian_renderer", "# "), **more})
    before = contents(tmp_path)
    only_statements_change(patches.diff(tmp_path))
    assert not patches.apply(tmp_path).notes
    for words, offered in (([], is_offered), (["--optimizer_type=sparse_adam"], True)):
        result = python("train.py", *words, cwd=tmp_path, PYTHONPATH=str(PACKAGE_PARENT))
        assert result.out == f"{offered}\n", result.err
    patches.revert(tmp_path)
    shutil.rmtree(tmp_path / "__pycache__", ignore_errors=True)
    assert contents(tmp_path) == before


def test_dashgaussian_trains_by_a_script_of_its_own(tmp_path):
    """Which has the rest of 3DGS of 2024, and imports its scheduler."""
    dash = "from utils.schedule_utils import TrainingScheduler\n" + TRAIN
    make(tmp_path, {GR: ANTIALIASED, "train_dash.py": dash, "utils/schedule_utils.py": ""})
    before = contents(tmp_path)
    assert patches.apply(tmp_path).trainer == "dashgaussian"
    for script in ("train.py", "train_dash.py"):
        assert "pipe.blend = blend_of(dataset)" in (tmp_path / script).read_text()
    patches.revert(tmp_path)
    assert contents(tmp_path) == before


def test_a_trainer_that_it_does_not_look_like_is_warned_of(tmp_path):
    make(tmp_path, {GR: ANTIALIASED})
    (note,) = patches.apply(tmp_path, trainer="3dgs-2023").notes
    assert "--trainer 3dgs-2023" in note and "3dgs-2024" in note and "another API" in note
    assert not patches.check(tmp_path).notes  # it was said when it was chosen


def test_a_fork_that_no_contract_fits_is_patched_with_a_warning_and_one_of_another_rasterizer_is_not(tmp_path):
    call = BY_NAME.format("color, radii").replace("get_xyz)", "get_xyz, degrees=pc.degrees)")  # reduced-3dgs
    make(tmp_path / "fork", {GR: RENDERER.replace(ONE_LINE, call)})
    refused(tmp_path / "fork", "unknown", "its rasterizer is called with degrees, which no rasterizer has",
            "`dsmoe run --blend-mode smoe --trainer NAME -- python train.py ...`")
    (note,) = patches.apply(tmp_path / "fork", trainer="3dgs-2023").notes
    assert "--trainer 3dgs-2023: its rasterizer is called with degrees" in note
    private = RENDERER.replace("import math", "from diff_gaussian_rasterization._C import kmeans_cuda\nimport math")
    refused(make(tmp_path / "private", {GR: private}), "it imports diff_gaussian_rasterization._C.kmeans_cuda, which")
    both = RENDERER + ("\n\ndef render_imp():\n    from diff_gaussian_rasterization_gof import GaussianRasterizer\n"
                       "used = render_imp\n")
    beside = {"gaussian_renderer/b.py": both, "train.py": "from gaussian_renderer import b\n" + TRAIN}
    refused(make(tmp_path / "beside", beside), "it imports diff_gaussian_rasterization_gof too, another rasterizer",
            "type `dsmoe run --blend-mode smoe -- python train.py ...`")
    for trainer in (None, "3dgs-2023"):  # one beside Inria's, as in gaussian-opacity-fields
        refused(make(tmp_path / "both", {GR: both}), "it imports diff_gaussian_rasterization_gof too, another",
                trainer=trainer)


def test_a_training_script_of_another_name_is_found_by_its_function(tmp_path):
    """Each script that has the function gets the mode; without one that renders, a note says what is missing."""
    more = {"train_masks.py": TRAIN, "train_other.py": TRAIN.replace("def training(dataset", "def training(scene")}
    make(tmp_path / "beside", more)
    assert set(patches.apply(tmp_path / "beside").rules) == {GR, ARGS, "train.py", "train_masks.py", "render.py"}
    make(tmp_path / "alone", {**more, "train.py": None, "render.py": None})
    planned = patches.apply(tmp_path / "alone")
    assert set(planned.rules) == {GR, ARGS, "train_masks.py"}
    assert ["render.py: there is none, nor a function render_sets" in note for note in planned.notes] == [True]
    assert "pipe.blend = blend_of(dataset)" in (tmp_path / "alone/train_masks.py").read_text()
    patches.revert(tmp_path / "alone")


@pytest.mark.parametrize("renderer", [None, "", "from .other import render\n"])
def test_a_renderer_in_another_file_is_named(renderer, tmp_path):
    """Not that nothing imports a rasterizer."""
    make(tmp_path, {GR: renderer, "draw/other.py": RENDERER, "train_1.py": TRAIN + "if __name__ == '__main__': 0\n",
                    "train.py": TRAIN.replace("gaussian_renderer", "draw.other")})
    refused(tmp_path, "the rasterizer, but draw/other.py, and a patch is only of gaussian_renderer/__init__.py: type "
                      "`dsmoe run --blend-mode smoe -- python train_1.py ...`")
