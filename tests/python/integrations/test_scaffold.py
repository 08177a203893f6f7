"""`visible_filter`, by which Scaffold-GS, HAC and HAC++ choose the anchors of a view."""
from __future__ import annotations

import inspect

import pytest
import torch
from comparison import one_thread
from devices import on_the_cpu
from scenes import random_scene

from diff_smoe_rasterization import reference, set_profiling, stage_times
from diff_smoe_rasterization.integrations.scaffold import GaussianRasterizer

pytestmark = pytest.mark.usefixtures("device")


def reference_radii(scene):
    with one_thread(), on_the_cpu():
        cpu = scene.to("cpu")
        return reference.rasterize(settings=cpu.settings, **cpu.inputs).radii


def shape_of(scene, *names):
    return {name: scene.inputs[name] for name in names}


def test_names_and_their_order():
    assert list(inspect.signature(GaussianRasterizer.visible_filter).parameters) == [
        "self", "means3D", "scales", "rotations", "cov3D_precomp"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale_modifier", [1.0, 1.7])
def test_radii_are_those_of_a_rendering(mode, dtype, scale_modifier):
    scene = random_scene(mode, 300, 45, 30, seed=21, dtype=dtype).with_settings(scale_modifier=scale_modifier)
    rasterizer = GaussianRasterizer(raster_settings=scene.settings)
    radii = rasterizer.visible_filter(**shape_of(scene, "means3D", "scales", "rotations"))
    assert radii.shape == (300,) and radii.dtype == torch.int32 and not radii.requires_grad
    assert (radii > 0).sum() > 100 and (radii == 0).sum() > 30
    assert torch.equal(radii, rasterizer(**scene.inputs)[1])
    if dtype == torch.float64:
        assert torch.equal(radii.cpu(), reference_radii(scene))


def test_the_covariance_may_be_given(mode):
    scene = random_scene(mode, 300, 45, 30, seed=22, covariance="cov3D")
    radii = GaussianRasterizer(scene.settings).visible_filter(**shape_of(scene, "means3D", "cov3D_precomp"))
    assert radii.any() and torch.equal(radii.cpu(), reference_radii(scene))


def test_scales_may_be_three_of_six_columns(mode):
    scene = random_scene(mode, 300, 45, 30, seed=23)
    scales = torch.cat([scene.inputs["scales"], torch.full_like(scene.inputs["scales"], float("nan"))], 1)[:, :3]
    assert not scales.is_contiguous()
    radii = GaussianRasterizer(scene.settings).visible_filter(
        means3D=scene.inputs["means3D"], scales=scales, rotations=scene.inputs["rotations"], cov3D_precomp=None)
    assert radii.any() and torch.equal(radii.cpu(), reference_radii(scene))


def test_the_blend_mode_decides_what_is_seen(monkeypatch):
    """A footprint reaches further if G cuts it: 4.8 sigma in place of tiles around 3."""
    def radii(scene, **settings):
        return GaussianRasterizer(scene.settings._replace(**settings)).visible_filter(
            **shape_of(scene, "means3D", "scales", "rotations"))

    scene = random_scene(None, 2000, 45, 30, seed=24)
    alpha, smoe = radii(scene), radii(scene, blend_mode="smoe_eq7")
    assert ((smoe > 0) != (alpha > 0)).any()
    both = (smoe > 0) & (alpha > 0)
    assert torch.equal(alpha[both], smoe[both])
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe_eq7")
    assert torch.equal(radii(scene), smoe)


def test_nothing_is_recorded_for_autograd():
    scene = random_scene("smoe", 50).requiring_grad()
    radii = GaussianRasterizer(scene.settings).visible_filter(**shape_of(scene, "means3D", "scales", "rotations"))
    assert radii.grad_fn is None and radii.any()


def test_nothing_is_rendered():
    """The filter comes before every rendering of the trainer: it must cost less, and say nothing of its tiles."""
    scene = random_scene("smoe", 300, 45, 30, seed=25)
    rasterizer = GaussianRasterizer(scene.settings)
    set_profiling(True)
    try:
        rasterizer(**scene.inputs)
        times = stage_times()
        rasterizer.visible_filter(**shape_of(scene, "means3D", "scales", "rotations"))
        assert stage_times() == times and times["bin"] > 0
    finally:
        set_profiling(False)


def test_decoded_anchors_of_hac_plus_have_more_rotations_than_anchors(mode):
    scene = random_scene(mode, 300, 45, 30, seed=24)
    rotations = scene.inputs["rotations"]
    more = torch.cat([rotations, torch.full_like(rotations[:7], float("nan"))])
    rasterizer = GaussianRasterizer(scene.settings)
    radii = rasterizer.visible_filter(**shape_of(scene, "means3D", "scales"), rotations=more)
    assert radii.any() and torch.equal(radii.cpu(), reference_radii(scene))
    with pytest.raises(ValueError, match="rotations has shape"):
        rasterizer.visible_filter(**shape_of(scene, "means3D", "scales"), rotations=rotations[:-1])


@pytest.mark.parametrize("name", ["means3D", "rotations"])
def test_what_is_no_matrix_is_refused_as_rasterize_does(name):
    scene = random_scene("alpha", 12)
    shape = shape_of(scene, "means3D", "scales", "rotations")
    wrong = [(5, TypeError, f"{name} is of type int; it must be a torch.Tensor"),
             *((torch.ones(sizes, dtype=torch.float64), ValueError, rf"{name} has shape \[{text}\]; it must be")
               for sizes, text in (((), ""), ((12,), "12")))]
    if name == "means3D":
        wrong.append((None, TypeError, "means3D is of type NoneType; it must be a torch.Tensor"))
    for value, error, words in wrong:
        with pytest.raises(error, match=words):
            GaussianRasterizer(scene.settings).visible_filter(**{**shape, name: value})


def test_no_anchors_have_no_radii():
    scene = random_scene("alpha", 12).rows(slice(0))
    radii = GaussianRasterizer(scene.settings).visible_filter(**shape_of(scene, "means3D", "scales", "rotations"))
    assert radii.shape == (0,) and radii.dtype == torch.int32


def test_the_shape_is_given_once():
    scene = random_scene("alpha", 12)
    rasterizer, means3D = GaussianRasterizer(scene.settings), scene.inputs["means3D"]
    covariance = torch.ones(12, 6, dtype=torch.float64)
    for shape in ({}, {"scales": scene.inputs["scales"]},
                  {**shape_of(scene, "scales", "rotations"), "cov3D_precomp": covariance}):
        with pytest.raises(ValueError, match="radii: .*scales"):
            rasterizer.visible_filter(means3D, **shape)
