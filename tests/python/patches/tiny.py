"""A checkout of a few lines, what a patch makes of it, and what tests ask about it."""
from __future__ import annotations

import pytest
from checkouts import contents

from diff_smoe_rasterization import patches

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
BLEND_OF = "import render\nfrom diff_smoe_rasterization.patches.runtime import blend_of\n"
SAVED_BLEND_OF = BLEND_OF.replace("import blend_of", "import saved_blend_of")
PATCHED = {
    GR: RENDERER.replace("diff_gaussian_rasterization import", "diff_smoe_rasterization.integrations.inria import")
    .replace("RasterizationSettings(\n", "RasterizationSettings(\n        **pipe.blend,\n"),
    ARGS: "from diff_smoe_rasterization.patches.runtime import default_blend\n\n" + ARGUMENTS.replace(
        "sh_degree = 3\n", "sh_degree = 3\n        self.blend_mode, self.background_gate = default_blend()\n"),
    "train.py": TRAIN.replace("import render\n", BLEND_OF).replace(
        "checkpoint):\n", "checkpoint):\n    pipe.blend = blend_of(dataset)\n"),
    "render.py": RENDER.replace("import render\n", SAVED_BLEND_OF).replace(
        'sets."\n', 'sets."\n    pipeline.blend = saved_blend_of(dataset)\n')}


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
