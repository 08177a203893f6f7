"""The rules of the reference rasterizer one by one, each against numbers worked out by hand."""
from __future__ import annotations

import math

import pytest
import torch
from by_hand import facing_camera, middle, on_axis
from comparison import assert_close
from scenes import blend_of, gate_of, with_gate, with_gates

from diff_smoe_rasterization import reference

EXACT = 1e-12  # float64: the same few operations, written in another order
WIDTH, DEPTH = 64, 2.0  # of the images here; the focal length is WIDTH / 2


def splat_at(x, y, variance2D):
    """The covariance and mean of a Gaussian that projects to (x, y) with about that variance in px^2, and a colour."""
    slope = [(2 * pixel + 1) / WIDTH - 1 for pixel in (x, y)]
    inputs = on_axis([DEPTH], [1.0], [[1.0]], variance=1.0)
    inputs["means3D"] = torch.tensor([[slope[0] * DEPTH, slope[1] * DEPTH, DEPTH]], dtype=torch.float64)
    # The Jacobian is (f / z) [1, 0, -x / z; 0, 1, -y / z]; without variance along z only f / z stays.
    variance3D = (variance2D - 0.3) * (DEPTH / (WIDTH / 2)) ** 2
    inputs["cov3D_precomp"] = variance3D * torch.tensor([[1, 0, 0, 1, 0, 0]], dtype=torch.float64)
    return inputs


WITHIN_TILES = ("alpha", "smoe")  # modes in which the tile rectangle of 3DGS bounds a footprint


def least_kernel(mode, opacity):
    """The least G that counts, beyond 3 sigma."""
    return 1 / 2040 / opacity if blend_of(mode) == "smoe" else max(1e-5, gate_of(mode) / 255 / opacity)


def render(mode, inputs, outputs=(), **fields):
    settings = facing_camera(mode, WIDTH, WIDTH, bg=(0.0,))._replace(**fields)
    return reference.rasterize(settings=settings, outputs=outputs, **inputs)


@with_gates
@pytest.mark.parametrize("excess, counts", [(1.01, True), (0.99, False)])
def test_the_cut_off_of_a_pair(mode, excess, counts):
    distance, opacity = 10, 0.5
    kernel = excess * least_kernel(mode, opacity)
    inputs = splat_at(20, 31, distance ** 2 / (-2 * math.log(kernel)))
    inputs["opacities"][:] = opacity
    alpha = render(mode, inputs, ("alpha",)).alpha[0, 31]
    assert kernel < math.exp(-4.5)  # beyond 3 sigma, where a background gate may cut
    expected = opacity * kernel if counts else 0
    if blend_of(mode) == "smoe":
        expected /= expected + gate_of(mode) * (1 - expected) or 1
    # 1e-5: the position is divided by w + 1e-7, which moves it by 1e-6 px.
    assert alpha[30].item() == pytest.approx(expected, rel=1e-5)
    assert alpha[10].item() == pytest.approx(expected, rel=1e-5)
    assert alpha[29] > 0 and alpha[31] == 0


@with_gate
def test_alpha_min_cuts_the_smoe_modes_on_alpha(mode):
    inputs = splat_at(20, 31, 16.0)
    inputs["opacities"][:] = 0.5
    alpha = render(mode, inputs, ("alpha",), alpha_min=0.02).alpha[0, 31, 20:]
    reach = 4 * math.sqrt(2 * math.log(0.5 * 255 if mode == "alpha" else 0.5 / 0.02))
    assert (alpha > 0).tolist() == [distance <= reach for distance in range(44)]


@with_gate
def test_alpha_stays_in_the_tile_rectangle_of_3dgs(mode):
    # Radius ceil(3 sqrt(100 + sqrt(0.1))) = 31: tiles floor((47.9 - 31) / 16) = 1 and up, so that pixel 15, at 32.9 px,
    # is left out although alpha is still 1/224 there. The other way, tiles below floor((16.1 + 31 + 15) / 16) = 3.
    for center, inside, outside in ((47.9, 16, 15), (16.1, 47, 48)):
        assert math.exp(-0.5 * (outside - center) ** 2 / 100) > 1 / 255
        row = render(mode, splat_at(center, 31, 100.0), ("alpha",)).alpha[0, 31]
        column = render(mode, splat_at(31, center, 100.0), ("alpha",)).alpha[0, :, 31]
        for line in (row, column):
            assert line[inside] > 0
            assert (line[outside] > 0) == (blend_of(mode) not in WITHIN_TILES)


def test_the_truncation_of_3dgs_equals_the_floor_on_the_grid():
    settings = facing_camera("alpha", 50, 37)
    for variance in (0.3, 4.0, 90.0):
        reach = math.ceil(3 * math.sqrt(variance + math.sqrt(0.1)))
        for step in range(-400, 800):
            x = step / 8 + 0.003
            covariance = torch.tensor([[variance, 0, variance]])
            splat = reference.Splats(torch.tensor([[x, 11.0]]), None, covariance, None, None, None)
            first, past = reference.tile_rectangle(splat, settings)
            assert first[0, 0].item() == min(4, max(0, int((x - reach) / 16)))
            assert past[0, 0].item() == min(4, max(0, int((x + reach + 15) / 16)))


@with_gate
@pytest.mark.parametrize("side", ["left", "right", "above", "below"])
def test_the_footprint_decides_whether_a_radius_is_zero(mode, side):
    # Variance 9: the radius is ceil(3 sqrt(9 + sqrt(0.1))) = 10, G = 1e-5 lies at 3 sqrt(2 ln 1e5) = 14.395.
    within = blend_of(mode) in WITHIN_TILES
    low, high = (-8.9, -9.1) if within else (-14.3, -14.5)  # tiles: (-9 + 10 + 15) / 16 = 1
    far_low, far_high = (73.9, 74.1) if within else (63 + 14.3, 63 + 14.5)  # (74 - 10) / 16 = 4
    touching, missing = (low, high) if side in ("left", "above") else (far_low, far_high)
    for position, radius in ((touching, 10), (missing, 0)):
        x, y = (position, 30) if side in ("left", "right") else (30, position)
        inputs = splat_at(x, y, 9.0)
        assert render(mode, inputs, ("alpha",)).radii.tolist() == [radius]


def test_a_tilted_footprint_is_tested_as_an_ellipse():
    # Variances 100 along one diagonal, 1 along the other; 20 px left of and above the corner its box covers the image.
    inputs = splat_at(-20, -20, 1.3)
    unit = (DEPTH / (WIDTH / 2)) ** 2
    for sign, visible in ((1, True), (-1, False)):
        inputs["cov3D_precomp"] = unit * torch.tensor([[50.2, sign * 49.5, 0, 50.2, 0, 0]], dtype=torch.float64)
        assert bool(render("smoe_eq7", inputs).radii[0] > 0) == visible
        assert bool(render("alpha", inputs).radii[0] > 0)  # the square of 3DGS


@pytest.mark.parametrize("opacity", [0.0, -0.5])
def test_no_opacity_means_no_pair(mode, opacity):
    lone, other = splat_at(20, 31, 9.0), splat_at(22, 31, 9.0)
    both = {name: torch.cat([lone[name], other[name]]) for name in lone}
    both["colors_precomp"] = torch.tensor([[0.2], [0.9]], dtype=torch.float64)
    both["opacities"] = torch.tensor([[opacity], [0.5]], dtype=torch.float64)
    both = {name: tensor.requires_grad_(True) for name, tensor in both.items()}
    rendering = render(mode, both, ("alpha",))
    assert rendering.radii.tolist() == [10, 10]
    alone = render(mode, {name: tensor[1:] for name, tensor in both.items()}, ("alpha",))
    assert torch.equal(rendering.color, alone.color) and torch.equal(rendering.alpha, alone.alpha)
    (rendering.color.sum() + rendering.alpha.sum()).backward()
    assert both["opacities"].grad[1] != 0
    for name, tensor in both.items():
        assert not tensor.grad[0].any(), name


def test_the_near_plane(mode):
    for depth, visible in ((0.19, False), (float(torch.tensor(0.2)), False), (0.21, True)):
        inputs = on_axis([depth], [0.5], [[1.0]], variance=1e-4)
        assert render(mode, inputs).radii.any() == visible
        assert not render(mode, inputs, near=0.3).radii.any()


def projected(mean, variance, settings):
    one = torch.ones(1, 1, dtype=torch.float64)
    covariance = variance * torch.tensor([[1, 0, 0, 1, 0, 1]], dtype=torch.float64)
    gaussians = reference.Gaussians(torch.tensor([mean], dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64),
                                    one[0], None, one, None, None, covariance)
    return reference.project(gaussians, settings)


def test_the_jacobian_is_clamped_at_1_3_tan_fov():
    settings = facing_camera("alpha", WIDTH, WIDTH // 2)
    for slope in (-3.0, -1.2, 0.5, 1.4):
        splat = projected([slope * DEPTH, 0.0, DEPTH], 0.04, settings)
        clamped = max(-1.3, min(1.3, slope))
        focal_x, focal_y = WIDTH / 2, WIDTH / 4
        expected = [0.04 * (focal_x / DEPTH) ** 2 * (1 + clamped ** 2) + 0.3, 0, 0.04 * (focal_y / DEPTH) ** 2 + 0.3]
        assert splat.covariance[0].tolist() == pytest.approx(expected, rel=EXACT)
        # The position is not clamped.
        assert splat.position[0, 0].item() == pytest.approx(((slope + 1) * WIDTH - 1) / 2, rel=1e-6)


def test_the_clip_coordinates_are_divided_by_w_plus_1e_7():
    splat = projected([2e-6, 0.0, 1e-5], 1e-12, facing_camera("alpha", WIDTH, WIDTH))
    expected = ((2e-6 / (1e-5 + 1e-7) + 1) * WIDTH - 1) / 2
    assert splat.position[0].tolist() == pytest.approx([expected, (WIDTH - 1) / 2], rel=EXACT)


@with_gates
def test_a_pixel_beyond_the_cut_off_shows_the_background(mode):
    settings = facing_camera(mode, 41, 41)
    image = reference.rasterize(settings=settings, **on_axis([2.0], [0.6], [[1.0, 1.0, 1.0]], variance=0.01)).color
    sigma = math.sqrt(0.01 * (41 / 4) ** 2 + 0.3)
    reach = sigma * math.sqrt(-2 * math.log(least_kernel(mode, 0.6)))
    row = (image[0, 20, 20:] - 0.1).abs() > 1e-9
    assert row.tolist() == [distance <= reach for distance in range(21)]


def test_antialiasing_keeps_the_weight_of_a_splat_smaller_than_a_pixel():
    inputs = on_axis([2.0], [0.5], [[1.0]], variance=1e-3)
    settings = facing_camera("alpha", bg=(0.0,), antialiasing=True)
    variance = 1e-3 * torch.tensor([(11 / 4) ** 2, (7 / 4) ** 2])
    expected = 0.5 * math.sqrt(torch.prod(variance / (variance + 0.3)).item())
    # 1e-6: the expectation is computed in float32.
    assert middle(reference.rasterize(settings=settings, **inputs).color) == pytest.approx([expected], rel=1e-6)
    vanishing = on_axis([2.0], [0.9], [[1.0]], variance=1e-9)
    smallest = 0.9 * math.sqrt(float(torch.tensor(2.5e-5)))
    image = reference.rasterize(settings=settings, outputs=("alpha",), **vanishing)
    assert middle(image.alpha) == pytest.approx([smallest], rel=EXACT)


def test_colours_from_harmonics_are_at_least_zero_without_a_gradient_below():
    inputs = on_axis([DEPTH, 3.0], [0.5, 0.5], [[0.0], [0.0]])
    del inputs["colors_precomp"]
    band0 = math.sqrt(1 / (4 * math.pi))
    inputs["shs"] = torch.tensor([[[-2.0, 1.0, 0.0]], [[0.5, -3.0, 9.0]]], dtype=torch.float64, requires_grad=True)
    color = reference.rasterize(settings=facing_camera("alpha", bg=(0.0, 0.0, 0.0)), **inputs).color
    expected = [0.25 * (0.5 + 0.5 * band0), 0.5 * (0.5 + band0), 0.5 * 0.5 + 0.25 * (0.5 + 9 * band0)]
    assert middle(color) == pytest.approx(expected, rel=EXACT)
    color.sum().backward()
    assert (inputs["shs"].grad[:, 0] != 0).tolist() == [[False, True, True], [True, False, True]]


def test_without_clamp_color_harmonics_may_give_less_than_zero():
    inputs = on_axis([DEPTH, 3.0], [0.5, 0.5], [[0.0], [0.0]])
    del inputs["colors_precomp"]
    band0 = math.sqrt(1 / (4 * math.pi))
    inputs["shs"] = torch.tensor([[[-4.0, 1.0, 0.0]], [[0.5, -9.0, 9.0]]], dtype=torch.float64, requires_grad=True)
    settings = facing_camera("alpha", bg=(0.0, 0.0, 0.0), clamp_color=False)
    color = reference.rasterize(settings=settings, **inputs).color
    expected = [0.5 * (0.5 + front * band0) + 0.25 * (0.5 + behind * band0)
                for front, behind in ((-4.0, 0.5), (1.0, -9.0), (0.0, 9.0))]
    assert expected[0] < 0
    assert middle(color) == pytest.approx(expected, rel=EXACT)
    color.sum().backward()
    gradient = inputs["shs"].grad
    assert (gradient > 0).all() and torch.equal(gradient, gradient[..., :1].expand_as(gradient))


def test_spherical_harmonics_are_orthonormal():
    # Gauss-Legendre in z and the trapezoid rule in longitude integrate products of degree 6 exactly.
    longitude = torch.arange(16, dtype=torch.float64) * 2 * math.pi / 16
    eigenvalues = torch.linalg.eigh(torch.diag(torch.tensor(
        [n / math.sqrt(4 * n * n - 1) for n in range(1, 8)], dtype=torch.float64), 1) + torch.diag(torch.tensor(
            [n / math.sqrt(4 * n * n - 1) for n in range(1, 8)], dtype=torch.float64), -1))
    z, weight = eigenvalues[0], 2 * eigenvalues[1][0] ** 2
    ring = torch.sqrt(1 - z * z)
    directions = torch.stack([ring[:, None] * torch.cos(longitude), ring[:, None] * torch.sin(longitude),
                              z[:, None].expand(-1, 16)], -1).reshape(-1, 3)
    weights = (weight[:, None] * 2 * math.pi / 16).expand(-1, 16).reshape(-1)
    basis = reference.sh_basis(3, 2.5 * directions)
    products = basis.T @ (weights[:, None] * basis)
    assert (products - torch.eye(16, dtype=torch.float64)).abs().max() < EXACT


def test_spherical_harmonics_have_the_signs_of_3dgs():
    signs = {(1.0, 0.0, 0.0): {3: -1, 8: 1, 15: -1}, (0.0, 1.0, 0.0): {1: -1, 8: -1, 9: 1}, (0.0, 0.0, 1.0): {
        2: 1, 6: 1, 12: 1}, (1.0, 1.0, 1.0): {4: 1, 5: -1, 7: -1, 10: 1, 11: -1, 13: -1}, (1.0, 0.0, 1.0): {14: 1}}
    for direction, expected in signs.items():
        basis = reference.sh_basis(3, torch.tensor([direction], dtype=torch.float64))[0]
        assert {index: int(torch.sign(basis[index])) for index in expected} == expected


def test_a_quaternion_turns_the_axes():
    angle, axis = 1.1, torch.tensor([2.0, -1.0, 3.0], dtype=torch.float64) / math.sqrt(14)
    x, y, z = axis.tolist()
    turn = torch.linalg.matrix_exp(angle * torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))
    quaternion = torch.cat([torch.tensor([math.cos(angle / 2)], dtype=torch.float64), math.sin(angle / 2) * axis])
    gaussian = reference.Gaussians(None, None, None, None, None, torch.tensor([[1, 2, 3]], dtype=torch.float64),
                                   quaternion[None], None)
    expected = turn @ torch.diag(torch.tensor([1, 4, 9], dtype=torch.float64)) @ turn.T / 4
    assert_close(reference.covariance3D(gaussian, 0.5)[0], expected, EXACT, "covariance")


def test_scale_modifier_multiplies_scales_but_not_a_given_covariance():
    inputs = on_axis([DEPTH], [0.5], [[1.0]])
    given = render("alpha", inputs, scale_modifier=3.0).color
    assert torch.equal(given, render("alpha", inputs).color)
    del inputs["cov3D_precomp"]
    inputs["rotations"] = torch.tensor([[1, 0, 0, 0]], dtype=torch.float64)
    small = dict(inputs, scales=torch.full((1, 3), 0.1, dtype=torch.float64))
    large = dict(inputs, scales=torch.full((1, 3), 0.3, dtype=torch.float64))
    assert_close(render("alpha", small, scale_modifier=3.0).color, render("alpha", large).color, EXACT, "colour")


@pytest.mark.parametrize("fields, words", [
    (dict(strict=True), r"cov3D_precomp.*\b1\b"), (dict(prefiltered=True), r"prefiltered.*\b2\b")])
def test_strict_and_prefiltered_name_the_index(mode, fields, words):
    inputs = on_axis([DEPTH, DEPTH, -DEPTH], [0.5] * 3, [[1.0]] * 3)
    inputs["cov3D_precomp"][1, 3] = math.nan
    assert (render(mode, inputs).radii > 0).tolist() == [True, False, False]
    with pytest.raises(ValueError, match=words):
        render(mode, inputs, **fields)
