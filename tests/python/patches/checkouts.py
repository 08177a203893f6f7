"""Checkouts of trainers: copies of a small one that trains, a 3DGS of 2023, and one of a few lines.

What a patch makes of the latter, and what tests ask about a folder.
"""
from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
from pathlib import Path

import pytest

import diff_smoe_rasterization
from dsmoe import patches

HERE = Path(__file__).resolve().parent
PACKAGE_PARENT = Path(diff_smoe_rasterization.__file__).resolve().parent.parent  # its installation, or the tree
PACKAGES = HERE / "packages"  # what trainers import beside the rasterizer


def make_checkout(folder):
    """Copies the small trainer to `folder`; returns it."""
    return shutil.copytree(HERE / "trainer", folder, ignore=shutil.ignore_patterns("__pycache__"))


def make_scene(folder, seed=1):
    Path(folder).mkdir(parents=True)
    (Path(folder) / "made_up.json").write_text(json.dumps({"points": 150, "views": 4, "seed": seed}))
    return Path(folder)


def contents(folder):
    """{path: (mode, bytes or what a link points to)} of all below."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        data = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
        found[path.relative_to(folder).as_posix()] = stat.S_IMODE(path.lstat().st_mode), data
    return found


def environment(**more):
    """Environment of a trainer's process: this package, the trainer's other imports, one thread."""
    kept = {name: value for name, value in os.environ.items()
            if name not in ("PYTHONDONTWRITEBYTECODE", "DSMOE_BLEND_MODE", "DSMOE_BACKGROUND_GATE")}
    return {**kept, "PYTHONPATH": os.pathsep.join([str(PACKAGES), str(PACKAGE_PARENT)]), "OMP_NUM_THREADS": "1", **more}


GR, ARGS = "gaussian_renderer/__init__.py", "arguments/__init__.py"
RENDERER = '''import math  # the camera's angles
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer


def render(camera, pc, pipe, bg_color, scaling_modifier=1.0):
    """Renders."""
    settings = GaussianRasterizationSettings(
        image_height=camera.height, bg=bg_color,  # both of the view
        prefiltered=False,  # never
        debug=pipe.debug  # slow
    )
    return GaussianRasterizer(raster_settings=settings)(means3D=pc.get_xyz)
'''
ARGUMENTS = '''class ModelParams(ParamGroup):
    def __init__(self, parser, sentinel=False):
        self.sh_degree = 3
        # everything above becomes an option
        super().__init__(parser, "Loading Parameters", sentinel)


class PipelineParams(ParamGroup):
    def __init__(self, parser):
        self.debug = False
        super().__init__(parser, "Pipeline Parameters")
'''
TRAIN = '''import torch
from gaussian_renderer import render


def training(dataset, opt, pipe, checkpoint):
    # the first iteration is 1
    first_iter = 0
    if checkpoint:
        first_iter = torch.load(checkpoint)
    return render(None, None, pipe, None), first_iter
'''
RENDER = '''from gaussian_renderer import render


def render_sets(dataset : object, iteration : int, pipeline : object):
    "Renders both sets."
    return render(None, None, pipeline, None)'''
CHECKOUT = {GR: RENDERER, ARGS: ARGUMENTS, "train.py": TRAIN, "render.py": RENDER}


def digest(text):
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def marked(text):
    """A line of the patch: a mark, and eight digits by which an edit is noticed."""
    return f"{text}  # dsmoe patch {digest(text)}\n"


def imported(name):
    """The line by which a patched file gets a name."""
    return marked(f"from dsmoe.patches.runtime import {name}")


INRIA = "diff_smoe_rasterization.integrations.inria"
PATCHED = {
    GR: imported("chosen_blend") + RENDERER.replace(
        "from diff_gaussian_rasterization",
        f"# dsmoe patch 3dgs-2023: diff_gaussian_rasterization {digest(INRIA)}\nfrom {INRIA}").replace(
        "        image_height", f"        {marked('**chosen_blend(pipe),')}        image_height"),
    ARGS: imported("default_blend") + ARGUMENTS.replace(
        '        super().__init__(parser, "Loading',
        f"        {marked('self.blend_mode, self.background_gate = default_blend()')}"
        '        super().__init__(parser, "Loading'),
    "train.py": imported("blend_of") + TRAIN.replace(
        "    first_iter = 0\n", f"    {marked('pipe.blend = blend_of(dataset)')}    first_iter = 0\n"),
    "render.py": imported("saved_blend_of") + RENDER.replace(
        "    return", f"    {marked('pipeline.blend = saved_blend_of(dataset)')}    return")}


def make(folder, changes=None):
    """Writes the checkout; changes: other texts, or bytes, by name; None leaves a file out."""
    for name, text in {**CHECKOUT, **(changes or {})}.items():
        if text is not None:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def refused(path, *words, call=patches.apply, **options):
    """Asserts that a call is refused with these words, and that no byte has changed."""
    before = contents(path)
    with pytest.raises(patches.PatchError) as caught:
        call(path, **options)
    assert contents(path) == before
    for word in words:
        assert word in str(caught.value), str(caught.value)
