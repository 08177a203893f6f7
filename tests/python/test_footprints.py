"""The two halves of a rendering: together they are `rasterize`, and in between footprints can be handled."""
from __future__ import annotations

import pytest
import torch
from devices import random_normal
from scenes import (
    assert_not_empty,
    camera_settings,
    gradients,
    random_scene,
    random_weights,
    with_gates,
    without_tails,
)

from diff_smoe_rasterization import Footprints, blend_footprints, project_gaussians, rasterize
from diff_smoe_rasterization.arguments import op_arguments
from diff_smoe_rasterization.footprints import camera_tensors, image_numbers
from diff_smoe_rasterization.settings import OUTPUTS
from dsmoe.distributed.rows import ViewRows

pytestmark = pytest.mark.usefixtures("device")


def in_halves(*, settings, outputs=(), **inputs):
    return blend_footprints(project_gaussians(settings=settings, outputs=outputs, **inputs), settings, outputs)


def assert_equal(actual, expected):
    for name, value in expected.items():
        assert torch.equal(actual[name], value), name


@with_gates
@pytest.mark.parametrize("case", [
    dict(degree=3, split_dc=True), dict(degree=1, antialiasing=True, deterministic=True),
    dict(channels=5, covariance="cov3D")])
def test_the_halves_give_the_bits_of_the_whole(mode, case):
    """float32: the type that trains. deterministic has no effect on the CPU, whose gradients always are."""
    case = {**case, "deterministic": True}
    scene = random_scene(mode, dtype=torch.float32, **case)
    expected, expected_gradients = gradients(rasterize, scene, OUTPUTS)
    actual, actual_gradients = gradients(in_halves, scene, OUTPUTS)
    assert_not_empty(expected, scene.settings)
    assert_equal(actual._asdict(), expected._asdict())
    assert_equal(actual_gradients, expected_gradients)


@pytest.mark.parametrize("blend_mode", ["smoe", "smoe_eq7"])
@pytest.mark.parametrize("as_tensor", [False, True])
def test_whether_footprints_depend_on_the_gate(blend_mode, as_tensor):
    """In `smoe_eq7` alone: so there both halves must be given the same, as `project_gaussians` says."""
    scene = random_scene("smoe_eq7", opacity=(0.05, 0.9))
    gates = [torch.tensor(gate, dtype=torch.float64) if as_tensor else gate for gate in (0.01, 0.9)]
    first, second = (scene.settings._replace(blend_mode=blend_mode, background_gate=gate) for gate in gates)
    expected = rasterize(settings=second, **scene.inputs).color
    assert torch.equal(in_halves(settings=second, **scene.inputs).color, expected)
    mixed = blend_footprints(project_gaussians(settings=first, **scene.inputs), second).color
    assert torch.equal(mixed, expected) == (blend_mode == "smoe")
    assert "smoe_eq7" in project_gaussians.__doc__ and "smoe_eq7" in blend_footprints.__doc__


def test_the_halves_of_no_gaussians_are_the_background():
    scene = random_scene("smoe", 10).rows(slice(0, 0)).requiring_grad()
    rendering = in_halves(settings=scene.settings, **scene.inputs)
    rendering.color.sum().backward()
    assert torch.equal(rendering.color, scene.settings.bg[:, None, None].expand_as(rendering.color))
    assert scene.inputs["means3D"].grad.shape == (0, 3)


def test_only_visible_footprints_count():
    scene = random_scene("smoe", deterministic=True).requiring_grad()
    everything = project_gaussians(settings=scene.settings, **scene.inputs)
    seen = everything.visible()
    assert 5 < len(seen.radii) < len(everything.radii)
    expected, actual = (blend_footprints(each, scene.settings) for each in (everything, seen))
    assert torch.equal(actual.color, expected.color)
    leaves = list(scene.leaves().values())
    weights = random_weights(expected)[1]
    for first, second in zip(*(torch.autograd.grad(each.color, leaves, weights, allow_unused=True, retain_graph=True)
                               for each in (expected, actual))):
        assert torch.equal(first, second)


def test_footprints_of_shards_are_those_of_the_whole():
    scene = random_scene("alpha")
    parts = [project_gaussians(settings=scene.settings, **scene.rows(rows).inputs)
             for rows in (slice(0, 50), slice(50, 51), slice(51, None))]
    joined, expected = Footprints.joined(parts), rasterize(settings=scene.settings, **scene.inputs)
    actual = blend_footprints(joined, scene.settings)
    assert torch.equal(actual.color, expected.color) and torch.equal(actual.radii, expected.radii)


@pytest.mark.parametrize("case", [dict(degree=3, split_dc=True), dict(degree=3), dict(degree=1, split_dc=True),
                                  dict(degree=0), dict(degree=2, antialiasing=True)], ids=str)
def test_rows_of_a_batch_are_the_footprints_of_its_views(mode, case):
    """And their gradients are sums over the views. There are more views than the ops take at once."""
    scene = random_scene(mode, 300, dtype=torch.float32, **case).to(torch.float32)
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "means2D"}
    broken = next(name for name in ("dc", "shs") if name in inputs)
    inputs[broken][30] = float("nan")  # its row has radius 0
    cameras = [camera_settings(20 + view, 19, (0.4, 0.1 * view, -4.0), dtype=torch.float32, degree=case["degree"])
               for view in range(18)]
    settings = [scene.settings._replace(**{name: getattr(each, name) for name in (
        "image_width", "image_height", "tanfovx", "tanfovy", "viewmatrix", "projmatrix", "campos")})
        for each in cameras]
    rows = ViewRows(settings, **inputs)
    counts = rows.counts.tolist()
    order = list(reversed(range(len(settings))))
    gates, features = rows.project(counts, order)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}
    places = [torch.zeros(300, 3, dtype=torch.float32, requires_grad=True) for _ in settings]
    records, loss, begin = {}, 0.0, 0
    for view in order:
        footprints = project_gaussians(settings=settings[view], means2D=places[view], **leaves)
        seen = (rows.radii[view] != 0).nonzero().squeeze(1)
        assert torch.equal(rows.radii[view].clamp(min=0), footprints.radii) and 5 < len(seen) == counts[view] < 300
        part = slice(begin, begin + counts[view])
        begin = part.stop
        there = footprints.radii[seen] > 0
        assert torch.equal(features[part, 3].contiguous().view(torch.int32), footprints.radii[seen])
        for actual, expected in ((gates, footprints.gates), (features[:, :3], footprints.features)):
            torch.testing.assert_close(actual[part][there], expected[seen][there].detach(), rtol=1e-5, atol=1e-5)
        records[view] = random_normal((counts[view], 9), view, torch.float32)
        of_gates, of_features = records[view][:, :6] * there[:, None], records[view][:, 6:] * there[:, None]
        loss = loss + (footprints.gates[seen][:, :6] * of_gates)[there].sum()
        loss = loss + (footprints.features[seen] * of_features)[there].sum()
    loss.backward()
    gradients, means2D = rows.backward([records[view] for view in range(len(settings))])
    assert set(gradients) == set(inputs)
    for name, gradient in gradients.items():
        # Sums of 18 views in another order of operations.
        expected = leaves[name].grad
        torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))
    for view, (actual, place) in enumerate(zip(means2D, places)):
        there = rows.radii[view] > 0
        expected = place.grad[there]
        torch.testing.assert_close(actual[there], expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def test_views_of_a_batch_without_rows_or_gaussians():
    scene = random_scene("smoe", 140, degree=1, dtype=torch.float32)
    for inputs in (scene.inputs, scene.rows(slice(0, 0)).inputs):
        inputs = {name: tensor for name, tensor in inputs.items() if name != "means2D"}
        behind = scene.settings.viewmatrix.clone()
        behind[3, 2] = -50
        rows = ViewRows([scene.settings._replace(viewmatrix=behind)] * 2, **inputs)
        assert rows.counts.tolist() == [0, 0]
        gates, features = rows.project([0, 0], [0, 1])
        assert gates.shape == (0, 8) and features.shape == (0, 4)
        gradients, _ = rows.backward([gates.new_zeros(0, 9)] * 2)
        assert set(gradients) == set(inputs)
        for name, gradient in gradients.items():
            assert gradient.shape == inputs[name].shape and not gradient.any()


@pytest.mark.parametrize("change, message", [
    (dict(images=[1.0]), "cameras and images have lengths 4 and 1; they must have 4 tensors and 21 numbers a view"),
    (dict(covariance="cov3D"), "cov3D_precomp is given; rows are of scales and rotations"),
    (dict(channels=3), "colors_precomp is given; rows are of shs or dc"),
    (dict(channels=5), "num_channels is 5; rows have 3"),
    (dict(dtype=torch.float64), "means3D is float64; it must be float32"),
    (dict(depth=True), "config asks for depths; rows have colours alone")])
def test_rows_refuse_what_they_do_not_hold(change, message):
    given = {name: change[name] for name in ("covariance", "channels") if name in change}
    scene = random_scene("smoe", 20, **{"dtype": torch.float32, **given, **{
        name: change[name] for name in change if name == "dtype"}})
    arguments, options = op_arguments("project_gaussians", scene.settings, ("depth",) if "depth" in change else (),
                                      **scene.inputs)
    camera, images = camera_tensors(scene.settings), change.get("images", image_numbers(scene.settings))
    with pytest.raises((ValueError, TypeError), match=f"count_rows: {message}"):
        torch.ops.diff_smoe_rasterization.count_rows(*arguments, *options, True, camera, images)


def test_of_equal_depths_the_first_is_in_front():
    scene = random_scene("alpha", 1, scale=0.5, opacity=(0.9, 0.9))
    twice = scene.with_inputs(**{name: value.repeat(2, *[1] * (value.dim() - 1))
                                 for name, value in scene.inputs.items()})
    twice.inputs["means3D"][:] = 0
    footprints = project_gaussians(settings=twice.settings, **twice.inputs)
    red, blue = (footprints.features.new_tensor(color) for color in ([1, 0, 0], [0, 0, 1]))
    colored = footprints._replace(features=torch.stack([red, blue]))
    center = blend_footprints(colored, twice.settings).color[:, 18, 25]
    assert center[0] > 0.8 and center[2] < 0.3  # 0.9, and what is left of 1


@pytest.mark.parametrize("depths", [(-4.0, 2.0), (-2.0, -1.0), (-0.5, 0.0)])
def test_footprints_of_negative_depths_are_in_front(depths):
    """Depths that a caller makes may be negative. Red is nearer, and the second footprint."""
    scene = random_scene("alpha", 1, scale=0.5, opacity=(0.9, 0.9))
    scene.inputs["means3D"][:] = 0
    footprint = project_gaussians(settings=scene.settings, **scene.inputs)
    twice = Footprints.joined([footprint, footprint])
    gates = twice.gates.clone()
    gates[:, 7] = gates.new_tensor(depths[::-1])
    green, red = (twice.features.new_tensor(color) for color in ([0, 1, 0], [1, 0, 0]))
    center = blend_footprints(Footprints(gates, torch.stack([green, red]), twice.radii),
                              scene.settings).color[:, 18, 25]
    assert center[0] > 0.8 and center[1] < 0.3  # 0.9, and what is left of 1


def test_gradients_by_footprints_are_those_of_finite_differences(mode):
    """In double, with steps of 1e-6: 1e-7 of rounding, and 1e-5 of the largest gradient for what curves."""
    scene = without_tails(random_scene(mode, 40))
    footprints = project_gaussians(settings=scene.settings, outputs=("depth",), **scene.inputs).visible()
    weights = random_weights(blend_footprints(footprints, scene.settings, ("depth",)), ("depth",))[1]

    def loss(gates, features):
        rendering = blend_footprints(Footprints(gates, features, footprints.radii), scene.settings, ("depth",))
        return (rendering.color * weights[0]).sum() + (rendering.depth * weights[1]).sum()

    leaves = [footprints.gates.clone().requires_grad_(), footprints.features.clone().requires_grad_()]
    actual = torch.autograd.grad(loss(*leaves), leaves)
    assert not actual[0][:, 6:].any()  # the reach and the depth only choose
    for which, columns in ((0, 6), (1, footprints.features.shape[1])):
        for column in range(columns):
            row = actual[which][:, column].abs().argmax()
            values = []
            for step in (1e-6, -1e-6):
                moved = [leaf.detach().clone() for leaf in leaves]
                moved[which][row, column] += step
                values.append(loss(*moved))
            expected = (values[0] - values[1]) / 2e-6
            assert abs(actual[which][row, column] - expected) < 1e-5 * actual[which].abs().max() + 1e-7, (which, column)


def test_a_gradient_by_depths_reaches_the_means():
    scene = random_scene("alpha").requiring_grad()
    footprints = project_gaussians(settings=scene.settings, **scene.inputs)
    seen = footprints.radii > 0
    footprints.depths[seen].sum().backward()
    expected = torch.where(seen[:, None], scene.settings.viewmatrix[:3, 2], torch.zeros(3).to(scene.settings.bg))
    torch.testing.assert_close(scene.inputs["means3D"].grad, expected.detach())


@pytest.mark.parametrize("options", [
    dict(blend_mode="alpha", antialiasing=True), dict(blend_mode="smoe", background_gate=0.5),
    dict(blend_mode="smoe", background_gate=torch.tensor(0.5, dtype=torch.float64)), dict(alpha_min=0.02),
    dict(blend_mode="smoe_eq7", background_gate=0.5),
    dict(blend_mode="smoe_eq7", background_gate=torch.tensor(0.5, dtype=torch.float64), alpha_min=0.001),
    dict(blend_mode="smoe_tn")])
def test_a_gradient_by_the_reach_reaches_what_the_opacity_is_made_of(options):
    """In double, with steps of 1e-6, against finite differences of what the projection returns."""
    scene = random_scene("smoe", 60, opacity=(0.001, 0.9), scale=0.1)
    options = {name: value.to(scene.inputs["means3D"]) if torch.is_tensor(value) else value
               for name, value in options.items()}
    scene = scene.with_settings(**options).requiring_grad()
    weights = torch.linspace(0.5, 1.5, 60).to(scene.inputs["means3D"])

    def loss(opacities):
        footprints = project_gaussians(settings=scene.settings, **{**scene.inputs, "opacities": opacities})
        return (weights * footprints.gates[:, 6]).masked_fill(footprints.radii <= 0, 0)

    opacities = scene.inputs["opacities"]
    actual, = torch.autograd.grad(loss(opacities).sum(), opacities)
    with torch.no_grad():
        expected = (loss(opacities + 1e-6) - loss(opacities - 1e-6)) / 2e-6
    moving = expected.abs() > 1e-9
    assert moving.any() == (options.get("blend_mode") != "smoe_tn") and (~moving).any()
    # An opacity within the step of where another rule begins may differ: none is here.
    torch.testing.assert_close(actual.reshape(-1), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("change, error, text", [
    (dict(features=slice(0, 2)), ValueError, r"features has shape \[120, 2\]; it must be \[120, 3\]"),
    (dict(features=[0, 1, 2, 2]), ValueError, r"features has shape \[120, 4\]; it must be \[120, 3\]"),
    (dict(radii=torch.float32), TypeError, "radii is float32"),
    (dict(gates=slice(0, 7)), ValueError, r"gates has shape \[120, 7\]; it must be \[N, 8\]")])
def test_footprints_that_do_not_fit_are_refused(change, error, text):
    scene = random_scene("alpha")
    footprints = project_gaussians(settings=scene.settings, **scene.inputs)
    (name, to), = change.items()
    value = getattr(footprints, name)
    footprints = footprints._replace(**{name: value.to(to) if isinstance(to, torch.dtype) else value[:, to]})
    with pytest.raises(error, match=text):
        blend_footprints(footprints, scene.settings)


def test_depth_needs_footprints_that_have_it():
    scene = random_scene("alpha")
    with pytest.raises(ValueError, match=r"\[120, 3\]; it must be \[120, 4\]; give project_gaussians and "
                                         "blend_footprints the same outputs and background"):
        blend_footprints(project_gaussians(settings=scene.settings, **scene.inputs), scene.settings, ("depth",))
