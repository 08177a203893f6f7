"""Wrong shapes, types and combinations: an exception that names the argument, what it is and what it must be."""
from __future__ import annotations

import re

import pytest
import torch
from scenes import camera_settings, gradients, random_scene

from diff_smoe_rasterization import (
    DirectRendering,
    GaussianRasterizer,
    blend_footprints,
    fused_ssim,
    project_gaussians,
    rasterize,
    rasterize_with_splats,
    visible_radii,
)
from diff_smoe_rasterization.autograd import OPTIONS
from diff_smoe_rasterization.gaussians import activate, add_view
from diff_smoe_rasterization.losses import l1_ssim_loss
from diff_smoe_rasterization.settings import FEATURE_OUTPUTS

pytestmark = pytest.mark.usefixtures("device")

COUNT = 30


def scene_of(mode="alpha", **options):
    return random_scene(mode, COUNT, 20, 18, degree=1, dtype=torch.float32, **options)


def render(scene, **more):
    return rasterize(settings=scene.settings, **scene.inputs, **more)


def shape_pattern(*sizes):
    """Matches a shape however it is bracketed."""
    return r"\b" + r"\D{1,3}".join(str(size) for size in sizes) + r"\b"


SHAPES = [
    # argument, options of the scene, wrong shape, a part of the right shape
    ("means3D", {}, (COUNT, 2), (3,)),
    ("means3D", {}, (COUNT * 3,), (3,)),
    ("means2D", {}, (COUNT, 2), (COUNT, 3)),
    ("means2D", {}, (COUNT - 1, 3), (COUNT, 3)),
    ("means2D_abs", {}, (COUNT, 3), (COUNT, 2)),
    ("opacities", {}, (COUNT, 2), (COUNT, 1)),
    ("opacities", {}, (COUNT - 1, 1), (COUNT, 1)),
    ("opacities", {}, (COUNT + 1,), (COUNT, 1)),
    ("shs", {}, (COUNT, 4, 4), (3,)),
    ("shs", {}, (COUNT, 3, 3), (4,)),
    ("shs", {}, (COUNT - 1, 4, 3), (COUNT,)),
    ("shs", {}, (COUNT, 12), (3,)),
    ("shs", dict(split_dc=True), (COUNT, 2, 3), (3,)),
    ("dc", dict(split_dc=True), (COUNT, 2, 3), (COUNT, 1, 3)),
    ("dc", dict(split_dc=True), (COUNT - 1, 1, 3), (COUNT, 1, 3)),
    ("colors_precomp", dict(channels=3), (COUNT - 1, 3), (COUNT,)),
    ("colors_precomp", dict(channels=3), (COUNT,), (COUNT,)),
    ("scales", {}, (COUNT, 1), (COUNT, 3)),
    ("scales", {}, (COUNT, 2), (COUNT, 3)),
    ("scales", {}, (COUNT + 2, 3), (COUNT, 3)),
    ("rotations", {}, (COUNT, 3), (COUNT, 4)),
    ("rotations", {}, (COUNT - 1, 4), (COUNT, 4)),
    ("cov3D_precomp", dict(covariance="cov3D"), (COUNT, 3, 3), (COUNT, 6)),
    ("cov3D_precomp", dict(covariance="cov3D"), (COUNT, 5), (COUNT, 6)),
]


@pytest.mark.parametrize("name, options, wrong, right", SHAPES)
def test_a_wrong_shape_is_named(name, options, wrong, right):
    scene = scene_of(**options).with_inputs(**{name: torch.ones(wrong)})
    with pytest.raises(ValueError) as error:
        render(scene)
    message = str(error.value)
    assert "rasterize" in message and re.search(rf"\b{name}\b", message), message
    assert re.search(shape_pattern(*wrong), message), message
    rest = re.sub(shape_pattern(*wrong), "", message, count=1)
    assert re.search(shape_pattern(*right), rest), message


@pytest.mark.parametrize("name, wrong, right", [
    ("bg", (2,), (3,)), ("bg", (1, 3), (3,)), ("viewmatrix", (3, 4), (4, 4)), ("viewmatrix", (16,), (4, 4)),
    ("projmatrix", (4, 3), (4, 4)), ("campos", (4,), (3,)), ("campos", (3, 1), (3,)), ("viewmatrix", (2, 4, 4), (4, 4)),
])
def test_a_wrong_shape_in_the_settings_is_named(name, wrong, right):
    scene = scene_of().with_settings(**{name: torch.ones(wrong)})
    with pytest.raises(ValueError) as error:
        render(scene)
    message = str(error.value)
    assert re.search(rf"\b{name}\b", message), message
    assert re.search(shape_pattern(*wrong), message) and re.search(shape_pattern(*right), message), message


def test_the_background_has_the_channels_of_the_colours():
    scene = scene_of(channels=5).with_settings(bg=torch.zeros(3))
    with pytest.raises(ValueError, match=r"bg.*\b5\b|\b5\b.*bg"):
        render(scene)


INPUTS = ["means3D", "means2D", "opacities", "shs", "scales", "rotations"]
CAMERA = ["bg", "viewmatrix", "projmatrix", "campos"]


@pytest.mark.parametrize("name", INPUTS[1:] + CAMERA)
def test_mixed_types_are_named(name):
    scene = scene_of()
    if name in CAMERA:
        scene = scene.with_settings(**{name: getattr(scene.settings, name).double()})
    else:
        scene = scene.with_inputs(**{name: scene.inputs[name].double()})
    with pytest.raises(TypeError, match=rf"\b{name}\b"):
        render(scene)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int32, torch.complex64])
def test_other_types_are_named(dtype):
    with pytest.raises(TypeError, match="means3D.*(float32|Float)"):
        render(scene_of().to(dtype))


def test_a_tensor_on_another_device_is_named():
    with pytest.raises((TypeError, ValueError), match=r"\bscales\b.*meta|meta.*\bscales\b"):
        scene = scene_of()
        render(scene.with_inputs(scales=scene.inputs["scales"].to("meta")))


@pytest.mark.parametrize("function", [rasterize, visible_radii, project_gaussians, DirectRendering])
@pytest.mark.parametrize("layout", ["to_sparse", "to_sparse_csr"])
@pytest.mark.filterwarnings("ignore:Sparse CSR tensor support")
def test_a_sparse_tensor_is_named(function, layout):
    scene = scene_of()
    inputs = {**scene.inputs, "scales": getattr(scene.inputs["scales"], layout)()}
    if function is visible_radii:
        inputs = {name: inputs[name] for name in ("means3D", "scales", "rotations")}
    words = rf"^{function.__name__}: scales is sparse \(torch.sparse_.*\); it must be dense: scales.to_dense\(\)$"
    with pytest.raises(TypeError, match=words):
        function(settings=scene.settings, **inputs)


def test_functions_without_settings_refuse_sparse_tensors_and_several_devices():
    numbers = torch.rand(3, 12, 12)
    for other, words in ((numbers.to_sparse(), r"is sparse \(torch.sparse_coo\); it must be dense"),
                         (numbers.to("meta"), r"is on meta; it must be on cpu|is on meta; it must be on cuda:0")):
        for function, *before in ((fused_ssim, numbers), (l1_ssim_loss, numbers), (activate, numbers, numbers),
                                  (add_view, numbers, numbers, numbers)):
            with pytest.raises(TypeError, match=f"^{function.__name__}: .*({words})"):
                function(*before, other)


def test_something_that_is_no_tensor():
    scene = scene_of()
    with pytest.raises(TypeError, match="opacities"):
        render(scene.with_inputs(opacities=scene.inputs["opacities"].tolist()))


@pytest.mark.parametrize("field, value", [
    ("image_height", 0), ("image_width", 0), ("image_height", -5), ("image_width", -1), ("tanfovx", 0.0),
    ("tanfovy", -1.0), ("tanfovx", float("nan")), ("sh_degree", 4), ("sh_degree", -1),
    ("image_height", 1.5), ("image_width", 20.25), ("sh_degree", 0.5),
])
def test_settings_out_of_range_are_named(field, value):
    with pytest.raises(ValueError, match=rf"{field}.*{value:g}"):
        render(scene_of().with_settings(**{field: value}))


NUMBERS = [name for name, kind in OPTIONS.items() if kind is float and name != "fixed_background_gate"]
FLAGS = [name for name, kind in OPTIONS.items() if kind is bool and name not in (*FEATURE_OUTPUTS, "for_backward")]


@pytest.mark.parametrize("field, value, right", [
    *((name, value, "a number") for name in NUMBERS for value in ("wide", "0.5", 1j, torch.ones(2), 10**400)),
    *((name, value, "a whole number below 2^63") for name in ("image_height", "image_width", "sh_degree")
      for value in ("2", None, float("nan"), float("inf"), 10**20, -10**20, torch.ones(2))),
    *((name, value, "True or False") for name in FLAGS for value in ("False", "", torch.ones(2)))])
@pytest.mark.parametrize("function", [rasterize, project_gaussians])
def test_a_setting_that_is_none_of_its_type_is_named(function, field, value, right):
    scene = scene_of("smoe").with_settings(**{field: value})
    words = rf"{field} is {re.escape(repr(value))}; it must be {re.escape(right)}"
    with pytest.raises(ValueError, match=words.replace("a number", "a number.*")):
        function(settings=scene.settings, **scene.inputs)


CAMERA_READS = [("viewmatrix", (1, 2)), ("viewmatrix", (3, 0)), ("projmatrix", (0, 0)), ("projmatrix", (2, 3)),
                ("campos", (1,)), ("bg", (2,))]


@pytest.mark.parametrize("name, place", CAMERA_READS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_camera_that_is_not_finite_is_named_where_nobody_waits_for_it(device, name, place, value):
    if device.type != "cpu":
        pytest.skip("the host would wait for the GPU")
    scene = scene_of()
    broken = getattr(scene.settings, name).clone()
    broken[place] = value
    scene = scene.with_settings(**{name: broken})
    index = place[0] * 4 + place[1] if len(place) == 2 else place[0]
    words = rf"\({name}\)\[{index}\] is {value:g}; it must be finite"
    footprints = project_gaussians(settings=scene_of().settings, **scene.inputs)
    calls = [lambda: render(scene), lambda: project_gaussians(settings=scene.settings, **scene.inputs)]
    if name == "bg":
        calls[1] = lambda: blend_footprints(footprints, scene.settings)
    if name == "viewmatrix":
        calls += [lambda: GaussianRasterizer(scene.settings).markVisible(scene.inputs["means3D"]),
                  lambda: visible_radii(scene.inputs["means3D"], scene.settings, scene.inputs["scales"],
                                        scene.inputs["rotations"])]
    for call in calls:
        with pytest.raises(ValueError, match=words):
            call()


def test_numbers_of_a_camera_that_nothing_reads_may_be_nan():
    scene = scene_of(channels=3)
    view, projection = (getattr(scene.settings, name).clone() for name in ("viewmatrix", "projmatrix"))
    view[:, 3] = projection[:, 2] = float("nan")
    odd = scene.with_settings(viewmatrix=view, projmatrix=projection,
                              campos=torch.full_like(scene.settings.campos, float("nan")))
    (image, gradient), (expected, expected_gradient) = (gradients(rasterize, each) for each in (odd, scene))
    assert torch.equal(image.color, expected.color)
    assert all(torch.equal(gradient[name], value) for name, value in expected_gradient.items())


def test_settings_may_be_whole_numbers_of_any_type():
    scene = scene_of()
    floats = scene.with_settings(image_width=20.0, image_height=torch.tensor(18), sh_degree=1.0)
    assert torch.equal(render(floats).color, render(scene).color)


@pytest.mark.parametrize("width, height", [(2 ** 31, 16), (16, 2 ** 31), (2 ** 20, 2 ** 20), (2 ** 63, 1)])
def test_images_that_no_machine_can_hold(mode, width, height):
    scene = scene_of(mode).with_settings(image_width=width, image_height=height)
    with pytest.raises((ValueError, RuntimeError, MemoryError, OverflowError)):
        render(scene)


@pytest.mark.parametrize("extra, missing, words", [
    ("colors_precomp", (), ("shs", "colors_precomp")),
    (None, ("shs",), ("shs", "colors_precomp")),
    ("cov3D_precomp", (), ("scales", "rotations", "cov3D_precomp")),
    ("cov3D_precomp", ("scales",), ("scales", "rotations", "cov3D_precomp")),
    ("cov3D_precomp", ("rotations",), ("scales", "rotations", "cov3D_precomp")),
    (None, ("scales",), ("scales", "rotations")),
    (None, ("rotations",), ("scales", "rotations")),
    (None, ("scales", "rotations"), ("scales", "rotations", "cov3D_precomp")),
])
@pytest.mark.parametrize("absent", ["left_out", "none", "empty"])
@pytest.mark.parametrize("count", [COUNT, 0])
def test_both_or_neither_of_two_alternatives(extra, missing, words, absent, count):
    scene = scene_of().rows(slice(0, count))
    inputs = dict(scene.inputs)
    for name in missing:
        del inputs[name]
        if absent != "left_out":
            inputs[name] = None if absent == "none" else torch.Tensor([])
    if extra is not None:
        inputs[extra] = torch.rand(count, 3 if extra == "colors_precomp" else 6)
    with pytest.raises(Exception) as error:
        rasterize(settings=scene.settings, **inputs)
    assert all(word in str(error.value) for word in words), str(error.value)
    with pytest.raises(Exception) as error:
        GaussianRasterizer(raster_settings=scene.settings)(**inputs)
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize("changed, message", [
    (dict(shs=torch.zeros(0, 3, 3)), r"shs has shape \[0, 3, 3\]; sh_degree 1 needs 4 coefficients a Gaussian, not 3"),
    (dict(shs=None, dc=torch.zeros(0, 1, 3)), "sh_degree 1 needs 4 coefficients a Gaussian, not 1")])
def test_coefficients_that_do_not_suffice_are_named_without_gaussians_too(changed, message):
    scene = scene_of().rows(slice(0, 0))
    with pytest.raises(ValueError, match=message):
        render(scene.with_inputs(**{name: tensor if tensor is None else tensor.to(scene.inputs["means3D"])
                                    for name, tensor in changed.items()}))


@pytest.mark.parametrize("missing", ["means3D", "opacities"])
def test_a_required_input_that_is_none(missing):
    scene = scene_of()
    with pytest.raises((TypeError, ValueError), match=missing):
        render(scene.with_inputs(**{missing: None}))


def test_dc_with_precomputed_colours():
    scene = scene_of(channels=3)
    with pytest.raises(ValueError, match="dc"):
        render(scene, dc=torch.rand(COUNT, 1, 3))


def test_an_unknown_output():
    with pytest.raises(ValueError, match="normals.*alpha.*depth.*inverse_depth"):
        render(scene_of(), outputs=("normals",))


def test_prefiltered_with_a_culled_point_is_an_ordinary_error(mode):
    scene = scene_of(mode)
    with pytest.raises((ValueError, RuntimeError), match="prefiltered"):
        render(scene.with_settings(prefiltered=True))
    camera = camera_settings(20, 18, position=(0.0, 0.0, -30.0), degree=1, dtype=torch.float32, blend_mode=mode)
    far = scene._replace(settings=camera._replace(prefiltered=True))
    assert render(far).radii.any()


@pytest.mark.parametrize("function", [rasterize, rasterize_with_splats, visible_radii, project_gaussians,
                                      DirectRendering])
@pytest.mark.parametrize("name", ["means3D", "scales"])
def test_an_error_names_the_function_that_was_called(function, name):
    scene = scene_of()
    inputs = {**scene.inputs, name: [[0.1, 0.1, 0.1]]}
    if function is visible_radii:
        inputs = {name: inputs[name] for name in ("means3D", "scales", "rotations")}
    with pytest.raises(TypeError, match=rf"^{function.__name__}: {name} is of type list; it must be a torch.Tensor$"):
        function(settings=scene.settings, **inputs)
