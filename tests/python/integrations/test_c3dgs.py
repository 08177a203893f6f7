"""What the flavour c3dgs adds: `clamp_color`, and Gaussians that are rows of codebooks. test_inria_flavours.py tests
what its GaussianRasterizer shares with the others."""
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
    one_thread,
    reference_gradients,
)
from devices import on_the_cpu, random_normal
from scenes import gradients, random_scene, spread

import diff_smoe_rasterization
from diff_smoe_rasterization import Rendering, reference
from diff_smoe_rasterization.integrations import c3dgs
from diff_smoe_rasterization.integrations.c3dgs import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    GaussianRasterizerIndexed,
    rasterize_gaussians_indexed,
)

pytestmark = pytest.mark.usefixtures("device")

# A sum of some thousand terms in float64, each with some hundred roundings of 1e-16.
TOLERANCE = 1e-12
HARMONICS, SHAPES = 11, 7  # rows of the codebooks; the last one of each is no Gaussian's
CODEBOOKS = ("shs", "scales", "rotations")


def settings_of(settings, **others):
    return GaussianRasterizationSettings(**{**settings._asdict(), **others})


class Indexed:
    """A scene whose Gaussians share the rows of codebooks, and two ways to render it."""

    def __init__(self, mode, count=60, seed=31, dtype=torch.float64, **options):
        scene = random_scene(mode, count, 45, 30, seed=seed, dtype=dtype, **options)
        inputs = dict(scene.inputs)
        for name in CODEBOOKS:
            inputs[name] = inputs[name][:HARMONICS if name == "shs" else SHAPES].clone()
        generator = torch.Generator(device="cpu").manual_seed(seed)
        factors = torch.rand(count, 1, generator=generator, device="cpu") + 0.5
        inputs["scale_factors"] = factors.to(inputs["scales"])
        self.scene = scene._replace(inputs=inputs)
        self.sh_indices, self.g_indices = (
            torch.randint(rows - 1, (count,), generator=generator, device="cpu").to(inputs["means3D"].device)
            for rows in (HARMONICS, SHAPES))

    def indices(self):
        return {"sh_indices": self.sh_indices, "g_indices": self.g_indices}

    def render(self, settings, outputs, **inputs):
        color, radii = GaussianRasterizerIndexed(raster_settings=settings_of(settings))(**self.indices(), **inputs)
        return Rendering(color, radii)

    def reference(self, settings, outputs, **inputs):
        """Every Gaussian with rows of its own, by torch's own indexing."""
        factors, sh, g = inputs.pop("scale_factors"), self.sh_indices.cpu(), self.g_indices.cpu()
        return reference.rasterize(settings=settings, **{
            **inputs, "shs": inputs["shs"][sh], "scales": factors * inputs["scales"][g],
            "rotations": inputs["rotations"][g]})

    def expected(self):
        with one_thread(), on_the_cpu():
            return gradients(self.reference, self.scene.to("cpu"))


@pytest.fixture
def indexed(device):
    return Indexed(None, 40)


def call(indexed, **others):
    return GaussianRasterizerIndexed(settings_of(indexed.scene.settings))(
        **{**indexed.scene.inputs, **indexed.indices(), **others})


def test_names_and_their_order():
    base = ["image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
            "sh_degree", "campos", "prefiltered", "debug", "clamp_color"]
    assert list(GaussianRasterizationSettings._fields[:13]) == base
    assert GaussianRasterizationSettings(*range(12), False).clamp_color is False
    core = diff_smoe_rasterization.GaussianRasterizationSettings
    assert GaussianRasterizationSettings._field_defaults == core._field_defaults
    assert set(GaussianRasterizationSettings._fields) == set(core._fields)
    assert list(inspect.signature(GaussianRasterizerIndexed.forward).parameters)[1:] == [
        "means3D", "means2D", "opacities", "sh_indices", "g_indices", "shs", "colors_precomp", "scales",
        "scale_factors", "rotations", "cov3D_precomp"]
    assert list(inspect.signature(rasterize_gaussians_indexed).parameters) == [
        "means3D", "means2D", "sh", "sh_indices", "g_indices", "colors_precomp", "opacities", "scales",
        "scale_factors", "rotations", "cov3Ds_precomp", "raster_settings"]
    assert set(c3dgs.__all__) == {"GaussianRasterizationSettings", "GaussianRasterizer", "GaussianRasterizerIndexed",
                                  "rasterize_gaussians", "rasterize_gaussians_indexed"}
    assert issubclass(GaussianRasterizerIndexed, torch.nn.Module)


def test_settings_survive_pickling():
    settings = GaussianRasterizationSettings(*range(12), clamp_color=False, blend_mode="smoe")
    assert pickle.loads(pickle.dumps(settings)) == settings


def test_two_results_by_name_and_by_position(indexed):
    i, sh, g = indexed.scene.inputs, indexed.sh_indices, indexed.g_indices
    settings = settings_of(indexed.scene.settings)
    named = call(indexed)
    module = GaussianRasterizerIndexed(settings)(i["means3D"], i["means2D"], i["opacities"], sh, g, i["shs"], None,
                                                 i["scales"], i["scale_factors"], i["rotations"], None)
    function = rasterize_gaussians_indexed(i["means3D"], i["means2D"], i["shs"], sh, g, None, i["opacities"],
                                           i["scales"], i["scale_factors"], i["rotations"], None, settings)
    for results in (named, module, function):
        assert type(results) is tuple and len(results) == 2
        color, radii = results
        assert color.shape == (3, 30, 45) and radii.shape == (40,) and radii.dtype == torch.int32
        assert torch.equal(color, named[0]) and torch.equal(radii, named[1])


def test_images_radii_and_gradients_are_the_references(mode):
    """Codebooks get the sum over their Gaussians."""
    indexed = Indexed(mode)
    rendering, actual = gradients(indexed.render, indexed.scene)
    expected_rendering, expected = indexed.expected()
    assert_is_the_references(rendering, actual, expected_rendering, expected, TOLERANCE)
    for name in CODEBOOKS:
        assert actual[name].shape == indexed.scene.inputs[name].shape
        assert actual[name][:-1].flatten(1).any(1).all() and not actual[name][-1].any()
    assert actual["scale_factors"].shape == (60, 1)


def test_float32_with_the_kernels_of_degree_3(mode):
    """An image is that of the gathered rows, and a codebook's gradient the sum of theirs."""
    indexed = Indexed(mode, 300, degree=3, dtype=torch.float32)
    rendering, actual = gradients(indexed.render, indexed.scene, camera=False)
    i, sh, g = indexed.scene.inputs, indexed.sh_indices, indexed.g_indices
    gathered = {**i, "shs": i["shs"][sh], "scales": i["scale_factors"] * i["scales"][g], "rotations": i["rotations"][g]}
    del gathered["scale_factors"]
    expected, rows = gradients(diff_smoe_rasterization.rasterize, indexed.scene._replace(inputs=gathered), camera=False)
    assert rendering.color.dtype == torch.float32 and torch.equal(rendering.color, expected.color)
    rows["scales"] = i["scale_factors"].double() * rows["scales"]
    for name, indices in (("shs", sh), ("scales", g), ("rotations", g)):
        total = torch.zeros(i[name].shape, dtype=torch.float64).index_add(0, indices, rows[name].double())
        # Roundings of 6e-8 of some dozen rows that cancel in part, and on a GPU of the sum over the pixels.
        assert_close(actual[name], total, 1e-5, name)


def test_scale_factors_multiply_beside_the_scale_modifier(mode):
    """And without them a Gaussian has the scales of its row."""
    indexed = Indexed(mode)
    indexed.scene = indexed.scene.with_settings(scale_modifier=0.6)
    rendering, actual = gradients(indexed.render, indexed.scene)
    expected_rendering, expected = indexed.expected()
    assert_close(rendering.color, expected_rendering.color, TOLERANCE, "color")
    assert_all_close(actual, expected, TOLERANCE)
    ones = torch.ones_like(indexed.scene.inputs["scale_factors"])
    for absent in (None, torch.Tensor([]).cpu()):
        assert torch.equal(call(indexed, scale_factors=absent)[0], call(indexed, scale_factors=ones[:, 0])[0])
    assert (call(indexed, scale_factors=ones)[0] - rendering.color).abs().max() > 0.01


def test_quaternions_are_used_as_given():
    indexed = Indexed("smoe")
    longer = indexed.scene.with_inputs(rotations=1.2 * indexed.scene.inputs["rotations"])
    assert (call(indexed, **longer.inputs)[0] - call(indexed)[0]).abs().max() > 0.01
    indexed.scene = longer
    assert_close(call(indexed)[0], indexed.expected()[0].color, TOLERANCE, "color")


def test_an_opacity_may_exceed_one(mode):
    indexed = Indexed(mode, opacity=(1.5, 6.0))
    rendering, actual = gradients(indexed.render, indexed.scene)
    expected_rendering, expected = indexed.expected()
    assert_close(rendering.color, expected_rendering.color, TOLERANCE, "color")
    assert_all_close(actual, expected, TOLERANCE)


def test_inputs_need_not_be_contiguous(mode):
    indexed = Indexed(mode)
    expected, expected_gradients = gradients(indexed.render, indexed.scene, camera=False)
    leaves = {name: spread(tensor).requires_grad_(True) for name, tensor in indexed.scene.inputs.items()}
    indexed.sh_indices, indexed.g_indices = spread(indexed.sh_indices), spread(indexed.g_indices)
    assert not any(tensor.is_contiguous() for tensor in [*leaves.values(), *indexed.indices().values()])
    color = indexed.render(indexed.scene.settings, (), **leaves).color
    assert torch.equal(color, expected.color)
    values = torch.autograd.grad(color, list(leaves.values()), random_normal(color.shape, 1).to(color))
    assert_same_gradients(dict(zip(leaves, values)), expected_gradients)


def test_empty_cpu_tensors_are_absent_inputs(mode):
    """As None. The indices of an absent codebook are not read."""
    indexed = Indexed(mode)
    empty = torch.Tensor([]).cpu()
    color = call(indexed)[0]
    assert torch.equal(call(indexed, colors_precomp=empty, cov3D_precomp=empty)[0], color)
    scene = random_scene(mode, 60, 45, 30, seed=32, channels=3, covariance="cov3D")
    expected = reference_gradients(scene)[0].color
    for absent in (None, empty):
        given = GaussianRasterizerIndexed(settings_of(scene.settings))(
            **scene.inputs, sh_indices=absent, g_indices=absent, shs=absent, scales=absent, scale_factors=absent,
            rotations=absent)
        assert_close(given[0], expected, TOLERANCE, "color")


def test_no_gaussians_leave_the_background_and_codebooks_without_gradient(mode):
    indexed = Indexed(mode)
    codebooks = {name: indexed.scene.inputs[name].clone().requires_grad_(True) for name in CODEBOOKS}
    nothing = {name: tensor[:0] for name, tensor in {**indexed.scene.inputs, **indexed.indices()}.items()}
    color, radii = call(indexed, **{**nothing, **codebooks})
    assert torch.equal(color, indexed.scene.settings.bg[:, None, None].expand(3, 30, 45)) and radii.shape == (0,)
    for name, values in zip(codebooks, torch.autograd.grad(color.sum(), list(codebooks.values()), allow_unused=True)):
        assert values is None or values.shape == codebooks[name].shape and not values.any()


def test_mark_visible_is_the_near_plane():
    scene = random_scene("smoe", 300)
    for rasterizer in (GaussianRasterizer, GaussianRasterizerIndexed):
        visible = rasterizer(settings_of(scene.settings)).markVisible(scene.inputs["means3D"])
        depths = scene.inputs["means3D"] @ scene.settings.viewmatrix[:3, 2] + scene.settings.viewmatrix[3, 2]
        assert visible.any() and not visible.all() and torch.equal(visible, depths > 0.2)


def test_without_clamp_color_images_reach_below_zero(mode):
    """And the harmonics of a colour below zero get their gradient."""
    indexed = Indexed(mode, degree=3, bg=torch.zeros(3))
    indexed.scene.inputs["shs"][:, 0] -= 1
    clamped, clamped_gradients = gradients(indexed.render, indexed.scene)
    indexed.scene = indexed.scene.with_settings(clamp_color=False)
    rendering, actual = gradients(indexed.render, indexed.scene)
    expected_rendering, expected = indexed.expected()
    assert clamped.color.min() >= 0 and rendering.color.min() < -0.1
    assert_close(rendering.color, expected_rendering.color, TOLERANCE, "color")
    assert_all_close(actual, expected, TOLERANCE)
    assert (clamped_gradients["shs"] - actual["shs"]).norm() > 0.01 * actual["shs"].norm()


def test_sensitivity_as_the_trainer_measures_it(mode):
    """Gradients of the sum of an image, unclamped, by harmonics and by covariances that a factor has multiplied."""
    def sensitivity(rasterizer, settings, inputs):
        leaves = {name: inputs[name].clone().requires_grad_(True) for name in ("shs", "cov3D_precomp")}
        image = rasterizer(settings, {**inputs, **leaves, "cov3D_precomp": leaves["cov3D_precomp"] * 1.3})
        return dict(zip(leaves, torch.autograd.grad(image.sum(), list(leaves.values()))))

    scene = random_scene(mode, 60, 45, 30, seed=33, degree=3, covariance="cov3D", bg=torch.zeros(3))
    scene.inputs["shs"][:, 0] -= 1
    unclamped = scene.with_settings(clamp_color=False)
    with one_thread(), on_the_cpu():
        cpu = unclamped.to("cpu")
        expected = sensitivity(lambda settings, inputs: reference.rasterize(settings=settings, **inputs).color,
                               cpu.settings, cpu.inputs)
    ours = [sensitivity(lambda settings, inputs: GaussianRasterizer(settings_of(settings))(**inputs)[0],
                        some.settings, some.inputs) for some in (unclamped, scene)]
    assert_all_close(ours[0], expected, TOLERANCE)
    # A Gaussian that is seen counts, whatever its colour; with the clamp those of dark colours did not.
    counted = [(values["shs"][:, 0] != 0).sum() for values in ours]
    assert counted[0] > counted[1] > 0


def wrong(message, error=ValueError, **inputs):
    return pytest.param(error, message, inputs, id="-".join(inputs) + "-" + error.__name__ + str(len(message)))


@pytest.mark.parametrize("error, message, inputs", [
    wrong(r"sh_indices is int32; it must be int64", TypeError, sh_indices=lambda i: i.sh_indices.int()),
    wrong(r"g_indices is float32; it must be int64", TypeError, g_indices=lambda i: i.g_indices.float()),
    wrong(r"sh_indices has shape \[39\]; it must be \[40\]", sh_indices=lambda i: i.sh_indices[1:]),
    wrong(r"g_indices has shape \[40, 1\]; it must be \[40\]", g_indices=lambda i: i.g_indices[:, None]),
    wrong(r"sh_indices is of type NoneType", TypeError, sh_indices=lambda i: None),
    wrong(r"g_indices is of type list", TypeError, g_indices=lambda i: i.g_indices.tolist()),
    wrong(r"sh_indices\[7\] is 11; it must be at least 0 and below 11, the number of rows of shs",
          sh_indices=lambda i: changed(i.sh_indices, 7, HARMONICS)),
    wrong(r"g_indices\[5\] is -1; it must be at least 0 and below 7, the number of rows of scales",
          g_indices=lambda i: changed(i.g_indices, 5, -1)),
    wrong(r"g_indices\[\d+\] is 5; it must be at least 0 and below 5, the number of rows of rotations",
          rotations=lambda i: i.scene.inputs["rotations"][:5], g_indices=lambda i: i.g_indices.clamp(max=5)),
    wrong(r"sh_indices\[0\] is \d+; it must be at least 0 and below 0", shs=lambda i: i.scene.inputs["shs"][:0]),
    wrong(r"shs has shape \[11, 27\]; it must be \[S, K, 3\]", shs=lambda i: i.scene.inputs["shs"].flatten(1)),
    wrong(r"scales has shape \[7\]; it must be \[G, 3\]", scales=lambda i: i.scene.inputs["scales"][:, 0]),
    wrong(r"scale_factors has shape \[39, 1\]; it must be \[40, 1\] or \[40\]",
          scale_factors=lambda i: i.scene.inputs["scale_factors"][1:]),
    wrong(r"scale_factors is float32; it must be float64, as scales is", TypeError,
          scale_factors=lambda i: i.scene.inputs["scale_factors"].float()),
])
def test_what_does_not_fit_is_named(indexed, error, message, inputs):
    with pytest.raises(error, match="rasterize_gaussians_indexed: " + message):
        call(indexed, **{name: value(indexed) for name, value in inputs.items()})


def changed(indices, place, value):
    indices = indices.clone()
    indices[place] = value
    return indices


@pytest.mark.parametrize("others", [{"shs": None}, {"colors_precomp": True}, {"rotations": None},
                                    {"cov3D_precomp": True}, {"scales": None, "rotations": None}])
def test_both_or_neither_of_two_ways_is_an_error(indexed, others):
    given = {"colors_precomp": torch.ones(40, 3, dtype=torch.float64),
             "cov3D_precomp": torch.ones(40, 6, dtype=torch.float64)}
    with pytest.raises(ValueError, match="rasterize"):
        call(indexed, **{name: given[name] if value else None for name, value in others.items()})


def test_indices_that_were_found_to_fit_are_looked_at_again_once_something_changed(indexed):
    for _ in range(2):
        call(indexed)
    with pytest.raises(ValueError, match=r"sh_indices\[\d+\] is \d+; .* below 3, "):
        call(indexed, shs=indexed.scene.inputs["shs"][:3])
    call(indexed)
    indexed.g_indices[4] = SHAPES
    for _ in range(2):
        with pytest.raises(ValueError, match=r"g_indices\[4\] is 7"):
            call(indexed)
    indexed.g_indices[4] = 0
    call(indexed)


def test_no_index_tensor_is_kept_alive(indexed):
    call(indexed)
    count = len(c3dgs._fitting)
    indexed.sh_indices = indexed.sh_indices.clone()
    call(indexed)
    assert len(c3dgs._fitting) == count
    for _ in range(3):
        indexed.sh_indices[0] = 1
        call(indexed)
    assert len(c3dgs._fitting) == count
    with torch.inference_mode():  # its tensors do not say when they change, so they are looked at each time
        indexed.sh_indices = indexed.sh_indices.clone()
        call(indexed)
        indexed.sh_indices[3] = HARMONICS
        with pytest.raises(ValueError, match=r"sh_indices\[3\] is 11"):
            call(indexed)


def test_codebook_gradients_are_equal_bit_for_bit_where_they_should_be(mode):
    """Some hundred Gaussians a row, more than torch adds up in one block; on a GPU under `deterministic`."""
    indexed = Indexed(mode, 5000, dtype=torch.float32, scale=0.03, deterministic=True)
    (first, expected), (second, actual) = (gradients(indexed.render, indexed.scene) for _ in range(2))
    assert torch.equal(first.color, second.color)
    assert all(expected[name].any() for name in CODEBOOKS)
    for name, values in expected.items():
        assert torch.equal(actual[name], values), name


def test_a_training_step_does_not_wait_for_the_gpu(mode, device):
    if device.type != "cuda":
        pytest.skip("only on a GPU is there something to wait for")
    indexed = Indexed(mode, 5000, dtype=torch.float32, scale=0.03, degree=3)
    leaves = indexed.scene.requiring_grad(camera=False)

    def step():
        color = indexed.render(leaves.settings, (), **leaves.inputs).color
        return torch.autograd.grad(color.sum(), [leaves.inputs[name] for name in CODEBOOKS])

    expected = [step() for _ in range(3)][-1]
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        results = step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for actual, values in zip(results, expected):
        assert values.any()
        assert_close(actual, values, 1e-4, "codebook")  # float32 sums of some thousand terms, in any order
