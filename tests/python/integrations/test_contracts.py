"""The rasterizers of contracts.py that ask for more than images: each against what it says, in float64."""
from __future__ import annotations

import importlib
import inspect
import re
from types import SimpleNamespace

import pytest
import torch
from comparison import assert_close
from devices import random_normal
from scenes import REMOVABLE_MODES, random_scene, turned

from diff_smoe_rasterization import rasterize, rasterize_with_splats, reference
from diff_smoe_rasterization.integrations import (
    absgs,
    cob_gs,
    depth_alpha,
    fastgs,
    feature_3dgs,
    grouping,
    gsplat,
    inria,
    inria_2024,
    langsplat,
    light_gaussian,
    lucid_dreamer,
    mcmc,
    mini_splatting,
    mip_splatting,
    monogs,
    nearest_points,
    pixel_gs,
    scaffold,
    speedy_splat,
)
from diff_smoe_rasterization.integrations._rasterizer import classes_of
from diff_smoe_rasterization.integrations.contracts import (
    CONTRACTS,
    GSPLAT,
    NAMES,
    OF_LATER_GSPLAT,
    SETTINGS,
    contract_of,
)

pytestmark = pytest.mark.usefixtures("device")

# A sum of some thousand terms in float64, each with some hundred roundings of 1e-16.
TOLERANCE = 1e-11
N, WIDTH, HEIGHT = 30, 33, 21
OFTEN_GIVEN = {"confidence": None, "subpixel_offset": None, "kernel_size": 0.3, "projmatrix_raw": None,
               "depth_threshold": 1.0, "metric_map": None, "get_flag": False, "f_count": False,
               "include_mask": False, "nearest_points": None}


def scene_of(mode, **more):
    return random_scene(mode, N, WIDTH, HEIGHT, seed=81, degree=1, scale=0.05, **more)


def rendered(module, scene, settings=None, **inputs):
    """A call of a module's rasterizer; settings: the fields of its own."""
    made = module.GaussianRasterizationSettings(**{**scene.settings._asdict(), **(settings or {})})
    return module.GaussianRasterizer(raster_settings=made)(**{**scene.inputs, **inputs})


def own(scene, **more):
    return rasterize(settings=scene.settings, **{**scene.inputs, **more})


@pytest.mark.parametrize("contract", [one for one in CONTRACTS if one.name not in ("taming", "gsplat")])
def test_each_module_returns_what_its_contract_says(contract):
    module = importlib.import_module(f"diff_smoe_rasterization.integrations.{contract.name}")
    scene = random_scene("alpha", 12, 20, 10)
    fields = {name: getattr(scene.settings, name) for name in SETTINGS}
    settings = module.GaussianRasterizationSettings(
        **fields, **{name: OFTEN_GIVEN.get(name, True) for name in contract.settings})
    features = {name: torch.rand(12, 1, 4).double() for name in contract.arguments if name.startswith("semantic")}
    results = module.GaussianRasterizer(raster_settings=settings)(**scene.inputs, **features)
    assert len(results) == len(contract.results)
    found = dict(zip(contract.results, results))
    assert found["color"].shape == (3, 10, 20) and found["radii"].shape == (12,)
    for name in {"inverse_depth", "depth", "alpha", "opacity"} & set(found):
        assert found[name].shape == (1, 10, 20)


@pytest.mark.parametrize("contract", [one for one in CONTRACTS if one.name != "gsplat"])
def test_whatever_an_argument_is_the_error_names_it(contract):
    """Each argument in turn is what it cannot be: an error of torch, from code before `rasterize`, would not say so."""
    module = importlib.import_module(f"diff_smoe_rasterization.integrations.{contract.name}")
    scene = random_scene("alpha", 12, 20, 10, degree=1)
    fields = {name: getattr(scene.settings, name) for name in SETTINGS}
    made = module.GaussianRasterizationSettings(**fields, **{
        name: None if name == "pixel_weights" else OFTEN_GIVEN.get(name, True) for name in contract.settings})
    kinds = {name: torch.rand(12, 1, 4).double() for name in contract.arguments
             if name in ("semantic_feature", "sh_objs", "language_feature_precomp", "mask_precomp")}
    wrong = [torch.zeros(12).double(), torch.zeros(12, 3, 3, 3).double(), torch.zeros(5, 3).double(),
             torch.tensor(1.0).double(), torch.zeros(12, 7).double(), "red", 3.5, [1, 2]]
    names = [name for name in contract.arguments if name not in ("sh_indices", "g_indices", "scale_factors")]
    for name in names:
        for value in wrong:
            inputs = {**scene.inputs, **kinds, name: value}
            if name == "colors_precomp":
                del inputs["shs"]
            try:
                module.GaussianRasterizer(raster_settings=made)(**inputs)
            except (TypeError, ValueError, NotImplementedError) as error:
                if not re.match(r"rasterize(_with_splats)?: \w+ (is|has|are) ", str(error)):
                    raise
    for name in ("means3D", "shs", "opacities"):
        with pytest.raises(TypeError, match=f"rasterize(_with_splats)?: {name} is of type str"):
            module.GaussianRasterizer(raster_settings=made)(**{**scene.inputs, **kinds, name: "red"})


@pytest.mark.parametrize("contract, name", [
    (one.name, name) for one in CONTRACTS for name in one.settings
    if one.name != "taming" and name not in ("mult", "nearest_points")] + [("inria", "viewmatrix")])
def test_whatever_a_setting_is_the_error_names_it_and_what_would_be_right(contract, name):
    """`mult` is not read, no nearest_points are right, and a flag is whatever bool() takes but text."""
    module = importlib.import_module(f"diff_smoe_rasterization.integrations.{contract}")
    scene = random_scene("alpha", 12, 20, 10)
    fields = {name: getattr(scene.settings, name) for name in SETTINGS}
    fields.update({name: OFTEN_GIVEN.get(name, True) for name in contract_of(contract).settings})
    if name == "metric_map":
        fields["get_flag"] = True
    is_flag = isinstance(fields[name], bool)
    for wrong in ("red", torch.ones(7)) if is_flag else ("red", [1, 2], object(), torch.ones(7).double()):
        if name == "subpixel_offset" and isinstance(wrong, torch.Tensor):
            continue
        settings = module.GaussianRasterizationSettings(**{**fields, name: wrong})
        right = "must be (True or False|a number|a torch.Tensor)|must have [0-9]+ elements|must be \\[4, 4\\]"
        with pytest.raises((TypeError, ValueError), match=f"rasterize: {name} (is|has) .*; it ({right})"):
            module.GaussianRasterizer(raster_settings=settings)(**scene.inputs)


def sums_of_absolute_gradients(scene, weights, **settings):
    points = torch.zeros(N, 2, dtype=torch.float64, requires_grad=True)
    rendering = rasterize(settings=scene.settings._replace(**settings), means2D_abs=points, **scene.inputs)
    (rendering.color * weights).sum().backward()
    return rendering, points.grad


def test_mip_splatting_has_a_low_pass_filter_of_its_own(mode):
    scene, weights = scene_of(mode), random_normal((3, HEIGHT, WIDTH), 82)
    points = torch.zeros(N, 3, dtype=torch.float64, requires_grad=True)
    zeros = torch.zeros(HEIGHT, WIDTH, 2, dtype=torch.float64)
    given = {"kernel_size": 0.1, "subpixel_offset": zeros}
    color, radii = rendered(mip_splatting, scene, given, means2D=points)
    expected, absolute = sums_of_absolute_gradients(scene, weights, low_pass=0.1, antialiasing=True)
    assert torch.equal(radii, expected.radii) and not torch.equal(color, own(scene).color)
    assert_close(color, expected.color, TOLERANCE, "color")
    (color * weights).sum().backward()
    assert_close(points.grad[:, 2], absolute.sum(1), TOLERANCE, "the third column")
    with pytest.raises(NotImplementedError, match="subpixel_offset is not zero"):
        rendered(mip_splatting, scene, {**given, "subpixel_offset": zeros + 0.25})


@pytest.mark.parametrize("module, third", [
    (absgs, "blend_weights"), (fastgs, None), (inria_2024, None), (inria, None)])
def test_two_more_columns_of_means2d(mode, module, third):
    scene, weights = scene_of(mode), random_normal((3, HEIGHT, WIDTH), 83)
    points = torch.zeros(N, 4, dtype=torch.float64, requires_grad=True)
    color, _, *sums = rendered(module, scene, {"get_flag": False} if module is fastgs else {}, means2D=points)
    (color * weights).sum().backward()
    expected, absolute = sums_of_absolute_gradients(scene, weights)
    assert_close(points.grad[:, 2:], absolute, TOLERANCE, "the last columns")
    signed = torch.zeros(N, 3, dtype=torch.float64, requires_grad=True)
    (own(scene, means2D=signed).color * weights).sum().backward()
    assert_close(points.grad[:, :2], signed.grad[:, :2], TOLERANCE, "the first columns")
    if third:
        splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)[1]
        found = splats.contributions(torch.ones_like(color[0]).detach())
        assert_close(sums[0], getattr(found, third), TOLERANCE, third)
    with torch.no_grad():  # as trainers render test views
        assert_close(rendered(module, scene, means2D=points + 0)[0], color, TOLERANCE, "color")


def test_the_arguments_of_gsplat_are_those_of_its_contract():
    """`dsmoe run` compares a trainer's call with them, and the extension need not be there for that."""
    taken = inspect.signature(gsplat.rasterization).parameters
    assert [*taken] == [*GSPLAT, "others"] and not {*OF_LATER_GSPLAT} & {*GSPLAT}


def test_mcmc_says_what_is_used_and_relocates():
    scene = scene_of("smoe")
    _, radii, used = rendered(mcmc, scene)
    assert torch.equal(used, (radii > 0).int()) and 0 < used.sum() < N
    old, copies = torch.tensor([[0.2], [0.95]], dtype=torch.float64), torch.tensor([[3], [80]])
    new, scales = mcmc.compute_relocation(old, torch.ones(2, 3, dtype=torch.float64), copies, torch.zeros(51, 51), 51)
    # The most copies are 50. 1e-12: a power of 50 times a rounding of 1e-16.
    assert_close(1 - (1 - new) ** torch.tensor([[3], [50]]), old, 1e-12, "the opacity of all copies")
    assert (scales < 1).all()


def exponential(theta, rho):
    """The matrix [4, 4] of a small motion."""
    x, y, z = theta.tolist()
    twist = torch.tensor([[0, -z, y, rho[0]], [z, 0, -x, rho[1]], [-y, x, 0, rho[2]], [0, 0, 0, 0]]).double()
    return torch.matrix_exp(twist)


@pytest.mark.parametrize("shutter", ["global", "right_to_left"])
def test_monogs_moves_the_camera_by_its_gradients(shutter):
    """By finite differences along each axis: T becomes exp(rho, theta) T, both of a rolling shutter."""
    scene = random_scene("eq7_gate", 8, WIDTH, HEIGHT, seed=1, scale=0.3, opacity=(0.3, 0.8), degree=1)
    poses = [scene.settings.viewmatrix]
    if shutter != "global":
        poses.append(turned(poses[0], (0.04, -0.05, 0.08), (0.1, 0.12, -0.07)))
        scene = scene.with_settings(principal_point=(16.0, 11.0), rolling_shutter=shutter)
    raw = torch.linalg.solve(poses[0], scene.settings.projmatrix)
    weights = random_normal((3, HEIGHT, WIDTH), 84)
    theta, rho = (torch.full((3,), 0.7, dtype=torch.float64, requires_grad=True) for _ in range(2))  # not read

    def moved(motion):
        ends = [(motion @ pose.T).T for pose in poses]
        centre = sum(torch.linalg.inv(end)[3, :3] for end in ends) / len(ends)
        return scene.with_settings(viewmatrix=ends[0], projmatrix=ends[0] @ raw, campos=centre,
                                   viewmatrix_end=None if shutter == "global" else ends[1])

    def loss(motion):
        return (own(moved(motion)).color * weights).sum()

    still = moved(torch.eye(4, dtype=torch.float64))
    color, _, depth, opacity, touched = rendered(monogs, still, {"projmatrix_raw": raw}, theta=theta, rho=rho)
    assert torch.equal(color, own(still).color), "the camera's values stay"
    (color * weights).sum().backward()

    step = 1e-6
    for place, leaf in enumerate((theta, rho)):
        for axis in range(3):
            motion = torch.zeros(2, 3, dtype=torch.float64)
            motion[place, axis] = step
            numeric = ((loss(exponential(*motion)) - loss(exponential(*-motion))) / (2 * step)).item()
            # The loss, up to 1e3, is rounded by 1e-13, and 2e-6 divides that; the step's own error is of order 1e-12.
            assert leaf.grad[axis].item() == pytest.approx(numeric, rel=1e-5, abs=1e-5)
    assert depth.shape == opacity.shape == (1, HEIGHT, WIDTH) and touched.dtype == torch.int32 and touched.any()
    without = rendered(monogs, still, {"projmatrix_raw": None}, theta=theta.detach())
    assert torch.equal(without[0], color), "without projmatrix_raw"


def test_the_centre_that_monogs_is_given_stays_with_a_rolling_shutter():
    """That of the first pose, say: colours by harmonics depend on it."""
    scene = scene_of("alpha").with_settings(rolling_shutter="top_to_bottom", principal_point=(16.0, 11.0))
    first = scene.settings.viewmatrix
    own_fields = {"projmatrix_raw": None, "viewmatrix_end": turned(first, (0.04, -0.05, 0.08), (0.5, 0.6, -0.4))}
    theta, rho = (torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    expected = rendered(monogs, scene, own_fields)[0]
    for motion in ({"theta": theta}, {"rho": rho}, {"theta": theta, "rho": rho}):
        assert torch.equal(rendered(monogs, scene, own_fields, **motion)[0], expected)
    with pytest.raises(ValueError, match=r"campos has shape \[2\]; it must have 3 elements"):
        rendered(monogs, scene, {**own_fields, "campos": scene.settings.campos[:2]}, theta=theta)


NORMALS = ("color", "depth", "normal", "median_depth", "radii")  # as GSDF's rasterizer returns them
WITH_NORMALS = SimpleNamespace(**dict(zip(NAMES, classes_of(",".join(NORMALS), __name__))))
FEATURES = [(WITH_NORMALS, "normal_precomp", (N, 3), {}, 2),
            (grouping, "sh_objs", (N, 1, 5), {}, 2), (feature_3dgs, "semantic_feature", (N, 1, 5), {}, 1),
            (langsplat, "language_feature_precomp", (N, 3), {"include_feature": True}, 1)]
FREE = {"antialiasing": False, "clamp_color": True, "depth_threshold": 4.0, "include_feature": True}


@pytest.mark.parametrize("module, name, shape, settings, place", FEATURES)
def test_features_are_blended_beside_the_colours(mode, module, name, shape, settings, place):
    """As two renderings would; gradients too."""
    values = random_normal(shape, 85)
    weights = random_normal((3 + values.shape[-1], HEIGHT, WIDTH), 86)

    def gradients(of):
        scene, features = scene_of(mode).requiring_grad(camera=False), values.clone().requires_grad_()
        color, image = of(scene, features)
        assert image.shape == (shape[-1], HEIGHT, WIDTH)
        (torch.cat([color, image]) * weights).sum().backward()
        return [color, image, features.grad, *(leaf.grad for leaf in scene.leaves().values())]

    def together(scene, features):
        results = rendered(module, scene, settings, **{name: features})
        return results[0], results[place]

    def apart(scene, features):
        inputs = {key: tensor for key, tensor in scene.inputs.items() if key != "shs"}
        black = scene.settings._replace(bg=torch.zeros(shape[-1], dtype=torch.float64))
        image = rasterize(settings=black, colors_precomp=features.reshape(N, -1), **inputs).color
        return own(scene).color, image

    for found, expected in zip(gradients(together), gradients(apart)):
        assert expected.any()
        assert_close(found, expected, TOLERANCE, "an image or a gradient")


def test_features_beside_colours_whose_first_coefficient_is_apart(mode):
    """With a degree below that of the coefficients, too."""
    scene, objects = scene_of(mode), random_normal((N, 1, 5), 87)
    combined = SimpleNamespace(**dict(zip(NAMES, classes_of("color,radii,objects", __name__))))
    shs = scene.inputs["shs"]
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "shs"}
    for degree in (0, 1):
        settings = combined.GaussianRasterizationSettings(**scene.settings._replace(sh_degree=degree)._asdict())
        color, _, image = combined.GaussianRasterizer(settings)(
            **inputs, dc=shs[:, :1], shs=shs[:, 1:], sh_objs=objects)
        assert_close(color, own(scene.with_settings(sh_degree=degree)).color, TOLERANCE, f"colour at degree {degree}")
        assert torch.equal(image, rendered(grouping, scene, sh_objs=objects)[2])
    with pytest.raises(ValueError, match="give either shs or colors_precomp, and not both"):
        rendered(grouping, scene, sh_objs=objects, colors_precomp=torch.zeros(N, 3).double())


def test_features_that_are_not_wanted():
    scene = scene_of("smoe")
    assert not rendered(langsplat, scene, {"include_feature": False})[1].any()
    color, _, objects = rendered(grouping, scene)
    assert torch.equal(color, own(scene).color) and objects.numel() == 0


def test_settings_features_and_results_combine_freely(mode):
    """Each as it is alone: kernel_size, depth_threshold, two kinds of features, results in another order."""
    names = ("normal", "radii", "alpha", "objects", "n_touched", "color", "is_used", "depth")
    combined = SimpleNamespace(**dict(zip(NAMES, classes_of(",".join(names), __name__))))
    scene, normals, objects = scene_of(mode), random_normal((N, 3), 87), random_normal((N, 1, 2), 88)
    weights = random_normal((3, HEIGHT, WIDTH), 89)
    points = torch.zeros(N, 3, dtype=torch.float64, requires_grad=True)
    given = {**FREE, "kernel_size": 0.1, "subpixel_offset": None}
    found = dict(zip(names, rendered(combined, scene, given, means2D=points, normal_precomp=normals, sh_objs=objects)))
    (found["color"] * weights).sum().backward()
    thin = scene.with_settings(low_pass=0.1, antialiasing=True)
    for name, values in (("normal", normals), ("objects", objects)):
        inputs = {key: tensor for key, tensor in scene.inputs.items() if key != "shs"}
        black = thin.settings._replace(bg=torch.zeros(values.shape[-1], dtype=torch.float64))
        expected = rasterize(settings=black, colors_precomp=values.reshape(N, -1), **inputs).color
        assert expected.any()
        assert_close(found[name], expected, TOLERANCE, name)
    color, radii, depth, alpha = rendered(depth_alpha, thin)
    for name, expected in (("color", color), ("depth", depth), ("alpha", alpha)):
        assert_close(found[name], expected, TOLERANCE, name)
    assert torch.equal(found["radii"], radii) and torch.equal(found["is_used"], (radii > 0).int())
    _, absolute = sums_of_absolute_gradients(scene, weights, low_pass=0.1, antialiasing=True)
    splats = rasterize_with_splats(settings=thin.settings, **scene.inputs)[1]
    assert torch.equal(found["n_touched"], splats.contributions(torch.ones_like(color[0])).pixels)
    factors = (splats.depths / 4.0).square().clamp(max=1)
    assert (factors < 1).any()
    assert_close(points.grad[:, 2], absolute.sum(1) * factors, TOLERANCE, "the third column")
    rasterizer = combined.GaussianRasterizer(combined.GaussianRasterizationSettings(
        **{**scene.settings._asdict(), "kernel_size": 0.1}))
    visible = {name: scene.inputs[name] for name in ("means3D", "scales", "rotations")}
    assert torch.equal(rasterizer.visible_filter(**visible) > 0,
                       scaffold.GaussianRasterizer(thin.settings).visible_filter(**visible) > 0)
    without = dict(zip(names, rendered(combined, scene)))
    assert torch.equal(without["color"], own(scene).color) and not without["normal"].any()


def test_cob_gs_renders_the_stage_without_masks(mode):
    scene = scene_of(mode)
    expected = rasterize(settings=scene.settings, outputs=("inverse_depth",), **scene.inputs)
    color, mask, radii, depth = rendered(cob_gs, scene, {"include_mask": False}, mask_precomp=None, mask_signals=None)
    assert torch.equal(color, expected.color) and torch.equal(radii, expected.radii)
    assert torch.equal(depth, expected.inverse_depth) and mask.shape == depth.shape and not mask.any()
    with pytest.raises(NotImplementedError, match="include_mask is set"):
        rendered(cob_gs, scene, {"include_mask": True})


def test_nearest_points_are_none_or_refused():
    scene = scene_of("smoe")
    assert torch.equal(rendered(nearest_points, scene, {"nearest_points": None})[0], own(scene).color)
    with pytest.raises(NotImplementedError, match="nearest_points are set"):
        rendered(nearest_points, scene, {"nearest_points": torch.zeros(N, 4, 3)})


def test_depth_and_what_the_background_has_in_one_image(mode):
    scene = scene_of(mode)
    both = rendered(lucid_dreamer, scene)[2]
    _, _, depth, alpha = rendered(depth_alpha, scene)
    assert (alpha < 1).any() and torch.equal(both, torch.cat([depth, 1 - alpha]))


def test_pixels_and_what_is_near_grows_less(mode):
    scene = scene_of(mode)
    points = torch.zeros(N, 3, dtype=torch.float64, requires_grad=True)
    color, _, pixels = rendered(pixel_gs, scene, {"depth_threshold": 4.0}, means2D=points)
    color.sum().backward()
    plain = torch.zeros(N, 3, dtype=torch.float64, requires_grad=True)
    rendering, splats = rasterize_with_splats(settings=scene.settings, **{**scene.inputs, "means2D": plain})
    rendering.color.sum().backward()
    factors = (splats.depths / 4.0).square().clamp(max=1)
    seen = rendering.radii > 0
    assert (factors[seen] < 1).any() and (factors[seen] == 1).any()
    assert_close(points.grad, plain.grad * factors[:, None], TOLERANCE, "means2D")
    assert torch.equal(pixels[:, 0], splats.contributions(torch.ones_like(color[0]).detach()).pixels.double())


def test_counts_of_pixels(mode):
    scene = scene_of(mode)
    counts, scores, color, radii = rendered(light_gaussian, scene, {"f_count": True})
    assert len(rendered(light_gaussian, scene)) == 2
    seen = own(scene, opacities=scene.inputs["opacities"])
    assert torch.equal(color, seen.color) and torch.equal(radii, seen.radii)
    assert_close(scores, counts * scene.inputs["opacities"][:, 0], 1e-15, "scores")
    chosen = torch.zeros(HEIGHT, WIDTH, dtype=torch.int32)
    chosen[4:9, 6:20] = 1
    inside = rendered(fastgs, scene, {"get_flag": True, "metric_map": chosen.reshape(-1)})[2]
    outside = rendered(fastgs, scene, {"get_flag": True, "metric_map": 1 - chosen})[2]
    assert inside.dtype == torch.int32 and inside.any() and torch.equal(inside + outside, counts)
    assert not rendered(fastgs, scene, {"get_flag": False})[2].any()


@pytest.mark.parametrize("mode", [mode for mode in REMOVABLE_MODES if mode != "smoe"])  # which holds its tails constant
def test_scores_are_what_a_removal_changes(mode):
    """Each Gaussian is left out in turn."""
    scene = random_scene(mode, 6, WIDTH, HEIGHT, seed=1, scale=0.3, opacity=(0.3, 0.8), degree=1)
    scores = torch.zeros(6, 1, dtype=torch.float64, requires_grad=True)
    color = rendered(speedy_splat, scene, scores=scores)[0]
    color.sum().backward()
    for i in range(6):
        kept = torch.arange(6) != i
        changed = own(scene.rows(kept)).color - own(scene).color
        # 1e-9: squares of differences of colours that agree to 1e-15.
        assert scores.grad[i].item() == pytest.approx(changed.square().sum().item(), rel=1e-9, abs=1e-12)
    assert scores.grad.any()
    with torch.no_grad():
        without, _, times = rendered(speedy_splat, scene, scores=scores)
    assert torch.equal(without, color) and (1000 / times.item()) != 0  # the trainer divides by its mean


@pytest.mark.parametrize("count, scale", [(90, 0.4), (20, 0.04)])  # some pixels are full; some have nothing
def test_the_gaussian_of_the_largest_weight_and_where_its_rays_are_deepest(mode, count, scale):
    # An alpha is at most 0.99, so opacities above would make ties.
    scene = random_scene(mode, count, 40, 37, seed=3, degree=1, scale=scale, opacity=(0.3, 0.98))
    scene.inputs["rotations"] = torch.nn.functional.normalize(scene.inputs["rotations"])
    # With a channel for each Gaussian, an image is the map of its weight, divided by what all of a pixel share.
    channels = {**{name: tensor for name, tensor in scene.inputs.items() if name != "shs"},
                "colors_precomp": torch.eye(count, dtype=torch.float64)}
    black = scene.settings._replace(bg=torch.zeros(count, dtype=torch.float64))
    weight, which = rasterize(settings=black, **channels).color.max(0)
    shown = weight > 0
    color, radii, weights, counts, largest = rendered(mini_splatting, scene)
    rendering, splats = rasterize_with_splats(settings=scene.settings, **scene.inputs)
    sums = splats.contributions(torch.ones_like(color[0]))
    assert torch.equal(color, rendering.color) and torch.equal(radii, rendering.radii)
    assert_close(weights, sums.blend_weights, TOLERANCE, "weights")  # CUDA adds a sum in another order each time
    assert torch.equal(counts, sums.pixels)
    assert torch.equal(largest, torch.bincount(which[shown], minlength=count).double())
    assert shown.all() == (count == 90)

    images = mini_splatting.GaussianRasterizer(scene.settings).render_depth(**scene.inputs)
    assert torch.equal(images["render"], color) and torch.equal(images["gidx"][0][shown], which[shown].int())
    assert_close(images["accum_alpha"], 1 - rendered(depth_alpha, scene)[3], TOLERANCE, "the background's share")
    points = images["out_pts"][:, shown].T
    clip = torch.cat([points, torch.ones_like(points[:, :1])], 1) @ scene.settings.projmatrix
    y, x = shown.nonzero().double().unbind(1)
    # 1e-6: that scene's projection is rounded to float32.
    assert_close(((clip[:, 0] / clip[:, 3] + 1) * 40 - 1) / 2, x, 1e-6, "the pixels' x")
    assert_close(((clip[:, 1] / clip[:, 3] + 1) * 37 - 1) / 2, y, 1e-6, "the pixels' y")
    assert_close(clip[:, 3], images["rendered_depth"][0][shown], 1e-6, "view z")

    every = reference.Gaussians(scene.inputs["means3D"], None, None, None, None, scene.inputs["scales"],
                                scene.inputs["rotations"], None)
    inverse = torch.linalg.inv(reference.covariance3D(every, 1.0))[which[shown]]
    offset, along = points - scene.inputs["means3D"][which[shown]], points - scene.settings.campos
    slope = torch.einsum("ni,nij,nj->n", along, inverse, offset)
    curvature = torch.einsum("ni,nij,nj->n", along, inverse, along)
    assert (slope.abs() < 1e-9 * curvature).all(), "a step along the ray leads no deeper"
    within = torch.einsum("ni,nij,nj->n", offset, inverse, offset) < 9
    assert within.any() and torch.equal(images["discriminants"][0][shown] > 0, within)
    for name in ("out_pts", "rendered_depth", "discriminants", "gidx"):
        assert not images[name][:, ~shown].any()
    with pytest.raises(ValueError, match="needs Gaussians with scales and rotations"):
        mini_splatting.GaussianRasterizer(scene.settings).render_depth(torch.zeros(1, 3), None, torch.ones(1, 1))
    fisheye = scene.settings._replace(camera_model="fisheye", distortion=(0.0,) * 4)
    with pytest.raises(NotImplementedError, match="camera_model is 'fisheye'; rays of pixels are offered for"):
        mini_splatting.GaussianRasterizer(fisheye).render_depth(**scene.inputs)


@pytest.mark.parametrize("module, name", [(feature_3dgs, "semantic_feature"), (grouping, "sh_objs")])
@pytest.mark.parametrize("colors", ["sh", "precomp"])
def test_features_of_no_gaussians_are_the_background(module, name, colors):
    inputs = {"sh": {"shs": torch.zeros(0, 4, 3).double()}, "precomp": {"colors_precomp": torch.zeros(0, 3).double()}}
    scene = scene_of("smoe")
    nothing = {key: tensor[:0] for key, tensor in scene.inputs.items() if key not in ("shs", "colors_precomp")}
    nothing[name] = torch.zeros(0, 1, 4).double()
    made = module.GaussianRasterizationSettings(**scene.settings._asdict())
    color, *others = module.GaussianRasterizer(made)(**nothing, **inputs[colors])
    assert torch.equal(color, scene.settings.bg[:, None, None].expand_as(color))
    assert [4, HEIGHT, WIDTH] in [list(image.shape) for image in others]


def test_mini_splatting_without_gaussians_is_the_background():
    scene = scene_of("smoe").rows(torch.zeros(N, dtype=torch.bool))
    color, *scores = rendered(mini_splatting, scene)
    assert torch.equal(color, scene.settings.bg[:, None, None].expand_as(color))
    assert [len(score) for score in scores] == [0, 0, 0, 0]


def test_results_in_any_order_and_the_depth_where_a_pixel_is_half_full(mode):
    """With a channel for each Gaussian, an image is the map of its share of the pixel; these add up front to back."""
    names = ("depth", "color", "median_depth", "alpha", "radii")
    settings, rasterizer, function = classes_of(",".join(names), __name__)
    scene = random_scene(mode, N, WIDTH, HEIGHT, seed=5, degree=1, scale=0.15).requiring_grad(camera=False)
    found = dict(zip(names, rasterizer(raster_settings=scene.settings)(**scene.inputs)))
    for name, expected in zip(("color", "radii", "depth", "alpha"), rendered(depth_alpha, scene)):
        assert torch.equal(found[name], expected)
    channels = {**{name: tensor.detach() for name, tensor in scene.inputs.items() if name != "shs"},
                "colors_precomp": torch.eye(N, dtype=torch.float64)}
    shares = rasterize(settings=scene.settings._replace(bg=torch.zeros(N, dtype=torch.float64)), **channels).color
    z = (channels["means3D"] @ scene.settings.viewmatrix[:3, 2] + scene.settings.viewmatrix[3, 2]).detach()
    order = z.argsort()
    sums = shares[order].cumsum(0)
    clear = ((sums - 0.5).abs() > 1e-9).all(0)  # else rounding decides which Gaussian it is
    expected = torch.where(sums[-1] >= 0.5, z[order][(sums >= 0.5).int().argmax(0)], torch.zeros_like(sums[0]))
    assert clear.float().mean() > 0.99 and (expected > 0).any()
    assert_close(found["median_depth"][0][clear], expected[clear], TOLERANCE, "median_depth")
    found["median_depth"].sum().backward()
    counts = torch.bincount((expected.reshape(-1, 1) == z).int().argmax(1)[expected.reshape(-1) > 0], minlength=N)
    along = scene.settings.viewmatrix[:3, 2].detach()
    assert_close(scene.inputs["means3D"].grad, counts[:, None] * along, TOLERANCE * N, "means3D")
    fisheye = scene.settings._replace(camera_model="fisheye")
    rolls = scene.settings._replace(rolling_shutter="top_to_bottom", principal_point=(WIDTH / 2, HEIGHT / 2),
                                    viewmatrix_end=scene.settings.viewmatrix)
    for other, words in ((fisheye, "camera_model is 'fisheye'; median depths are offered for 'pinhole' alone"),
                         (rolls, "rolling_shutter is 'top_to_bottom'; median depths are offered for 'global' alone")):
        with pytest.raises(NotImplementedError, match=words):
            rasterizer(raster_settings=other)(**scene.inputs)
    for wrong in (("color", "depth"), ("color", "radii", "color"), ("color", "radii", "normals")):
        with pytest.raises(KeyError):
            contract_of(",".join(wrong))
