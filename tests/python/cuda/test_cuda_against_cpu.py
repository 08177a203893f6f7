"""The CUDA backend against the CPU backend in float64: images, radii and all gradients, in all modes."""
from __future__ import annotations

import functools

import pytest
import torch
from against_cpu import FLOAT32, FLOAT64, Tolerance, compare
from comparison import assert_all_close, assert_close, reference_gradients
from real_data import folder
from scenes import (
    Scene,
    camera_settings,
    gradients,
    op_arguments,
    op_results,
    random_scene,
    turned,
    with_gate,
    with_gates,
)

from diff_smoe_rasterization import rasterize, reference
from diff_smoe_rasterization.core import _core
from diff_smoe_rasterization.settings import OUTPUTS
from dsmoe.model import GaussianModel
from dsmoe.options.config import TrainConfig
from dsmoe.scenes.scene import load_cameras, read_layout


def crowd(mode, **options):
    """Thousands of small Gaussians, some hundred pairs a pixel."""
    return random_scene(mode, 3000, 160, 107, scale=0.03, **options)


def through(lens, mode):
    """Around the camera if the lens sees around; of degree 3, for which kernels are compiled."""
    position = (0.4, -0.3, -4.0) if lens["camera_model"] in ("orthographic", "opencv") else (0.4, -0.3, -1.5)
    return crowd(mode, degree=3, position=position, near=0.5).with_settings(**lens)


def rolling(lens, shutter, mode):
    """The same while the camera turns and moves by some 4 pixels, by 20 at most."""
    scene = through(lens, mode)
    end = turned(scene.settings.viewmatrix, (0.05, -0.06, 0.08), (0.1, 0.12, -0.07))
    return scene.with_settings(rolling_shutter=shutter, viewmatrix_end=end)


def one_covers_all(mode):
    """A Gaussian whose footprint is the whole image, before and behind many that are small."""
    scene = crowd(mode, degree=1)
    inputs = {name: tensor.clone() for name, tensor in scene.inputs.items()}
    for index, depth in ((0, -3.0), (1, 3.0)):
        inputs["means3D"][index] = -scene.settings.campos * depth / 4
        inputs["scales"][index] = 50.0
        inputs["opacities"][index] = 0.3
    return scene._replace(inputs=inputs)


def saturated(mode):
    """Every pixel is full after a few Gaussians."""
    return random_scene(mode, 3000, 64, 48, scale=0.3, opacity=(0.5, 1.3), degree=1)


SCENES = {
    "harmonics": lambda mode: crowd(mode, degree=3),
    "split_harmonics": lambda mode: crowd(mode, degree=2, split_dc=True),
    "colours_1": lambda mode: crowd(mode, channels=1),
    "colours_3": lambda mode: crowd(mode, channels=3),
    "colours_7": lambda mode: crowd(mode, channels=7),
    "covariances": lambda mode: crowd(mode, covariance="cov3D", channels=3),
    "antialiasing": lambda mode: crowd(mode, degree=1, antialiasing=True),
    "antialiased_covariances": lambda mode: crowd(mode, covariance="cov3D", degree=1, antialiasing=True),
    "alpha_min": lambda mode: crowd(mode, degree=1, alpha_min=1 / 255),
    "principal_point": lambda mode: crowd(mode, degree=0, principal_point=(21.3, -9.6)),
    **{f"lens_{lens['camera_model']}": functools.partial(through, lens) for lens in (
        dict(camera_model="orthographic", tanfovx=2.0, tanfovy=1.4),
        dict(camera_model="opencv", distortion=(-0.2, 0.05, 0.01, -0.02, 0.03, 0.01, 0.02, -0.01),
             principal_point=(84.0, 51.0)),
        dict(camera_model="fisheye", distortion=(0.02, -0.01, 0.003, -0.0002)),
        dict(camera_model="thin_prism_fisheye", distortion=(0.02, -0.01, 0.003, -0.002, 0.01, 0.001, 0.02, -0.01)),
        dict(camera_model="equirectangular"))},
    **{f"lens_{shutter}": functools.partial(rolling, lens, shutter) for lens, shutter in (
        (dict(camera_model="opencv", principal_point=(84.0, 51.0)), "top_to_bottom"),
        (dict(camera_model="fisheye", distortion=(0.02, -0.01, 0.003, -0.0002)), "right_to_left"))},
    "one_covers_all": one_covers_all,
    "saturated": saturated,
    "one_pixel": lambda mode: random_scene(mode, 300, 1, 1, scale=0.3, degree=1, fov_x=0.1),
    "one_tile": lambda mode: random_scene(mode, 500, 16, 16, scale=0.1, degree=1),
    "one_pixel_more_than_tiles": lambda mode: random_scene(mode, 500, 17, 33, scale=0.1, degree=1),
}
# With the optional images and their gradients.
WITH_OUTPUTS = ("harmonics", "colours_7", "antialiasing", "alpha_min", "saturated", "one_covers_all", "one_tile")
SANITIZED = ("split_harmonics", "covariances", "one_pixel_more_than_tiles")


def selected(names):
    return [pytest.param(name, marks=pytest.mark.sanitize) if name in SANITIZED else name for name in names]


@with_gate
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, FLOAT32), (torch.float64, FLOAT64)],
                         ids=["float32", "float64"])
@pytest.mark.parametrize("name", selected(SCENES))
def test_random_scenes(mode, name, dtype, tolerance, gpu):
    scene = SCENES[name](mode)
    rendering = compare(scene, gpu, dtype, OUTPUTS if name in WITH_OUTPUTS else (), tolerance)
    assert (rendering.radii > 0).sum() > 5
    background = scene.settings.bg.to(rendering.color)[:, None, None]
    assert ((rendering.color - background).abs() > 1e-3).any(0).double().mean() > 0.3


@with_gates
@pytest.mark.sanitize
@pytest.mark.parametrize("camera", [False, True], ids=["fixed_camera", "camera"])
@pytest.mark.parametrize("split_dc", [False, True], ids=["harmonics", "split_harmonics"])
def test_what_trainers_render(mode, split_dc, camera, gpu):
    """Only colours of degree 3, in float32: kernels are compiled for them, with and without the camera's gradients."""
    scene = crowd(mode, degree=3, split_dc=split_dc)
    assert scene.inputs["means3D"].shape[0] % 32 > 0, "the last warp must be a part of one"
    rendering = compare(scene, gpu, torch.float32, (), FLOAT32, camera)
    assert (rendering.radii > 0).sum() > 500


@pytest.mark.parametrize("split_dc", [False, True], ids=["harmonics", "split_harmonics"])
def test_arrays_that_begin_anywhere(split_dc, gpu):
    """Rows behind others, at no multiple of 16 bytes: they cannot be read as vectors, and give the same."""
    scene = crowd("smoe", degree=3, split_dc=split_dc).to(torch.float32).to(gpu)
    padding = 16 * 1024 + 1  # numbers before each array

    def shifted(settings, outputs, **inputs):
        return rasterize(settings=settings, outputs=outputs, **{
            name: torch.cat([tensor.new_zeros(padding), tensor.flatten()])[padding:].view(tensor.shape)
            for name, tensor in inputs.items()})

    expected, expected_gradients = gradients(rasterize, scene, camera=False)
    rendering, gradient = gradients(shifted, scene, camera=False)
    # Other kernels, which round otherwise; and sums in any order.
    assert_close(rendering.color, expected.color, FLOAT32.pixel, "color")
    assert_all_close(gradient, expected_gradients, FLOAT32.gradient)


def captured(mode, width, height):
    """The points of a real capture as Gaussians, before one of its cameras."""
    config = TrainConfig(scene=folder("bonsai"))
    model = GaussianModel.from_points(read_layout(config).points, 1, "cpu")
    generator = torch.Generator().manual_seed(0)
    model.raw["opacities"] = torch.randn(model.num_gaussians, 1, generator=generator)
    model.raw["shs"] = 0.1 * torch.randn(model.num_gaussians, 3, 3, generator=generator)
    inputs = dict(means3D=model.raw["means3D"], means2D=torch.zeros(model.num_gaussians, 3), shs=model.raw["shs"],
                  dc=model.raw["dc"], opacities=model.opacities, scales=model.scales, rotations=model.rotations)
    camera = load_cameras(config, "test")[0].resized(width, height)
    blend = {name: getattr(random_scene(mode, 1).settings, name) for name in ("blend_mode", "background_gate")}
    settings = camera.settings(torch.tensor([0.2, 0.5, 0.8]), 1, "alpha")._replace(**blend)
    return Scene(inputs, settings).to(torch.float32)


@with_gate
def test_a_real_capture(mode, gpu):
    rendering = compare(captured(mode, 800, 533), gpu, torch.float32, OUTPUTS, FLOAT32)
    assert (rendering.radii > 0).sum() > 20_000


def test_sixteen_thousand_pixels_wide(mode, gpu):
    scene = random_scene(mode, 2000, 16384, 33, scale=0.02, degree=1, fov_x=1.4)
    # At 16,384 pixels a position is rounded by 5e-4 px, which is a change of 3e-3 of a splat's alpha at worst.
    compare(scene, gpu, torch.float32, OUTPUTS, Tolerance(1e-3, 1e-3, 1e-5))
    compare(scene, gpu, torch.float64, OUTPUTS, FLOAT64)


def tall(mode, dtype):
    """A column of 68,751 tiles: more than a grid may have in y. Gaussians at both ends and all along it."""
    height, count = 1_100_009, 2000
    scene = random_scene(mode, count, 16, 32, channels=1)
    settings = camera_settings(16, height, position=(0.0, 0.0, -1.0), bg=torch.tensor([0.5]), blend_mode=mode)
    projection = torch.linalg.inv(settings.viewmatrix) @ settings.projmatrix
    projection[1, 1], projection[0, 0] = 1.0, height / 16
    settings = settings._replace(viewmatrix=torch.eye(4, dtype=torch.float64), projmatrix=projection, tanfovy=1.0,
                                 tanfovx=16 / height, campos=torch.zeros(3, dtype=torch.float64))
    means3D = torch.zeros(count, 3, dtype=torch.float64)
    means3D[:, 1] = torch.linspace(-4, 4, count, dtype=torch.float64)
    means3D[:, 2] = 4
    pixel = 2 * 4 / height  # at depth 4
    scene = scene._replace(settings=settings).with_inputs(
        means3D=means3D, scales=40 * pixel * (1 + scene.inputs["scales"]))
    # In `smoe` a pixel of one Gaussian has its colour, and the opacity no gradient but by rounding.
    return (scene.with_settings(background_gate=0.5) if mode == "smoe" else scene).to(torch.float32).to(dtype)


def test_more_rows_of_tiles_than_a_grid_may_have(mode, gpu):
    scene = tall(mode, torch.float64)
    rendering = compare(scene, gpu, torch.float64, (), FLOAT64)
    assert (rendering.radii > 0).all()
    assert (rendering.color[0, -20:] != 0.5).all() and (rendering.color[0, :20] != 0.5).all()
    # In float32 a row number above a million is rounded by 0.06, of a splat of 40 px; a footprint may end a row away.
    compare(scene, gpu, torch.float32, (), Tolerance(2e-2, 2e-2, 1e-3))


@with_gate
@pytest.mark.parametrize("dtype, tolerance", [
    # Products and sums of a hundred thousand terms: 1e-5, and as much again in what cancels.
    (torch.float32, Tolerance(1e-4, 3e-4, 1e-5)), (torch.float64, FLOAT64)], ids=["float32", "float64"])
def test_a_hundred_thousand_gaussians_in_one_tile(mode, dtype, tolerance, gpu):
    scene = random_scene(mode, 100_000, 16, 16, scale=0.05, opacity=(0.001, 0.02), degree=0, fov_x=0.3)
    rendering = compare(scene, gpu, dtype, ("alpha",), tolerance)
    assert (rendering.radii > 0).sum() > 5000


LONG_LISTS = {
    "faint": lambda mode: random_scene(mode, 6000, 40, 37, scale=0.3, opacity=(0.004, 0.01), degree=1),
    # A pixel fills up in a later segment than its first.
    "filling": lambda mode: random_scene(mode, 6000, 40, 37, scale=0.3, opacity=(0.01, 0.06), degree=1),
    "one_channel_and_depths": lambda mode: random_scene(mode, 6000, 40, 37, scale=0.3, opacity=(0.004, 0.01),
                                                        channels=1),
    "deterministic": lambda mode: random_scene(mode, 6000, 40, 37, scale=0.3, opacity=(0.004, 0.03), degree=1,
                                               deterministic=True),
}


@with_gates
@pytest.mark.sanitize
@pytest.mark.parametrize("name", LONG_LISTS)
def test_lists_of_several_segments(mode, name, gpu):
    """Of float and three features, so that a warp of the backward pass has a part of a list; some tiles are partial."""
    scene = LONG_LISTS[name](mode)
    offsets = op_results(scene.to(torch.float32).to(gpu))[1]["tile_offsets"]
    assert (offsets[1:-1] - offsets[:-2]).max() > 2 * _core.constants["segment_length"]
    # Sums of a thousand terms and more, in another order. Of 1480 pixels with a thousand pairs of alpha near 1/255
    # each, a few have one that lies within rounding, 1e-6 of itself, of that threshold.
    rendering = compare(scene, gpu, torch.float32, ("depth", "inverse_depth") if "depths" in name else (),
                        Tolerance(1e-4, 3e-4, 5e-3))
    assert (rendering.radii > 0).sum() > 2000


@with_gate
@pytest.mark.sanitize
def test_renderings_without_gradients_keep_no_segments(mode, gpu):
    """They have no use for them. Images are the same bit for bit, and a backward pass would be right nevertheless."""
    scene = LONG_LISTS["faint"](mode).to(torch.float32).to(gpu)
    colour_alone = {"depth": False, "inverse_depth": False}
    kept, lean = (op_results(scene, **colour_alone, for_backward=wanted) for wanted in (True, False))
    for name in ("segments", "segment_queue"):
        assert lean[1][name].numel() == 0 < kept[1][name].numel()
    with torch.no_grad():
        rendering = rasterize(settings=scene.settings, **scene.inputs)
    for image in (lean[0]["color"], rendering.color):
        assert torch.equal(image, kept[0]["color"])

    inputs = {name: value for name, value in zip(_core.inputs, op_arguments(scene)) if value is not None}
    present = [name in inputs for name in _core.inputs]
    gradient = torch.randn(kept[0]["color"].shape, generator=torch.Generator().manual_seed(1)).to(gpu)
    first, second = (torch.ops.diff_smoe_rasterization.rasterize_backward(
        *op_arguments(scene, "rasterize_backward", **colour_alone, dL_dcolor=gradient, inputs=list(inputs.values()),
                      present=present, wanted=present, images=list(images.values()), saved=list(saved.values())))
        for images, saved in (kept, lean))
    # The same sums of a thousand float32 terms and more, added in another order.
    assert_all_close(dict(zip(inputs, first)), dict(zip(inputs, second)), 1e-4)


@with_gate
@pytest.mark.skipif(not hasattr(torch.library, "opcheck"),
                    reason=f"torch {torch.__version__} has no torch.library.opcheck, so no fake kernels")
def test_the_fake_kernel_knows_that_no_segments_are_kept(mode, gpu):
    scene = random_scene(mode, 20, 20, 18, dtype=torch.float32, degree=1).to(gpu)
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.rasterize.default,
                          op_arguments(scene, depth=False, inverse_depth=False, for_backward=False),
                          test_utils=("test_schema", "test_faketensor"))


@with_gate
@pytest.mark.sanitize
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["no_gaussians", "behind_the_camera", "without_opacity", "beside_the_image"])
def test_nothing_is_drawn(mode, kind, dtype, gpu):
    scene = random_scene(mode, 200, 33, 21, degree=1)
    scene = {
        "no_gaussians": lambda: scene.rows(slice(0, 0)),
        "behind_the_camera": lambda: scene.with_inputs(means3D=scene.inputs["means3D"] + 30 * scene.settings.campos),
        "without_opacity": lambda: scene.with_inputs(opacities=torch.zeros(200, 1, dtype=torch.float64)),
        "beside_the_image": lambda: scene.with_inputs(
            means3D=scene.inputs["means3D"] + 100 * scene.settings.viewmatrix[:3, 0]),
    }[kind]()
    rendering = compare(scene, gpu, dtype, OUTPUTS, FLOAT64 if dtype == torch.float64 else FLOAT32)
    background = scene.settings.bg.to(rendering.color)[:, None, None].expand_as(rendering.color)
    assert torch.equal(rendering.color, background)


@with_gate
def test_the_reference_runs_on_a_gpu_too(mode, gpu):
    scene = random_scene(mode, degree=1)
    expected, expected_gradients = reference_gradients(scene, OUTPUTS)
    rendering, gradient = gradients(reference.rasterize, scene.to(gpu), OUTPUTS)
    for name in ("color",) + OUTPUTS:
        assert_close(getattr(rendering, name), getattr(expected, name), FLOAT64.pixel, name)
    assert_all_close({name: values.cpu() for name, values in gradient.items()}, expected_gradients, FLOAT64.gradient)
