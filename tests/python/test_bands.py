"""Renderings with more tile instances than are listed at once: made band by band, they are those made at one stroke."""
from __future__ import annotations

import pytest
import torch
from comparison import assert_same_gradients
from devices import random_normal
from scenes import gradients, op_results, random_scene, with_gate, with_removal

from diff_smoe_rasterization import rasterize, rasterize_with_splats
from diff_smoe_rasterization.core import _core
from diff_smoe_rasterization.settings import OUTPUTS

# Six rows of tiles with 4,000 instances or more: bands of one or two rows, and single rows that exceed a band.
MOST = (1500, 100)


@pytest.fixture
def listing():
    """A function that says how many instances are listed at once."""
    yield _core.set_most_instances
    _core.set_most_instances(0)


def scene_of(mode, dtype=torch.float32, **settings):
    return random_scene(mode, 1500, 131, 83, scale=0.08, degree=1, dtype=dtype, **settings)


def instances(scene):
    """How many tile instances there are, and for how many a rendering keeps room."""
    saved = op_results(scene)[1]
    return int(saved["tile_offsets"][-1]), len(saved["instances"])


@with_gate
@pytest.mark.sanitize
@pytest.mark.parametrize("most", MOST)
def test_images_and_gradients(mode, most, device, listing):
    """The lists are shorter than a segment, so that a GPU too adds the same terms; as integers, to the same bits."""
    scene = scene_of(mode, deterministic=True)
    count, room = instances(scene)
    assert count > 2 * most and room >= count
    whole, expected = gradients(rasterize, scene, OUTPUTS)
    listing(most)
    assert instances(scene)[1] == 0, "lists are kept"
    banded, gradient = gradients(rasterize, scene, OUTPUTS)
    for name in ("color", "radii", *OUTPUTS):
        assert torch.equal(getattr(banded, name), getattr(whole, name)), name
    if device.type == "cpu" or most == MOST[0]:
        for name, values in expected.items():
            assert torch.equal(gradient[name], values), name
    else:  # a row without lists: the walk goes through all Gaussians, and sums them in other groups of eight
        assert_same_gradients(gradient, expected)


@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_gradients_without_deterministic(mode, dtype, device, listing):
    scene = scene_of(mode, dtype)
    expected = gradients(rasterize, scene)[1]
    listing(MOST[0])
    assert_same_gradients(gradients(rasterize, scene)[1], expected)


@with_removal
@pytest.mark.parametrize("most", MOST)
def test_scores(mode, most, device, listing):
    scene = scene_of(mode, torch.float64)
    settings = scene.settings
    maps = [random_normal((settings.image_height, settings.image_width), seed).abs() for seed in (2, 3)]

    def scores():
        splats = rasterize_with_splats(settings=settings, **scene.inputs)[1]
        return (*splats.contributions(maps[0]), *splats.importance(*maps))

    expected = scores()
    listing(most)
    for values, other in zip(scores(), expected):
        if device.type == "cpu":
            assert torch.equal(values, other)
        else:  # sums by atomics in any order, of numbers above 0
            torch.testing.assert_close(values, other, rtol=1e-9, atol=1e-12)


def test_nothing_visible(mode, device, listing):
    scene = scene_of(mode)
    scene = scene.with_inputs(means3D=scene.inputs["means3D"] + 30 * scene.settings.campos)
    listing(1)
    rendering, gradient = gradients(rasterize, scene)
    assert not rendering.radii.any()
    assert not any(values.any() for name, values in gradient.items() if name != "bg")


def test_a_number_below_0_is_refused():
    with pytest.raises(ValueError, match="set_most_instances: count is -1; it must be 0 or more"):
        _core.set_most_instances(-1)
