"""SSIM and the loss against a direct two-dimensional convolution in double precision, and metrics by hand."""
from __future__ import annotations

import math

import pytest
import torch

from diff_smoe_rasterization.trainer.losses import ssim, target_moments, training_loss
from diff_smoe_rasterization.trainer.metrics import image_metrics, psnr, quantised


def direct_ssim(x, y):
    """Wang et al. 2004 as written: one 11x11 Gaussian window of sigma 1.5, zeros outside, x and y [3, H, W]."""
    grid = torch.arange(11, dtype=x.dtype) - 5
    window = torch.exp(-(grid[:, None] ** 2 + grid[None, :] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[None, None]

    def mean(image):
        return torch.nn.functional.conv2d(image[:, None], window, padding=5)[:, 0]

    mu_x, mu_y = mean(x), mean(y)
    var_x, var_y, cov = mean(x * x) - mu_x**2, mean(y * y) - mu_y**2, mean(x * y) - mu_x * mu_y
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mu_x * mu_y + c1) * (2 * cov + c2) / ((mu_x**2 + mu_y**2 + c1) * (var_x + var_y + c2))).mean()


@pytest.fixture
def pair():
    """Two related images, no side a multiple of the window."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(3, 17, 23, dtype=torch.float64, generator=generator)
    noise = torch.rand(3, 17, 23, dtype=torch.float64, generator=generator)
    return 0.7 * target + 0.3 * noise, target


def test_ssim_equals_the_direct_convolution(pair):
    image, target = pair
    # The same sums in double, in another order.
    assert float(ssim(image, target_moments(target))) == pytest.approx(float(direct_ssim(image, target)), abs=1e-12)


def test_ssim_in_single_precision(pair):
    image, target = (tensor.float() for tensor in pair)
    # Differences of moments of order 1 lose some units in the 7th digit, over a variance of 0.05.
    assert float(ssim(image, target_moments(target))) == pytest.approx(float(direct_ssim(*pair)), abs=1e-5)


def test_ssim_of_equal_images_is_one(pair):
    assert float(ssim(pair[1], target_moments(pair[1]))) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (3, 40), (17, 23)])
def test_ssim_gradient_equals_autograd_through_the_direct_form(size):
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(3, *size, dtype=torch.float64, generator=generator, requires_grad=True)
    target = torch.rand(3, *size, dtype=torch.float64, generator=generator)
    expected, = torch.autograd.grad(direct_ssim(image, target), image)
    actual, = torch.autograd.grad(ssim(image, target_moments(target)), image)
    assert expected.abs().max() > 0
    torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-12)  # doubles, sums in another order


def test_ssim_gradient_by_finite_differences(pair):
    image, target = (tensor[:, :6, :7].contiguous() for tensor in pair)
    moments = target_moments(target)
    assert torch.autograd.gradcheck(lambda x: ssim(x, moments), image.clone().requires_grad_())


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_mixes_l1_and_dssim(pair, weight):
    image, target = pair
    expected = (1 - weight) * (image - target).abs().mean() + weight * (1 - direct_ssim(image, target))
    assert float(training_loss(image, target_moments(target), weight)) == pytest.approx(float(expected), abs=1e-12)


def test_psnr_by_hand():
    target = torch.full((3, 4, 5), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)  # MSE 0.01 in float32
    assert psnr(target, target) == math.inf


def test_psnr_averages_the_error_before_the_logarithm():
    target = torch.zeros(3, 4, 4)
    image = target.clone()
    image[0] = 0.1
    # MSE 0.01 in one channel of three; the mean of per-channel PSNRs would be infinite.
    assert psnr(image, target) == pytest.approx(-10 * math.log10(0.01 / 3), abs=1e-4)


def test_quantised_rounds_as_an_8_bit_file():
    values = torch.tensor([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 100.4 / 255, 1.0, 7.0])
    torch.testing.assert_close(quantised(values) * 255, torch.tensor([0.0, 0, 0, 1, 100, 255, 255]))


def test_metrics_use_quantised_images_for_the_headline():
    target = torch.full((3, 12, 12), 100 / 255)
    metrics = image_metrics(torch.full((3, 12, 12), 100.4 / 255), target)
    assert metrics["psnr"] > 100, "0.4 of a level is lost in the file"
    assert metrics["psnr_float"] == pytest.approx(-20 * math.log10(0.4 / 255), abs=0.01)
