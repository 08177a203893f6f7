"""What the flavour of Taming-3DGS promises its trainer, against the reference: thirteen results, `pixel_weights`."""
from __future__ import annotations

import inspect
import pickle

import pytest
import torch
from comparison import (
    assert_all_close,
    assert_close,
    assert_is_the_references,
    assert_same_gradients,
    reference_contributions,
    reference_gradients,
)
from devices import random_normal
from scenes import gradients, random_scene, random_weights, spread

import diff_smoe_rasterization
from diff_smoe_rasterization import Rendering, rasterize
from diff_smoe_rasterization.integrations import taming
from diff_smoe_rasterization.integrations.taming import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    SparseGaussianAdam,
    fused_ssim,
)

pytestmark = pytest.mark.usefixtures("device")

FIELDS = ["image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
          "sh_degree", "campos", "prefiltered", "debug", "pixel_weights"]
INPUTS = ["means3D", "means2D", "opacities", "dc", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp"]
RESULTS = ["color", "radii", "counts", "lists", "lists_render", "lists_distance", "centers", "depths", "my_radii",
           "accum_weights", "accum_count", "accum_blend", "accum_dist"]

# A sum of some thousand terms in float64, each with some hundred roundings of 1e-16.
TOLERANCE = 1e-12


def settings_of(settings, pixel_weights=None, **others):
    """The settings as the trainer makes them: by keyword, its own fields and no other, then what the user adds."""
    values = {name: getattr(settings, name) for name in FIELDS[:-1]}
    return GaussianRasterizationSettings(**{**values, "blend_mode": settings.blend_mode, **others},
                                         pixel_weights=pixel_weights)


def call(scene, pixel_weights=None, **others):
    """Returns the thirteen results by name."""
    rasterizer = GaussianRasterizer(raster_settings=settings_of(scene.settings, pixel_weights, **others))
    results = rasterizer(**scene.inputs)
    assert type(results) is tuple and len(results) == 13
    return dict(zip(RESULTS, results))


def render_with(pixel_weights=None, **others):
    """A function with the signature of `rasterize`, as scenes.gradients calls it."""
    def render(settings, outputs, **inputs):
        rasterizer = GaussianRasterizer(raster_settings=settings_of(settings, pixel_weights, **others))
        return Rendering(*rasterizer(**inputs)[:2])

    return render


def loss_map(scene, seed=5):
    """What the trainer makes of an error and of edges: numbers of 0 or more."""
    shape = (scene.settings.image_height, scene.settings.image_width)
    return random_normal(shape, seed, scene.inputs["means3D"].dtype).abs()


def assert_scores_are_the_references(results, scene, pixel_weights):
    centers, depths, sums = reference_contributions(scene, pixel_weights)
    assert_close(results["centers"], centers, TOLERANCE, "centers")
    assert_close(results["depths"], depths, TOLERANCE, "depths")
    assert_close(results["accum_weights"], sums.pixel_weights, TOLERANCE, "accum_weights")
    assert torch.equal(results["accum_count"].cpu(), sums.pixels)
    assert_close(results["accum_blend"], sums.blend_weights, TOLERANCE, "accum_blend")
    assert_close(results["accum_dist"], sums.distances, TOLERANCE, "accum_dist")


def test_names_and_their_order():
    assert set(taming.__all__) == {"GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam",
                                   "fused_ssim", "rasterize_gaussians"}
    assert list(GaussianRasterizationSettings._fields)[:13] == FIELDS
    plain = diff_smoe_rasterization.GaussianRasterizationSettings
    assert set(GaussianRasterizationSettings._fields) == {*plain._fields, "pixel_weights"}
    assert GaussianRasterizationSettings._field_defaults == {**plain._field_defaults, "pixel_weights": None}
    assert list(inspect.signature(GaussianRasterizer.forward).parameters)[1:] == INPUTS
    assert list(inspect.signature(taming.rasterize_gaussians).parameters) == [
        "means3D", "means2D", "dc", "sh", "colors_precomp", "opacities", "scales", "rotations", "cov3Ds_precomp",
        "raster_settings"]
    assert issubclass(GaussianRasterizer, torch.nn.Module)
    assert "pixel_weights" in GaussianRasterizationSettings.__doc__
    settings = settings_of(random_scene("smoe", 1).settings)._replace(bg=0, viewmatrix=0, projmatrix=0, campos=0)
    assert pickle.loads(pickle.dumps(settings)) == settings


def test_pixel_weights_follow_debug():
    scene = random_scene("alpha", 1)
    pixel_weights = torch.ones(1)
    settings = GaussianRasterizationSettings(*scene.settings[:12], pixel_weights)
    assert settings.pixel_weights is pixel_weights and settings.antialiasing is False and settings.blend_mode is None


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scored", [False, True])
def test_shapes_and_types_of_the_thirteen(mode, scored, dtype):
    scene = random_scene(mode, 40, 33, 21, degree=1, dtype=dtype).requiring_grad()
    results = call(scene, loss_map(scene) if scored else None)
    whole, score = torch.int32, (40,) if scored else (0,)
    expected = {"color": ((3, 21, 33), dtype), "radii": ((40,), whole), "counts": ((21, 33) if scored else (0,), whole),
                "lists": ((0,), whole), "lists_render": ((0,), dtype), "lists_distance": ((0,), dtype),
                "centers": ((40, 2), dtype), "depths": ((40,), dtype), "my_radii": ((40,), whole),
                "accum_weights": (score, dtype), "accum_count": (score, whole), "accum_blend": (score, dtype),
                "accum_dist": (score, dtype)}
    assert {name: (tuple(tensor.shape), tensor.dtype) for name, tensor in results.items()} == expected
    for name, tensor in results.items():
        assert tensor.requires_grad == (name == "color") and tensor.is_contiguous()
        assert tensor.device == scene.inputs["means3D"].device, name
    assert torch.equal(results["radii"], results["my_radii"]) and not results["counts"].any()
    addresses = [tensor.data_ptr() for tensor in results.values() if tensor.numel() > 0]
    assert len(set(addresses)) == len(addresses), "one result in place changes another"


def test_images_radii_and_gradients_are_the_references(mode):
    scene = random_scene(mode, 60, 45, 30, seed=3)
    expected = reference_gradients(scene)
    for pixel_weights in (None, loss_map(scene)):
        assert_is_the_references(*gradients(render_with(pixel_weights), scene), *expected, TOLERANCE)


def test_scores_are_the_references(mode):
    scene = random_scene(mode, 60, 45, 30, seed=4)
    pixel_weights = loss_map(scene)
    results = call(scene, pixel_weights)
    assert_scores_are_the_references(results, scene, pixel_weights)
    culled = results["radii"] == 0
    assert culled.any() and (results["accum_count"] > 0).sum() > 20
    for name in RESULTS[6:]:
        assert not results[name][culled].any(), name
    without = call(scene)
    for name in ("color", "radii", "centers", "depths", "my_radii"):
        assert torch.equal(without[name], results[name]), name


def test_an_opacity_may_exceed_one(mode):
    scene = random_scene(mode, 60, 45, 30, seed=5, opacity=(1.5, 6.0))
    pixel_weights = loss_map(scene)
    rendering, actual = gradients(render_with(pixel_weights), scene)
    expected_rendering, expected = reference_gradients(scene)
    assert_close(rendering.color, expected_rendering.color, TOLERANCE, "color")
    assert expected["opacities"].any()
    assert_all_close(actual, expected, TOLERANCE)
    assert_scores_are_the_references(call(scene, pixel_weights), scene, pixel_weights)


def test_accum_blend_is_divided_by_no_gate_sum():
    """One faint Gaussian straight ahead: in its own pixel alpha T is 0.25, and divided by the gate sum it were 1."""
    for mode in ("alpha", "smoe", "smoe_tn", "smoe_std"):
        scene = random_scene(mode, 1, 33, 33).with_inputs(
            means3D=torch.zeros(1, 3, dtype=torch.float64), opacities=torch.full((1, 1), 0.25, dtype=torch.float64),
            scales=torch.full((1, 3), 1e-6, dtype=torch.float64))
        results = call(scene, torch.ones(33, 33, dtype=torch.float64))
        # A Gaussian of variance 0.3 px^2, summed over whole pixels: 2 pi 0.3, times a theta function near 1: by
        # Poisson's formula the next term is 4 exp(-2 pi^2 0.3) = 0.011. Its tails are cut at alpha 1/255: 0.016.
        assert results["accum_blend"].item() == pytest.approx(0.25 * 2 * torch.pi * 0.3, rel=0.05)
        assert results["accum_count"].item() == results["accum_weights"].item()


def test_inputs_need_not_be_contiguous(mode):
    scene = random_scene(mode, 60, 45, 30, seed=6)
    strided = scene._replace(inputs={name: spread(tensor) for name, tensor in scene.inputs.items()})
    pixel_weights = loss_map(scene)
    turned = spread(pixel_weights)
    assert not any(tensor.is_contiguous() for tensor in (turned, *strided.inputs.values()))
    assert_scores_are_the_references(call(strided, turned), scene, pixel_weights)
    leaves = {name: tensor.requires_grad_(True) for name, tensor in strided.inputs.items()}
    color = render_with(turned)(scene.settings, (), **leaves).color
    expected, expected_gradients = gradients(render_with(pixel_weights), scene, camera=False)
    assert torch.equal(color, expected.color)
    weights = random_weights(expected)[1][0]
    actual = dict(zip(leaves, torch.autograd.grad(color, list(leaves.values()), weights)))
    assert_same_gradients(actual, expected_gradients)


def test_empty_cpu_tensors_are_absent_inputs(mode):
    empty = torch.Tensor([]).cpu()  # float32, whatever the others are
    for covariance, channels in (("scales", None), ("cov3D", 3)):
        scene = random_scene(mode, 60, 45, 30, seed=7, covariance=covariance, channels=channels)
        absent = {name: empty for name in INPUTS if name not in scene.inputs}
        assert len(absent) >= 3
        pixel_weights = loss_map(scene)
        results = call(scene.with_inputs(**absent), pixel_weights)
        assert_close(results["color"], reference_gradients(scene)[0].color, TOLERANCE, "color")
        assert_scores_are_the_references(results, scene, pixel_weights)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_dc_may_come_apart_from_the_other_coefficients(mode, degree):
    """At degree 0 the trainer passes shs of shape [N, 0, 3]."""
    scene = random_scene(mode, 60, 45, 30, seed=8, degree=degree, split_dc=True)
    i = scene.inputs
    assert i["dc"].shape == (60, 1, 3) and i["shs"].shape == (60, (degree + 1) ** 2 - 1, 3)
    split = call(scene)
    settings = settings_of(scene.settings)
    positional = GaussianRasterizer(settings)(i["means3D"], i["means2D"], i["opacities"], i["dc"], i["shs"], None,
                                              i["scales"], i["rotations"])
    function = taming.rasterize_gaussians(i["means3D"], i["means2D"], i["dc"], i["shs"], None, i["opacities"],
                                          i["scales"], i["rotations"], None, settings)
    joint = call(scene.with_inputs(shs=torch.cat([i["dc"], i["shs"]], 1), dc=None))
    for other in (positional[0], function[0], joint["color"]):
        assert torch.equal(other, split["color"])
    assert len(function) == 13


def test_debug_works(mode):
    scene = random_scene(mode, 60, 45, 30, seed=9)
    pixel_weights = loss_map(scene)
    rendering, actual = gradients(render_with(pixel_weights, debug=True), scene)
    expected, expected_gradients = gradients(render_with(pixel_weights), scene)
    assert torch.equal(rendering.color, expected.color)
    assert_same_gradients(actual, expected_gradients)


@pytest.mark.parametrize("empty", [lambda: None, lambda: torch.empty(0), lambda: torch.empty(0, device="cpu")],
                         ids=["none", "empty", "empty_on_the_cpu"])
def test_without_pixel_weights_there_are_no_scores(mode, empty):
    results = call(random_scene(mode, 40, 33, 21), empty())
    for name in ("counts", "accum_weights", "accum_count", "accum_blend", "accum_dist"):
        assert results[name].shape == (0,), name
    assert results["depths"].any() and results["centers"].any()


@pytest.mark.parametrize("shape", [(33, 21), (1, 21, 33), (21 * 33,), (1,), (22, 33)])
def test_pixel_weights_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"pixel_weights has shape .*; it must be \[21, 33\]"):
        call(random_scene("smoe", 40, 33, 21), torch.ones(shape, dtype=torch.float64))


def test_pixel_weights_of_another_type_are_refused():
    with pytest.raises(TypeError, match="pixel_weights is float32; it must be float64"):
        call(random_scene("smoe", 40, 33, 21), torch.ones(21, 33))


def test_an_image_of_one_row_has_scores(mode):
    scene = random_scene(mode, 60, 45, 1, seed=10, scale=0.3)
    pixel_weights = loss_map(scene)
    results = call(scene, pixel_weights)
    assert results["accum_count"].any()
    assert_scores_are_the_references(results, scene, pixel_weights)


def test_no_gaussians(mode):
    scene = random_scene(mode, 40, 33, 21, degree=1).rows(slice(0)).requiring_grad(camera=False)
    results = call(scene, loss_map(scene))
    assert torch.equal(results["color"], scene.settings.bg[:, None, None].expand(3, 21, 33))
    assert results["centers"].shape == (0, 2) and results["counts"].shape == (21, 33)
    assert all(results[name].shape == (0,) for name in RESULTS[7:])
    results["color"].sum().backward()
    assert scene.inputs["shs"].grad.shape == (0, 4, 3)


@pytest.mark.parametrize("wrong", [{"shs": None}, {"colors_precomp": True}, {"scales": None}, {"cov3D_precomp": True}])
def test_both_or_neither_of_two_ways_is_an_error(wrong):
    scene = random_scene("smoe", 40, 33, 21)
    given = {"colors_precomp": torch.ones(40, 3, dtype=torch.float64),
             "cov3D_precomp": torch.ones(40, 6, dtype=torch.float64)}
    with pytest.raises(ValueError, match="rasterize"):
        call(scene.with_inputs(**{name: given[name] if value else None for name, value in wrong.items()}))


def test_the_blend_mode_comes_from_the_settings_or_the_environment(mode, monkeypatch):
    scene = random_scene(mode, 60, 45, 30, seed=11)
    pixel_weights = loss_map(scene)
    alpha = call(scene, pixel_weights, blend_mode=None)["color"]
    monkeypatch.setenv("DSMOE_BLEND_MODE", mode)
    results = call(scene, pixel_weights, blend_mode=None)
    assert_close(results["color"], reference_gradients(scene)[0].color, TOLERANCE, "environment")
    assert_scores_are_the_references(results, scene, pixel_weights)
    assert torch.equal(call(scene, blend_mode="alpha")["color"], alpha)
    if mode != "alpha":
        assert (alpha - results["color"]).abs().max() > 0.01


def test_the_background_gate_is_one_of_the_settings():
    scene = random_scene("smoe", 60, 45, 30, seed=11)
    expected = rasterize(settings=scene.settings._replace(background_gate=0.3), **scene.inputs).color
    color = call(scene, loss_map(scene), background_gate=0.3)["color"]
    assert torch.equal(color, expected) and (color - call(scene)["color"]).abs().max() > 0.01


def test_mark_visible_is_the_near_plane():
    scene = random_scene("alpha", 40, 33, 21)
    settings = settings_of(scene.settings)
    visible = GaussianRasterizer(settings).markVisible(scene.inputs["means3D"])
    depths = scene.inputs["means3D"] @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]
    assert visible.dtype == torch.bool and visible.any() and not visible.all()
    assert torch.equal(visible, depths > 0.2)


def normalized(weight, values):
    """As the trainer weighs its scores: by the median of those above 0. It edits what it is given."""
    values[values.isnan()] = 0
    positive = values > 0
    score = torch.zeros_like(values, dtype=torch.float32)
    score[positive] = weight * values[positive].float() / values[positive].float().median()
    return score


def test_a_round_of_scoring_and_a_step(mode):
    """The order of the trainer: a view is scored in training, then rendered and stepped."""
    scene = random_scene(mode, 60, 45, 30, seed=12, degree=1, split_dc=True, dtype=torch.float32)
    parameters = {name: tensor.clone().requires_grad_(True) for name, tensor in scene.inputs.items()
                  if name != "means2D"}
    leaves = scene._replace(inputs={**parameters, "means2D": torch.zeros(60, 3, requires_grad=True)})
    with torch.no_grad():
        target = call(scene)["color"] * 0.5 + 0.2
    scored = call(leaves, (call(leaves)["color"] - target).abs().mean(0).detach())
    importance = sum(normalized(1.0, scored[name].detach()) for name in RESULTS[7:])
    seen = scored["radii"] > 0
    assert torch.isfinite(importance).all() and (importance[seen] > 0).all() and not importance[~seen].any()
    assert len(torch.multinomial(importance, 5, replacement=False).unique()) == 5

    optimizer = SparseGaussianAdam([{"params": [tensor], "lr": 0.01, "name": name}
                                    for name, tensor in parameters.items()], lr=0.0, eps=1e-15)
    results = call(leaves)
    (1 - fused_ssim(results["color"].unsqueeze(0), target.unsqueeze(0))).backward()
    assert leaves.inputs["means2D"].grad[:, :2].any()
    before = parameters["means3D"].detach().clone()
    optimizer.step(results["radii"] > 0, results["radii"].shape[0])
    moved = (parameters["means3D"].detach() != before).any(1)
    assert moved.any() and not moved[results["radii"] == 0].any()
