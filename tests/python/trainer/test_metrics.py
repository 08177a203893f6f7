"""Metrics of rendered images by hand."""
from __future__ import annotations

import math

import pytest
import torch

from diff_smoe_rasterization.losses import fused_ssim
from dsmoe.errors import TrainerError
from dsmoe.results.evaluation import summary
from dsmoe.results.metrics import image_metrics, masked_ssim, psnr, quantised


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


def test_a_mask_says_which_pixels_count_and_how_much():
    target = torch.zeros(3, 2, 2)
    image = torch.tensor([[0.1, 0.2], [1.0, 0.0]]).expand(3, 2, 2)
    mask = torch.tensor([[[1.0, 0.5], [0.0, 0.5]]])
    # Squared errors 0.01 and 0.04, weights 1 and 0.5, of weights that sum to 2.
    assert psnr(image, target, mask) == pytest.approx(-10 * math.log10((0.01 + 0.02) / 2), abs=1e-4)  # float32
    assert psnr(image * mask.ceil(), target, mask.ceil()) == pytest.approx(-10 * math.log10(0.05 / 3), abs=1e-4)


def test_masked_ssim_is_that_of_the_masked_pair_over_the_kept_pixels():
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 3, 30, 40, generator=generator).unbind(0)
    # Everything kept: the kernel's own mean. float32 loses digits if moments are subtracted.
    everything = torch.ones(1, 30, 40)
    for padding in ("same", "around"):
        expected = float(fused_ssim(image, target, padding))
        assert masked_ssim(image, target, everything, padding) == pytest.approx(expected, abs=1e-5)
    # A kept rectangle in black: windows see zeros behind it, as behind the border of the rectangle alone.
    mask = torch.zeros(1, 30, 40)
    mask[:, 5:21, 8:33] = 1
    inside = [picture[:, 5:21, 8:33] for picture in (image, target)]
    assert masked_ssim(image, target, mask) == pytest.approx(float(fused_ssim(*inside)), abs=1e-5)
    metrics = image_metrics(image, target, mask)
    quantised_pair = (quantised(inside[0]), inside[1])
    assert metrics["ssim"] == pytest.approx(float(fused_ssim(*quantised_pair)), abs=1e-5)
    assert metrics["psnr"] == pytest.approx(psnr(*quantised_pair), abs=1e-9)  # the same doubles in another order
    assert metrics["psnr_float"] == pytest.approx(psnr(*inside), abs=1e-9)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_rendering_with_a_pixel_that_is_no_number_has_no_figures(value):
    """One such pixel is enough; the view is named."""
    target = torch.full((3, 24, 32), 51 / 255)
    broken = target.clone()
    broken[1, 3, 4] = value
    one, two = ({"name": name, "milliseconds": 1.0, **image_metrics(image, target)}
                for name, image in (("one", target), ("two", broken)))
    assert all(math.isnan(two[name]) for name in ("psnr", "ssim", "psnr_float"))
    with pytest.raises(TrainerError, match="^the rendering of two has NaN or infinite pixels$"):
        summary([one, two])
    assert summary([one]).metrics["psnr"] == math.inf
