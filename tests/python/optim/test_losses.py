"""SSIM and the training loss against a direct two-dimensional convolution in double, on every device."""
from __future__ import annotations

import numpy as np
import pytest
import torch
from devices import on_the_cpu

from diff_smoe_rasterization.losses import (
    fused_ssim,
    l1_ssim_loss,
    l1_ssim_loss_and_gradient,
    l2_ssim_loss_and_gradient,
)


def ssim_map(x, y, padding="same"):
    """Wang et al. 2004 as written: one 11x11 Gaussian window of sigma 1.5, zeros outside. x, y: [B, C, H, W]."""
    grid = torch.arange(11, dtype=x.dtype) - 5
    window = torch.exp(-(grid[:, None] ** 2 + grid[None, :] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[None, None]

    def mean(image):
        planes = image.reshape(-1, 1, *image.shape[-2:])
        return torch.nn.functional.conv2d(planes, window, padding=5 if padding == "same" else 0)

    mu_x, mu_y = mean(x), mean(y)
    var_x, var_y, cov = mean(x * x) - mu_x**2, mean(y * y) - mu_y**2, mean(x * y) - mu_x * mu_y
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mu_x * mu_y + c1) * (2 * cov + c2) / ((mu_x**2 + mu_y**2 + c1) * (var_x + var_y + c2))


def direct_ssim(x, y, padding="same"):
    return ssim_map(x, y, padding).mean()


def direct_loss(x, y, weight):
    return (1 - weight) * (x - y).abs().mean() + weight * (1 - direct_ssim(x, y))


def image_pair(shape, seed=0):
    """Two related images of doubles on the CPU."""
    with on_the_cpu():
        generator = torch.Generator().manual_seed(seed)
        target = torch.rand(shape, dtype=torch.float64, generator=generator)
        noise = torch.rand(shape, dtype=torch.float64, generator=generator)
        return 0.7 * target + 0.3 * noise, target


def direct_gradient(function, x, *arguments):
    """Value and gradient by x through torch's autograd, on the CPU."""
    with on_the_cpu():
        x = x.clone().requires_grad_()
        value = function(x, *arguments)
        return value.detach(), torch.autograd.grad(value, x)[0]


# One pixel; thinner than the window; no side a multiple of a GPU tile's 16 or 32 or of a CPU band's 64 rows, whole
# tiles, several bands.
SHAPES = [(3, 1, 1), (1, 3, 40), (3, 17, 23), (1, 64, 32), (2, 3, 33, 65), (1, 131, 70)]


def assert_close(actual, expected, dtype):
    """In double the same sums in another order; float32 loses digits if moments of order 1 are subtracted."""
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    torch.testing.assert_close(actual.detach().cpu().double(), expected, rtol=0,
                               atol=tolerance * max(float(expected.abs().max()), 1e-3))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", SHAPES)
def test_ssim_and_its_gradient_are_those_of_the_direct_form(device, dtype, shape):
    image, target = image_pair(shape)
    expected, expected_gradient = direct_gradient(direct_ssim, image, target)
    x = image.to(device, dtype).requires_grad_()
    actual = fused_ssim(x, target.to(device, dtype))
    assert actual.dim() == 0 and actual.device.type == device.type
    assert_close(actual, expected, dtype)
    gradient, = torch.autograd.grad(actual, x)
    assert expected_gradient.abs().max() > 0
    assert_close(gradient, expected_gradient, dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_loss_mixes_l1_and_dssim(device, dtype, weight):
    image, target = image_pair((3, 50, 37))
    expected, expected_gradient = direct_gradient(direct_loss, image, target, weight)
    x, y = image.to(device, dtype).requires_grad_(), target.to(device, dtype)
    loss = l1_ssim_loss(x, y, weight)
    assert_close(loss, expected, dtype)
    assert_close(torch.autograd.grad(loss, x)[0], expected_gradient, dtype)
    loss, gradient = l1_ssim_loss_and_gradient(x, y, weight)
    assert not loss.requires_grad and not gradient.requires_grad
    assert_close(loss, expected, dtype)
    assert_close(gradient, expected_gradient, dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_square_stands_in_for_l1(device, dtype):
    image, target = image_pair((3, 50, 37))
    expected, expected_gradient = direct_gradient(
        lambda x: 0.7 * 4 * (x - target).square().mean() + 0.3 * (1 - direct_ssim(x, target)), image)
    loss, gradient = l2_ssim_loss_and_gradient(image.to(device, dtype), target.to(device, dtype), 0.3, 4.0)
    assert_close(loss, expected, dtype)
    assert_close(gradient, expected_gradient, dtype)


@pytest.mark.parametrize("function", [l1_ssim_loss_and_gradient,
                                      lambda x, y: l2_ssim_loss_and_gradient(x, y, 0.2, 15.0)])
def test_a_target_of_bytes_is_one_of_255ths(device, function):
    image, _ = image_pair((3, 40, 45))
    with on_the_cpu():
        target = torch.randint(0, 256, (3, 40, 45), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    x = image.to(device, torch.float32)
    loss, gradient = function(x, target.to(device))
    expected, expected_gradient = function(x, target.to(device).float() / 255)
    torch.testing.assert_close(loss, expected, rtol=1e-6, atol=0.0)
    # A GPU may contract the division into what follows: an ulp of the target, 6e-8, in gradients of 1 / numbers.
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-4, atol=1e-4 / image.numel())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(3, 20, 40), (1, 4, 8), (1, 3, 2)])
def test_windows_go_around(device, dtype, shape):
    """SSIM of the middle one of copies side by side; there are more of images that are narrower than a window."""
    copies, width = 7, shape[-1]
    middle = slice(copies // 2 * width, (copies // 2 + 1) * width)

    def similarity(x, y):
        return ssim_map(*(image.repeat(1, 1, copies) for image in (x, y)))[..., middle].mean()

    def loss(x, y, l1, l2):
        return l1 * (x - y).abs().mean() + l2 * (x - y).square().mean() + 0.3 * (1 - similarity(x, y))

    image, target = image_pair(shape)
    x, y = image.to(device, dtype).requires_grad_(), target.to(device, dtype)
    for l1, l2, found in ((0.7, 0, l1_ssim_loss_and_gradient(x, y, 0.3, "around")),
                          (0, 2.8, l2_ssim_loss_and_gradient(x, y, 0.3, 4.0, "around"))):
        for actual, expected in zip(found, direct_gradient(loss, image, target, l1, l2)):
            assert_close(actual, expected, dtype)
    for actual, function, arguments in ((fused_ssim(x, y, "around"), similarity, ()),
                                        (l1_ssim_loss(x, y, 0.3, "around"), loss, (0.7, 0))):
        expected, expected_gradient = direct_gradient(function, image, target, *arguments)
        assert_close(actual, expected, dtype)
        assert_close(torch.autograd.grad(actual, x)[0], expected_gradient, dtype)


@pytest.mark.parametrize("function, weights", [
    (fused_ssim, (0, 0, 0, 1)), (l1_ssim_loss, (0.7, 0, 0.3, -0.3)), (l1_ssim_loss_and_gradient, (0.7, 0, 0.3, -0.3)),
    (l2_ssim_loss_and_gradient, (0, 0.7 * 4, 0.3, -0.3))])
def test_valid_padding_leaves_out_windows_that_reach_outside(device, function, weights):
    """weights: of the L1 and the L2 part, both over all pixels, of 1, and of SSIM."""
    numbers = () if function is fused_ssim else (0.3, 4.0) if function is l2_ssim_loss_and_gradient else (0.3,)

    def direct(x, y):
        l1, l2, one, ssim = weights
        return l1 * (x - y).abs().mean() + l2 * (x - y).square().mean() + one + ssim * direct_ssim(x, y, "valid")

    for shape in ((3, 11, 11), (2, 3, 40, 21)):
        image, target = image_pair(shape)
        x, y = image.to(device).requires_grad_(), target.to(device)
        found = function(x, y, *numbers, padding="valid")
        if isinstance(found, torch.Tensor):
            found = found, torch.autograd.grad(found, x)[0]
        for actual, expected in zip(found, direct_gradient(direct, image, target)):
            assert_close(actual, expected, torch.float64)
    with pytest.raises(ValueError, match="its sides must be at least 11"):
        function(x[..., :10, :].detach(), y[..., :10, :], *numbers, padding="valid")
    for wrong in ("zero", None, 5):
        with pytest.raises(ValueError, match=f"{function.__name__}: padding is {wrong!r}; it must be one of same, val"):
            function(x, y, *numbers, padding=wrong)


def test_gradient_by_finite_differences(device):
    image, target = (tensor[:, :6, :7].to(device) for tensor in image_pair((2, 17, 23)))
    assert torch.autograd.gradcheck(lambda x: l1_ssim_loss(x, target, 0.3), image.contiguous().requires_grad_())


def test_the_gradient_is_scaled_by_what_comes_in(device):
    image, target = (tensor.to(device) for tensor in image_pair((3, 20, 20)))
    x = image.requires_grad_()
    once, = torch.autograd.grad(l1_ssim_loss(x, target), x)
    scaled, = torch.autograd.grad(-3 * l1_ssim_loss(x, target), x)
    torch.testing.assert_close(scaled, -3 * once, rtol=1e-15, atol=0)


def test_ssim_of_equal_images_is_one(device):
    _, target = image_pair((3, 30, 41))
    target = target.to(device)
    assert float(fused_ssim(target, target)) == pytest.approx(1.0, abs=1e-12)
    # |x - y| has the derivative 0 at 0, as torch has it, and SSIM is at its largest.
    loss, gradient = l1_ssim_loss_and_gradient(target, target, 0.2)
    assert float(loss) == pytest.approx(0.0, abs=1e-12)
    assert float(gradient.abs().max()) < 1e-12


def test_images_need_not_be_dense(device):
    image, target = (tensor.to(device) for tensor in image_pair((3, 20, 30)))
    expected = l1_ssim_loss(image, target)
    transposed = image.transpose(1, 2).contiguous().transpose(1, 2)
    assert not transposed.is_contiguous()
    assert torch.equal(l1_ssim_loss(transposed, target), expected)
    assert torch.equal(l1_ssim_loss(image, target.repeat(1, 1, 2)[:, :, :30]), expected)


def test_no_gradient_is_kept_where_none_is_wanted(device):
    image, target = (tensor.to(device) for tensor in image_pair((3, 20, 20)))
    x = image.requires_grad_()
    assert not fused_ssim(x, target, train=False).requires_grad
    with torch.no_grad():
        assert not fused_ssim(x, target).requires_grad


def test_the_same_bits_every_time(device):
    image, target = (tensor.to(device, torch.float32) for tensor in image_pair((3, 150, 200)))
    first, second = (l1_ssim_loss_and_gradient(image, target) for _ in range(2))
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])


def test_what_does_not_fit_is_refused(device):
    image = torch.rand(3, 20, 20)
    for target, error, text in (
            (torch.rand(3, 20, 21), ValueError, r"target has shape \[3, 20, 21\]"),
            (torch.rand(3, 20, 20).double(), TypeError, "target is float64; it must be float32"),
            (torch.rand(3, 20, 20).requires_grad_(), ValueError, "target requires a gradient")):
        with pytest.raises(error, match=text):
            l1_ssim_loss(image, target)
    with pytest.raises(TypeError, match="image is float16"):
        l1_ssim_loss(image.half(), image.half())
    with pytest.raises(ValueError, match="margin is 4611686018427387904; it must be 0 to"):  # twice that wraps to 0
        torch.ops.diff_smoe_rasterization.image_loss(image.detach(), image.detach(), 0.5, 0.0, 0.5, 0.0, 2 ** 62, False)
    with pytest.raises(ValueError, match="at least one pixel"):
        l1_ssim_loss(image[:0], image[:0])


@pytest.mark.parametrize("wrong", [None, 1, "a", [1.0], np.zeros((3, 20, 20), np.float32)])
def test_what_is_no_tensor_or_no_number_is_named(wrong):
    image, kind = torch.rand(3, 20, 20), type(wrong).__name__
    for function, names in ((l1_ssim_loss, ("image", "target")), (fused_ssim, ("img1", "img2")),
                            (l1_ssim_loss_and_gradient, ("image", "target")),
                            (l2_ssim_loss_and_gradient, ("image", "target"))):
        numbers = (0.2, 1.0) if function is l2_ssim_loss_and_gradient else ()
        for name, arguments in zip(names, ((wrong, image), (image, wrong))):
            with pytest.raises(TypeError, match=f"{function.__name__}: {name} is of type {kind}; it must be a torch"):
                function(*arguments, *numbers)
        if function is not fused_ssim and not isinstance(wrong, int):
            with pytest.raises(TypeError, match=f"{function.__name__}: lambda_dssim is of type {kind}; it must be a n"):
                function(image, image, wrong, *numbers[1:])
    if not isinstance(wrong, int):
        with pytest.raises(TypeError, match=f"l2_ssim_loss_and_gradient: weight is of type {kind}; it must be a n"):
            l2_ssim_loss_and_gradient(image, image, 0.2, wrong)
