"""For how many tile instances a rendering makes room, and what it learns that from."""
from __future__ import annotations

import torch
from scenes import op_results, random_scene

from diff_smoe_rasterization.integrations.scaffold import GaussianRasterizer

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
    assert room_for(small)[0] >= count > 10 * room_for(small)[1], "the large view is no outlier"
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
