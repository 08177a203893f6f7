"""Metrics against what follows from their definitions; LPIPS from files of weights."""
import math
from unittest.mock import Mock

import numpy as np
import pytest
import real_data
import torch

from dsmoe.bench import measure
from dsmoe.bench.errors import BenchError
from dsmoe.bench.lpips import lpips_network
from dsmoe.bench.measure import Measures, edge_mask, edge_psnr
from dsmoe.bench.names import check_weights
from dsmoe.errors import TrainerError
from dsmoe.results.evaluation import summary
from dsmoe.results.metrics import quantised


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


def test_weights_that_are_named_and_not_there_are_refused_where_they_are_wanted(monkeypatch, tmp_path):
    monkeypatch.setenv("DSMOE_LPIPS_ALEX", str(tmp_path / "absent.npz"))
    check_weights(["lpips_vgg_std"])
    with pytest.raises(BenchError, match="DSMOE_LPIPS_ALEX: .*absent.npz: no such file, where the weights of lpips_al"):
        check_weights(["lpips_vgg_std", "lpips_alex"])
    (tmp_path / "absent.npz").touch()
    check_weights(["lpips_alex"])


@pytest.mark.parametrize("content, said", [
    (b"", "is not a .npz file that can be read (EOFError)"),
    (b"some words", "is not a .npz file that can be read"),
    (b"PK\x03\x04 and no more", "is not a .npz file that can be read"),
    ({"conv1.weight": np.zeros((8, 3, 11, 11))}, "conv1.bias is missing; it must have shape [8]"),
    ({"conv1.weight": np.zeros((8, 3, 3, 3)), "conv1.bias": np.zeros(8)},
     "conv1.weight has shape [8, 3, 3, 3]; it must have shape [8, 3, 11, 11]")])
def test_a_file_that_does_not_fit_is_the_reason(monkeypatch, tmp_path, content, said):
    path = tmp_path / "weights.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, **content)
    monkeypatch.setenv("DSMOE_LPIPS_ALEX", str(path))
    row, = Measures("cpu", ["lpips_alex"]).lpips_of({})
    assert row["value"] is None and row["reason"].startswith(f"$DSMOE_LPIPS_ALEX: ValueError: {path}")
    assert said in row["reason"]


# torchvision's networks: (channels, kernel's side, stride, padding) of convolutions, of VGG an eighth of the channels;
# (side, stride) of maximum poolings; None: LPIPS looks there.
NETWORKS = {"alex": [(64, 11, 4, 2), None, (3, 2), (192, 5, 1, 2), None, (3, 2), (384, 3, 1, 1), None,
                     (256, 3, 1, 1), None, (256, 3, 1, 1), None],
            "vgg": [*2 * [(8, 3, 1, 1)], None, (2, 2), *2 * [(16, 3, 1, 1)], None, (2, 2), *3 * [(32, 3, 1, 1)], None,
                    (2, 2), *3 * [(64, 3, 1, 1)], None, (2, 2), *3 * [(64, 3, 1, 1)], None]}


def made_up_weights(path, net):
    """Random weights of the right shapes. LPIPS looks right behind convolutions."""
    random, arrays, inputs, parts = np.random.RandomState(0), {}, 3, NETWORKS[net]
    for layer, (channels, side, _, _) in enumerate((part for part in parts if len(part or ()) == 4), 1):
        arrays[f"conv{layer}.weight"] = random.randn(channels, inputs, side, side) / (side * inputs ** 0.5)
        arrays[f"conv{layer}.bias"], inputs = random.randn(channels), channels
    for look, part in enumerate(before for before, part in zip(parts, parts[1:]) if part is None):
        arrays[f"lin{look}.weight"] = random.rand(part[0])
    np.savez(path, **{name: array.astype(np.float32) for name, array in arrays.items()})


def lpips_in_double(net, arrays, image, target, normalise):
    """LPIPS by its definition, in float64."""
    # Of [0, 1], ImageNet's mean and deviation; of [-1, 1] as LPIPS prints them, rounded.
    mean, deviation = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]) if normalise else \
        ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450])
    arrays = {name: torch.from_numpy(array).double() for name, array in arrays.items()}
    x = torch.stack([image, target]).double() - torch.tensor(mean).double()[:, None, None]
    x /= torch.tensor(deviation)[:, None, None]
    total, layer, looks = 0.0, 0, 0
    for part in NETWORKS[net]:
        if part is None:
            a, b = torch.nn.functional.normalize(x, dim=1)
            total += float((arrays[f"lin{looks}.weight"].reshape(-1, 1, 1) * (a - b) ** 2).sum(dim=0).mean())
            looks += 1
        elif len(part) == 2:
            x = torch.nn.functional.max_pool2d(x, *part)
        else:
            layer += 1
            x = torch.conv2d(x, arrays[f"conv{layer}.weight"], arrays[f"conv{layer}.bias"], *part[2:]).relu()
    return total


@pytest.mark.parametrize("kind, weights", [("lpips_alex", "published"), ("lpips_alex", "made up"),
                                           ("lpips_vgg_std", "made up"), ("lpips_vgg_inria", "made up")])
def test_lpips_of_a_file_agrees_with_the_definition(kind, weights, tmp_path, monkeypatch):
    """Of 8-bit images. [0, 1] normalised by ImageNet's figures is [-1, 1] shifted and scaled as LPIPS has it."""
    net = kind.split("_")[1]
    path = str(tmp_path / "weights.npz")
    if weights == "made up":
        made_up_weights(path, net)
    else:
        path = real_data.folder("lpips_alex_v01.npz")
    monkeypatch.setenv(f"DSMOE_LPIPS_{net.upper()}", path)
    measures = Measures("cpu", [kind])
    image, target = torch.from_numpy(np.random.RandomState(1).rand(2, 3, 64, 72).astype(np.float32))
    image *= 1.2  # a rendering may exceed 1, its file does not
    assert measures(quantised(image), quantised(image))[kind] == 0
    with np.load(path) as file:
        expected = lpips_in_double(net, dict(file), quantised(image), target, normalise=kind != "lpips_vgg_inria")
    # The float32 network is 1e-5 off the float64 one: sums of some thousand terms.
    assert measures(image, target)[kind] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("net", NETWORKS)
def test_images_too_small_for_lpips_are_told(net, tmp_path, monkeypatch):
    made_up_weights(str(tmp_path / "weights.npz"), net)
    monkeypatch.setenv(f"DSMOE_LPIPS_{net.upper()}", str(tmp_path / "weights.npz"))
    kind = {"alex": "lpips_alex", "vgg": "lpips_vgg_std"}[net]
    side = 1  # grown through convolutions and poolings from the end
    for part in reversed([part for part in NETWORKS[net] if part]):
        size, stride, padding = (*part, 0)[:3] if len(part) == 2 else part[1:]
        side = (side - 1) * stride + size - 2 * padding
    distance = lpips_network(kind, "cpu")
    assert math.isfinite(distance(torch.zeros(3, side, side), torch.ones(3, side, side)))
    with pytest.raises(TrainerError, match=f"at least {side}x{side} pixels, and one has {side - 1}x{side + 9}"):
        distance(torch.zeros(3, side + 9, side - 1), torch.ones(3, side + 9, side - 1))
