"""LPIPS from files of weights, against its definition; and where there are none."""
import numpy as np
import pytest
import real_data
import torch
from test_measure import step_image

from diff_smoe_rasterization.benchmarks.errors import BenchError
from diff_smoe_rasterization.benchmarks.suite import lpips, measure
from diff_smoe_rasterization.benchmarks.suite import names as files
from diff_smoe_rasterization.benchmarks.suite.measure import Measures


def test_weights_that_are_named_and_not_there_are_refused_where_they_are_wanted(monkeypatch, tmp_path):
    monkeypatch.setenv("DSMOE_LPIPS_ALEX", str(tmp_path / "absent.npz"))
    files.check_weights(["lpips_vgg_std"])
    with pytest.raises(BenchError, match="DSMOE_LPIPS_ALEX: .*absent.npz: no such file, where the weights of lpips_al"):
        files.check_weights(["lpips_vgg_std", "lpips_alex"])
    (tmp_path / "absent.npz").touch()
    files.check_weights(["lpips_alex"])


@pytest.mark.parametrize("content, said", [
    (b"", "is no .npz file that can be read (EOFError)"),
    (b"some words", "is no .npz file that can be read"),
    (b"PK\x03\x04 and no more", "is no .npz file that can be read"),
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
# (side, stride) of maximum poolings; None where LPIPS looks.
NETWORKS = {"alex": [(64, 11, 4, 2), None, (3, 2), (192, 5, 1, 2), None, (3, 2), (384, 3, 1, 1), None,
                     (256, 3, 1, 1), None, (256, 3, 1, 1), None],
            "vgg": [*2 * [(8, 3, 1, 1)], None, (2, 2), *2 * [(16, 3, 1, 1)], None, (2, 2), *3 * [(32, 3, 1, 1)], None,
                    (2, 2), *3 * [(64, 3, 1, 1)], None, (2, 2), *3 * [(64, 3, 1, 1)], None]}


def made_up_weights(path, net="alex"):
    """Random weights of the right shapes."""
    random, arrays, inputs, layer, looks = np.random.RandomState(0), {}, 3, 0, 0
    for part in NETWORKS[net]:
        if part is None:
            arrays[f"lin{looks}.weight"] = random.rand(inputs).astype(np.float32)
            looks += 1
        elif len(part) == 4:
            channels, side, _, _ = part
            layer += 1
            weight = random.randn(channels, inputs, side, side) / (side * inputs ** 0.5)
            arrays[f"conv{layer}.weight"] = weight.astype(np.float32)
            arrays[f"conv{layer}.bias"] = random.randn(channels).astype(np.float32)
            inputs = channels
    np.savez(path, **arrays)


def lpips_in_double(net, arrays, image, target, normalise):
    """LPIPS by its definition, in float64."""
    # Of [0, 1], ImageNet's; of [-1, 1] as LPIPS prints them, rounded.
    mean, deviation = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]) if normalise else \
        ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450])
    a, b = ((x.double() - torch.tensor(mean).double()[:, None, None]) / torch.tensor(deviation)[:, None, None]
            for x in (image, target))
    total, layer, looks = 0.0, 0, 0
    for part in NETWORKS[net]:
        if part is None:
            weight = torch.from_numpy(arrays[f"lin{looks}.weight"]).double().reshape(-1, 1, 1)
            units = (torch.nn.functional.normalize(x, dim=0) for x in (a, b))
            total += float((weight * (next(units) - next(units)) ** 2).sum(dim=0).mean())
            looks += 1
        elif len(part) == 2:
            a, b = (torch.nn.functional.max_pool2d(x[None], *part)[0] for x in (a, b))
        else:
            layer += 1
            weight, bias = (torch.from_numpy(arrays[f"conv{layer}.{name}"]).double() for name in ("weight", "bias"))
            a, b = (torch.conv2d(x[None], weight, bias, *part[2:])[0].relu() for x in (a, b))
    return total


@pytest.fixture(params=["made up alex", "made up vgg", "published alex"])
def weights(request, tmp_path):
    """The network, and its file."""
    *made_up, net = request.param.split()
    path = tmp_path / "weights.npz"
    if made_up[0] == "made":
        made_up_weights(path, net)
        return net, str(path)
    folder = real_data.folder("bonsai")
    return net, folder.replace("bonsai", "lpips_alex_v01.npz")


@pytest.mark.parametrize("normalise", [True, False])
def test_lpips_of_a_file_agrees_with_the_definition(weights, normalise):
    """[0, 1] normalised by ImageNet's mean and deviation is [-1, 1] shifted and scaled as LPIPS has it."""
    net, path = weights
    random = np.random.RandomState(1)
    image, target = (torch.from_numpy(random.rand(3, 64, 72).astype(np.float32)) for _ in range(2))
    network = lpips.FileLpips(net, path, normalise, "cpu")
    assert network(image, image) == 0
    with np.load(path) as file:
        expected = lpips_in_double(net, {name: file[name] for name in file.files}, image, target, normalise)
    # The float32 network is 1e-5 off the float64 one: sums of some thousand terms.
    assert network(image, target) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("kind, variable, net", [("lpips_alex", "DSMOE_LPIPS_ALEX", "alex"),
                                                 ("lpips_vgg_std", "DSMOE_LPIPS_VGG", "vgg"),
                                                 ("lpips_vgg_inria", "DSMOE_LPIPS_VGG", "vgg")])
def test_each_kind_takes_its_file(monkeypatch, tmp_path, kind, variable, net):
    made_up_weights(tmp_path / "weights.npz", net)
    monkeypatch.setenv(variable, str(tmp_path / "weights.npz"))
    measures = Measures("cpu", [kind])
    value = measures(step_image(64, 64, 32) + 0.1, step_image(64, 64, 32))[kind]
    expected = lpips.FileLpips(net, str(tmp_path / "weights.npz"), kind != "lpips_vgg_inria", "cpu")
    assert value == expected(measure.quantised(step_image(64, 64, 32) + 0.1), step_image(64, 64, 32)) > 0
