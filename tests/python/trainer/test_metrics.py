"""Metrics of rendered images by hand."""
from __future__ import annotations

import math

import pytest
import torch

from diff_smoe_rasterization.trainer.metrics import image_metrics, psnr, quantised


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
