"""Versions and relatives of the trainers: recognised and patched as what they are, or not at all."""
from __future__ import annotations

import ast

import pytest

from diff_smoe_rasterization import patches
from diff_smoe_rasterization.patches import PatchError, run
from test_patch_engine import GR, RENDER, RENDERER, TRAIN, make, refused
from test_engine_run import environment

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

ONE_LINE = "    return GaussianRasterizer(raster_settings=settings)(means3D=pc.get_xyz)\n"
BY_NAME = "    draw = GaussianRasterizer(raster_settings=settings)\n    {} = draw(means3D=pc.get_xyz)\n"
DEPTH_LOSS = TRAIN + """

def depth_loss(view, inverse_depth):
    return abs(inverse_depth - view.invdepthmap).mean()
"""
VISIBLE = '''

def prefilter_voxel(camera, pc, pipe):
    settings = GaussianRasterizationSettings(bg=None, debug=pipe.debug)
    return GaussianRasterizer(raster_settings=settings).visible_filter(pc.get_xyz)
'''
RENDER_IN_TRAIN = "\n\ndef render_sets(dataset, iteration, pipeline):\n    return render(None, None, pipeline, None)\n"


def returning(results, antialiasing=False):
    """A renderer that unpacks these results."""
    text = RENDERER.replace("prefiltered=False,", "antialiasing=pipe.antialiasing, prefiltered=False,")
    return (text if antialiasing else RENDERER).replace(ONE_LINE, BY_NAME.format(results))


@pytest.mark.parametrize("results", ["color, radii, depth", "color, depth, radii, alpha", "color,"])
def test_a_fork_with_other_results_is_not_3dgs(tmp_path, results):
    count = len(ast.parse(results).body[0].value.elts)
    checkout = make(tmp_path, {GR: returning(results)})
    verdict = patches.check(checkout)
    assert verdict == "unknown" and f"its rasterizer returns {count} results" in verdict.reasons[0]
    refused(checkout, "3dgs-2023", "returns 2")
    with pytest.raises(PatchError, match=f"returns {count} results"):
        run.prepare(["python", str(checkout / "train.py")], "smoe", None, environment())


@pytest.mark.parametrize("results", ["color, radii", "color, *rest", "everything"])
def test_what_unpacks_two_results_or_does_not_say_is_3dgs(tmp_path, results):
    verdict = patches.check(make(tmp_path, {GR: returning(results)}))
    assert verdict == "patchable" and verdict.trainer == "3dgs-2023"


@pytest.mark.parametrize("antialiasing, train", [(False, DEPTH_LOSS), (True, TRAIN), (True, DEPTH_LOSS)])
def test_3dgs_of_2024_before_its_optimizer_came(tmp_path, antialiasing, train):
    """Of August, then of September: inverse depth, then antialiasing, and no import outside the renderer."""
    checkout = make(tmp_path, {GR: returning("color, radii, depth", antialiasing), "train.py": train,
                               "scene/gaussian_model.py": "class GaussianModel:\n    pass\n"})
    planned = patches.apply(checkout)
    assert planned.verdict == "patchable" and planned.verdict.trainer == "3dgs-2024"
    assert {change.name for change in planned.changes} == {GR, "arguments/__init__.py", "train.py", "render.py"}
    assert "integrations.inria_2024 import" in (checkout / GR).read_text()
    assert patches.check(checkout) == "patched"


def test_scaffold_gs_renders_in_two_files(tmp_path):
    """HAC's rasterizer without HAC's encodings, and with a render.py."""
    files = {GR: returning("color, radii") + VISIBLE, "train.py": TRAIN + RENDER_IN_TRAIN, "render.py": RENDER}
    checkout = make(tmp_path, files)
    planned = patches.apply(checkout)
    assert planned.verdict.trainer == "scaffold-gs" and planned.notes == ()
    assert (checkout / GR).read_text().count("**pipe.blend,") == 2
    for name, count in (("train.py", 2), ("render.py", 1)):
        assert (checkout / name).read_text().count(".blend = blend_of(dataset)") == count
