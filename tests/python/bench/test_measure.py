"""Metrics against what follows from their definitions."""
from __future__ import annotations

import json
import math

import numpy as np
import pytest
import real_data
import torch

from diff_smoe_rasterization.benchmarks import measure
from diff_smoe_rasterization.benchmarks.errors import BenchError
from diff_smoe_rasterization.benchmarks.measure import Measures, edge_mask, edge_psnr, headline_lpips
from diff_smoe_rasterization.trainer.evaluation import summary


def step_image(height=24, width=32, column=16, low=0.2, high=0.8):
    """Grey, with one vertical step: columns from `column` on are `high`."""
    image = torch.full((3, height, width), low)
    image[:, :, column:] = high
    return image


def test_the_edge_mask_reaches_three_pixels_from_the_step():
    # The Sobel filter sees the step from columns 15 and 16, one on each side; three more on either side are near.
    assert edge_mask(step_image()).all(dim=0).nonzero().flatten().tolist() == list(range(12, 20))
    assert edge_mask(step_image())[:, :12].sum() == 0


def test_a_gentle_ramp_has_no_edges_and_a_steep_one_has_everywhere():
    ramp = torch.arange(32.0).expand(3, 24, 32)
    assert edge_psnr(ramp * 0.04, ramp * 0.04 + 0.1) is None
    # In the outermost columns the replicated border halves the gradient; three pixels further in it is full.
    assert edge_mask(ramp * 0.06).all()


def test_edge_psnr_looks_at_the_edges_alone():
    target = step_image()
    image = target.clone()
    image[:, :, :12] += 0.1  # far from the edge
    assert edge_psnr(image, target) == math.inf
    image = target.clone()
    image[:, :, 12:20] += 0.1
    # An error of 0.1 in every pixel of the mask: 20 dB, up to the rounding of float32.
    assert edge_psnr(image, target) == pytest.approx(20, abs=1e-4)


def test_edge_pixels_are_found_in_luminance():
    """Red and blue of equal luminance 0.299 r = 0.114 b make no edge; red and black do."""
    blue = 0.9
    image = torch.zeros(3, 24, 32)
    image[0, :, :16], image[2, :, 16:] = blue * 0.114 / 0.299, blue
    assert not edge_mask(image).any()
    image[2] = 0
    assert edge_mask(image).any()


def test_measures_have_the_trainers_metrics_and_more():
    target = step_image()
    found = Measures("cpu")(target + 0.001, target)
    assert set(found) == {"psnr", "ssim", "psnr_float", "psnr_edge"}
    assert found["psnr"] == found["psnr_edge"] == math.inf  # a thousandth is rounded away in 8 bits
    assert found["psnr_float"] == pytest.approx(60, abs=0.01)  # float32 holds 0.801 - 0.8 to 6e-8


def test_an_unknown_kind_of_lpips_is_refused():
    with pytest.raises(BenchError, match="lpips_squeeze"):
        Measures("cpu", ["lpips_squeeze"])


def test_lpips_without_weights_is_null_with_the_reason(monkeypatch, tmp_path):
    monkeypatch.setenv(measure.ALEX_VARIABLE, str(tmp_path / "absent.npz"))
    measures = Measures("cpu", ["lpips_alex"])
    row, = measures.lpips_of(measures(step_image(), step_image()))
    assert row["value"] is None and row["kind"] == "lpips_alex" and "absent.npz" in row["reason"]


def test_lpips_of_a_damaged_file_names_what_is_missing(monkeypatch, tmp_path):
    path = tmp_path / "weights.npz"
    np.savez(path, **{"conv1.weight": np.zeros(3)})
    monkeypatch.setenv(measure.ALEX_VARIABLE, str(path))
    row, = Measures("cpu", ["lpips_alex"]).lpips_of({})
    assert "conv1.bias" in row["reason"]


def test_the_first_kind_with_a_value_is_the_headline():
    rows = [{"value": None, "kind": "a", "reason": "x"}, {"value": 0.1, "kind": "b", "reason": None}]
    assert headline_lpips(rows)["kind"] == "b"
    assert headline_lpips(rows[:1])["kind"] == "a"
    assert headline_lpips([])["value"] is None


def made_up_weights(path, seed=0):
    """An AlexNet of the right shapes with random weights."""
    random = np.random.RandomState(seed)
    shapes = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
    arrays = {}
    for layer, (outputs, inputs, side) in enumerate(shapes):
        arrays[f"conv{layer + 1}.weight"] = random.randn(outputs, inputs, side, side).astype(np.float32) / side
        arrays[f"conv{layer + 1}.bias"] = random.randn(outputs).astype(np.float32)
        arrays[f"lin{layer}.weight"] = random.rand(outputs).astype(np.float32)
    np.savez(path, **arrays)
    return arrays


def lpips_by_modules(arrays, image, target):
    """LPIPS by torch's modules, in torchvision's order of AlexNet's layers, in float64."""
    nn = torch.nn
    layers = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(),
              nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(), nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(),
              nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU()]
    convolutions = [layer for layer in layers if isinstance(layer, nn.Conv2d)]
    for index, layer in enumerate(convolutions):
        layer.weight = nn.Parameter(torch.from_numpy(arrays[f"conv{index + 1}.weight"]))
        layer.bias = nn.Parameter(torch.from_numpy(arrays[f"conv{index + 1}.bias"]))
    mean, deviation = (np.array(values)[:, None, None] for values in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))
    total, index = 0.0, 0
    with torch.no_grad():
        a, b = (torch.from_numpy((x.double().numpy() - mean) / deviation)[None] for x in (image, target))
        for layer in layers:
            a, b = layer.double()(a), layer(b)
            if isinstance(layer, nn.ReLU):
                unit_a, unit_b = (nn.functional.normalize(x, dim=1).numpy()[0] for x in (a, b))
                weight = arrays[f"lin{index}.weight"].astype(np.float64)[:, None, None]
                total += float((weight * (unit_a - unit_b) ** 2).sum(axis=0).mean())
                index += 1
    assert index == 5
    return total


@pytest.fixture(params=["made up", "published"])
def alex_weights(request, tmp_path):
    path = tmp_path / "weights.npz"
    if request.param == "made up":
        made_up_weights(path)
        return str(path)
    folder = real_data.folder("bonsai")
    return folder.replace("bonsai", "lpips_alex_v01.npz")


def test_lpips_alex_agrees_with_torchs_modules(alex_weights):
    """[0, 1] normalised by ImageNet's mean and deviation is [-1, 1] shifted and scaled as LPIPS has it."""
    random = np.random.RandomState(1)
    image, target = (torch.from_numpy(random.rand(3, 64, 72).astype(np.float32)) for _ in range(2))
    network = measure.AlexLpips(alex_weights, "cpu")
    assert network(image, image) == 0
    with np.load(alex_weights) as file:
        expected = lpips_by_modules({name: file[name] for name in file.files}, image, target)
    # The float32 network is 1e-5 off the float64 one: sums of some thousand terms.
    assert network(image, target) == pytest.approx(expected, rel=1e-4)
    closer = 0.9 * target + 0.1 * image
    assert network(closer, target) < network(image, target)


def test_an_image_too_small_for_the_network_has_no_lpips(monkeypatch, tmp_path):
    made_up_weights(tmp_path / "weights.npz")
    monkeypatch.setenv(measure.ALEX_VARIABLE, str(tmp_path / "weights.npz"))
    measures = Measures("cpu", ["lpips_alex"])
    found = measures(step_image(8, 8, 4), step_image(8, 8, 4))
    assert found["lpips_alex"] is None
    assert "RuntimeError" in measures.lpips_of(found)[0]["reason"]


def test_where_alexnets_weights_may_be_is_said(monkeypatch):
    def offline(kind, device):
        raise OSError("no network")

    monkeypatch.setattr(measure, "lpips_network", offline)
    alex, vgg = Measures("cpu", ["lpips_alex", "lpips_vgg_std"]).lpips_of({})
    assert alex["reason"] == "no weights at hand: OSError: no network ($DSMOE_LPIPS_ALEX may name a file of them)"
    assert vgg["reason"] == "no weights at hand: OSError: no network"


def test_means_count_each_view_once_and_fps_is_the_inverse_of_the_mean_time():
    rows = [{"name": "a", "milliseconds": 10.0, "psnr": 20.0, "ssim": 0.5, "psnr_float": 21.0, "psnr_edge": None},
            {"name": "b", "milliseconds": 30.0, "psnr": 30.0, "ssim": 0.7, "psnr_float": 31.0, "psnr_edge": 15.0}]
    found = summary(rows)
    assert found.metrics == {"psnr": 25.0, "ssim": 0.6, "psnr_float": 26.0, "psnr_edge": 15.0}
    assert found.fps == pytest.approx(50.0)  # not 66.7, the mean of 100 and 33.3
    nothing = summary([])
    assert nothing.fps is None and set(nothing.metrics.values()) == {None}
    assert json.dumps(nothing.metrics)
