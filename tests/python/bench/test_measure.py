"""Metrics against what follows from their definitions."""
import math
from unittest.mock import Mock

import pytest
import torch

from dsmoe.bench import measure
from dsmoe.bench.measure import Measures, edge_mask, edge_psnr
from dsmoe.results.evaluation import summary


def step_image(height=24, width=32, column=16, low=0.2, high=0.8):
    """Grey, with one vertical step: columns from `column` on are `high`."""
    image = torch.full((3, height, width), low)
    image[:, :, column:] = high
    return image


def test_the_edge_mask_reaches_three_pixels_from_the_step():
    # The Sobel filter sees the step from columns 15 and 16, one on each side; three more on either side are near.
    assert edge_mask(step_image()).all(dim=0).nonzero().flatten().tolist() == list(range(12, 20))
    assert edge_mask(step_image())[:, :12].sum() == 0


def test_edge_psnr_looks_at_the_edges_alone():
    target = step_image()
    far, near = target.clone(), target.clone()
    far[:, :, :12] += 0.1
    near[:, :, 12:20] += 0.1
    assert edge_psnr(far, target) == math.inf
    # An error of 0.1 in every pixel of the mask: 20 dB, up to the rounding of float32.
    assert edge_psnr(near, target) == pytest.approx(20, abs=1e-4)


def test_edge_pixels_are_found_in_luminance():
    """Red and blue of equal luminance 0.299 r = 0.114 b make no edge; red and black do."""
    blue = 0.9
    image = torch.zeros(3, 24, 32)
    image[0, :, :16], image[2, :, 16:] = blue * 0.114 / 0.299, blue
    assert not edge_mask(image).any()
    image[2] = 0
    assert edge_mask(image).any()


def test_views_without_a_metric_do_not_count_in_its_mean():
    flat, step = ({"name": "view", "milliseconds": 1.0, **Measures("cpu")(image * 0.9, image)}
                  for image in (step_image(high=0.2), step_image()))
    assert flat["psnr_edge"] is None and summary([flat, step]).metrics["psnr_edge"] == step["psnr_edge"] > 0
    assert math.isnan(Measures("cpu")(step_image() * math.nan, step_image())["psnr"])
    nothing = summary([])
    assert nothing.fps is None and set(nothing.metrics.values()) == {None}


def test_what_a_mask_ignores_changes_no_metric():
    target = step_image()
    mask = torch.zeros_like(target[:1])
    mask[..., :target.shape[2] // 2 + 4] = 1  # with the edge
    other = torch.where(mask > 0, target * 0.9, 1 - target)
    assert Measures("cpu")(target * 0.9, target, mask) == Measures("cpu")(other, target, mask)
    assert edge_psnr(other, target, torch.zeros_like(mask)) is None


@pytest.mark.parametrize("answers, value, reason", [
    ([0.25, 0.75], 0.5, None), ([0.25, math.nan, 0.75], None, "ValueError: it is nan"),
    ([0.25, RuntimeError("CUDA out of memory"), 0.75], None, "RuntimeError: CUDA out of memory")])
def test_lpips_is_a_mean_over_all_views_or_none(answers, value, reason, monkeypatch):
    monkeypatch.setattr(measure, "lpips_network", lambda kind, device: Mock(side_effect=answers))
    measures = Measures("cpu", ["lpips_alex"])
    per_view = [{"name": "view", "milliseconds": 1.0, **measures(step_image(), step_image(low=0.1))} for _ in answers]
    assert measures.lpips_of(summary(per_view).metrics) == [{"value": value, "kind": "lpips_alex", "reason": reason}]
