"""Tile lists by macro tiles: several passes, lists that do not fit, and the room that a rendering makes for them."""
from __future__ import annotations

import pytest
import torch
from against_cpu import FLOAT32, compare
from scenes import op_results, random_scene

from diff_smoe_rasterization.integrations.scaffold import GaussianRasterizer

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
    """Each tile once, the longest lists first by classes of 64 instances; also if the lists do not fit."""
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


# More than the window of recent_greatest.h, twice: then a count is forgotten.
FORGOTTEN = 2 * 1024 + 1


def room_for(scene):
    """Renders. Returns for how many tile instances there was room, and how many there are."""
    saved = op_results(scene)[1]
    torch.cuda.synchronize()  # the count is there for the next call
    return len(saved["instances"]), int(saved["tile_offsets"][-1])


def test_room_for_one_large_view_is_given_up_again(gpu):
    """The key sort takes as long as there is room: one view must not slow down all those behind it."""
    small = random_scene("smoe", 20_000, 331, 151, scale=0.004, dtype=torch.float32, degree=0).to(gpu)
    large = small.with_inputs(scales=small.inputs["scales"] * 60)
    room_for(small)
    count = room_for(large)[1]
    assert room_for(small)[0] >= count > 10 * room_for(small)[1], "the large view is not an outlier"
    for _ in range(FORGOTTEN):
        op_results(small)
    room, count_of_small = room_for(small)
    assert count_of_small <= room < count


def test_the_filter_of_anchors_teaches_nothing(gpu):
    """It has no tile instances. Were they counted, the first rendering of that size would have no room for its own."""
    scene = random_scene("smoe", 20_000, 333, 157, scale=0.1, dtype=torch.float32, degree=0).to(gpu)
    shape = {name: scene.inputs[name] for name in ("means3D", "scales", "rotations")}
    radii = GaussianRasterizer(scene.settings).visible_filter(**shape)
    torch.cuda.synchronize()
    room, count = room_for(scene)
    assert room >= count > 1 << 16, "the scene fits whatever room there is"
    assert torch.equal(radii, op_results(scene)[0]["radii"])
