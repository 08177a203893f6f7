"""Tile lists by macro tiles: where they need more than one pass, and where they do not fit."""
from __future__ import annotations

import pytest
import torch
from against_cpu import FLOAT32, compare
from scenes import op_results, random_scene

MACRO_TILE = 64  # pixels
ONE_PASS = 512  # macro tiles that one pass of the sort tells apart


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_more_macro_tiles_than_one_pass_sorts(mode, gpu):
    width, height = 2305, 1217
    assert (width // MACRO_TILE) * (height // MACRO_TILE) > ONE_PASS
    scene = random_scene(mode, 400, width, height, scale=0.03, degree=0, dtype=torch.float32)
    compare(scene, gpu, torch.float32, (), FLOAT32, camera=False)


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
def test_needles_that_pass_by_more_macro_tiles_than_they_meet_tiles(mode, gpu):
    """Their boxes outgrow the room that the count of their tiles suggests. So the entries of the macro tiles' lists are
    counted too, and the lists of the first rendering fit their memory.
    """
    scene = random_scene(mode, 300, 2391, 2377, scale=0.01, degree=0, dtype=torch.float32)
    needle = torch.tensor([6.0, 0.001, 0.001])
    scene = scene.with_inputs(scales=needle.expand_as(scene.inputs["scales"]).contiguous()).to(gpu)
    for _ in range(2):
        outputs, saved = op_results(scene)
        torch.cuda.synchronize()  # the count is there for the next call
        assert len(saved["instances"]) >= int(saved["tile_offsets"][-1])
        assert outputs["color"].std() > 0.01, "nothing is seen"


@pytest.mark.parametrize("mode", ["alpha", "smoe"])
@pytest.mark.parametrize("fits", [True, False])
def test_tiles_come_in_the_order_of_their_lists_lengths(mode, fits, gpu):
    """Each tile once, the longest lists first by classes of 64 instances; also where the lists do not fit."""
    # Another size for each case: what an earlier rendering of the size needed decides whether the lists fit.
    scene = random_scene(mode, 12_000, 333 + 16 * fits, 217, scale=0.1, degree=0, dtype=torch.float32).to(gpu)
    if not fits:  # the next rendering has room for as many as small Gaussians have, in steps of 65,536
        op_results(scene.with_inputs(scales=scene.inputs["scales"] * 0.01))
        torch.cuda.synchronize()
    _, saved = op_results(scene)
    offsets, order = saved["tile_offsets"][:-2], saved["tile_order"].long()
    assert (len(saved["instances"]) >= int(saved["tile_offsets"][-1])) is fits
    assert torch.equal(order.sort().values, torch.arange(len(order), device=gpu))
    if fits:
        classes = (offsets[1:] - offsets[:-1])[order] // 64
        assert len(classes.unique()) > 3, "few classes"
        assert (classes[1:] <= classes[:-1]).all()
