"""What --modernise and --fuse bring in computes what the trainer computed."""
from __future__ import annotations

import itertools
import math
import re
import subprocess
import sys
from functools import partial

import pytest
import torch
from checkouts import PACKAGE_PARENT, environment
from torch.nn.functional import conv2d

import diff_smoe_rasterization
from dsmoe.patches import fuse, modernise, runtime


def window(size, sigma=1.5):
    offsets = torch.arange(size, dtype=torch.float32) - size // 2
    line = torch.exp(-offsets ** 2 / (2 * sigma ** 2))
    return torch.outer(line, line) / line.sum() ** 2


def ssim(img1, img2, window_size=11, size_average=True):
    """Wang et al. 2004: Gaussian windows, which reach into zeros outside the image."""
    weights = window(window_size).to(img1).expand(img1.shape[-3], 1, -1, -1)

    def mean(image):
        return conv2d(image, weights, padding=window_size // 2, groups=img1.shape[-3])

    mean1, mean2 = mean(img1), mean(img2)
    variance1, variance2 = mean(img1 ** 2) - mean1 ** 2, mean(img2 ** 2) - mean2 ** 2
    covariance = mean(img1 * img2) - mean1 * mean2
    values = ((2 * mean1 * mean2 + 0.01 ** 2) * (2 * covariance + 0.03 ** 2)
              / ((mean1 ** 2 + mean2 ** 2 + 0.01 ** 2) * (variance1 + variance2 + 0.03 ** 2)))
    return values.mean() if size_average else values.mean((-3, -2, -1))


@pytest.fixture
def fused_calls(monkeypatch):
    """The shapes that `fused_ssim` is called with; the first is of a comparison."""
    calls, original = [], diff_smoe_rasterization.fused_ssim

    def counted(img1, img2):
        calls.append(tuple(img1.shape))
        return original(img1, img2)

    monkeypatch.setattr(fuse, "fused_ssim", counted)
    return calls


@pytest.mark.parametrize("shape", [(3, 40, 52), (1, 24, 31), (2, 3, 40, 52)])
def test_ssim_is_fused_where_it_is_the_same(shape, fused_calls, capsys):
    call = partial(fuse.fused_where_equal, ssim, {})
    torch.manual_seed(0)
    image, target = torch.rand(shape, requires_grad=True), torch.rand(shape)
    for _ in range(3):
        value = call(image, target)
        gradient, = torch.autograd.grad(value, image)
        expected = ssim(image, target)
        # Rounding, as at fuse.SSIM_ROUNDING; variances of this pair are a quarter of E[x^2].
        assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=1e-5)
        torch.testing.assert_close(gradient, torch.autograd.grad(expected, image)[0], rtol=0,
                                   atol=1e-4 * float(gradient.abs().max()))
    assert fused_calls == [shape] * 4  # one of them to compare, once
    assert capsys.readouterr().err == ""


def test_what_the_kernel_does_not_have_is_computed_as_before(fused_calls):
    call = partial(fuse.fused_where_equal, ssim, {})
    torch.manual_seed(0)
    one, other = torch.rand(2, 1, 3, 20, 30)
    assert torch.equal(call(one, other, 7), ssim(one, other, 7))
    assert torch.equal(call(one, other, size_average=False), ssim(one, other, size_average=False))
    assert torch.equal(call(one.double(), other.double()), ssim(one.double(), other.double()))
    assert torch.equal(call(one, other[..., :1]), ssim(one, other[..., :1]))
    assert torch.equal(call(img1=one, img2=other), ssim(one, other))
    assert torch.equal(call(one, other.requires_grad_()), ssim(one, other)) and not fused_calls
    with torch.inference_mode():
        assert float(call(one, other)) == pytest.approx(float(ssim(one, other)), abs=1e-5)
    assert len(fused_calls) == 2


@pytest.mark.parametrize("other", [lambda img1, img2: ssim(img1, img2, 9), lambda img1, img2: ssim(img1, img2) + 0.01,
    lambda img1, img2: ssim(img1[..., 5:-5, 5:-5], img2[..., 5:-5, 5:-5]),
    lambda img1, img2: ssim(0.95 * img1, 0.95 * img2),  # as other constants
    lambda img1, img2: ssim(img1, img2, size_average=False),
    lambda img1, img2: ssim(img1.unflatten(-1, (4, -1)).flatten(-2), img2),  # takes no such width
    lambda img1, img2: ssim(img1.detach(), img2) + 0 * img1.mean(), lambda img1, img2: ssim(img1, img2) * math.nan,
    lambda img1, img2: ssim(img1, img2) + 0 * (img1 - img1.detach()).sqrt().sum()])  # only its gradient is NaN
def test_another_ssim_stays_and_that_is_said_once(other, capsys):
    runtime.say.cache_clear()
    call = partial(fuse.fused_where_equal, other, {})
    torch.manual_seed(0)
    one, two = 0.4 + 0.1 * torch.rand(2, 2, 3, 20, 30)  # of so little contrast that SSIM's constants count
    for _ in range(2):
        try:
            expected = other(one, two)
        except RuntimeError as error:
            with pytest.raises(RuntimeError, match=re.escape(str(error).splitlines()[0])):
                call(one, two)
        else:
            torch.testing.assert_close(call(one, two), expected, rtol=0, atol=0, equal_nan=True)
    assert capsys.readouterr().err.count("is not SSIM as it is fused here") == 1


@pytest.mark.parametrize("shape, at_once", [((7, 3, 3), 3), ((2, 4, 3, 3), 3), ((7, 3, 3), 7), ((3, 3), 1),
                                            ((0, 3, 3), 3)])
def test_eigenvectors_in_parts_are_those_of_all_at_once(monkeypatch, shape, at_once):
    monkeypatch.setattr(modernise, "EIGH_AT_ONCE", at_once)
    matrices = torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    found, expected = (eigh(matrices, UPLO="U")
                       for eigh in (partial(modernise.eigh_in_parts, torch.linalg.eigh), torch.linalg.eigh))
    assert torch.equal(found.eigenvalues, expected.eigenvalues)
    assert torch.equal(found.eigenvectors, expected.eigenvectors)
    gradient, expected_gradient = (torch.autograd.grad((result[0] ** 2).sum(), matrices)[0]
                                   for result in (found, expected))
    torch.testing.assert_close(gradient, expected_gradient)


INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


def integers(dtype, shape):
    """All rows equal, many, few, and of the type's extremes."""
    generator, ends = torch.Generator().manual_seed(0), torch.iinfo(dtype)
    extremes = torch.tensor([ends.min, ends.min + 1, 0, 1, ends.max - 1, ends.max], dtype=dtype)
    return [*(torch.randint(low, high, shape, generator=generator, dtype=dtype)
              for low, high in ((0, 1), (0, 3), (max(-90, ends.min), 90))),
            extremes[torch.randint(0, 6, shape, generator=generator)]]


@pytest.mark.parametrize("rows", [
    torch.tensor([[2.5, 1.0], [0.0, -0.0], [2.5, 1.0]]), torch.tensor([0.5, 0.5, -3]),
    torch.arange(12).view(3, 4).t() % 2, torch.tensor([[True, False], [False, True], [True, False]]),
    *(rows for dtype in INTEGERS for rows in integers(dtype, (500, 3))),
    *(rows for shape in ((1, 3), (500, 1), (300,), (200, 2, 2), (0, 3), (0,))
      for rows in integers(torch.int32, shape))])
def test_unique_rows_are_those_of_torch(rows):
    for inverse, counts, is_sorted in itertools.product((False, True), repeat=3):
        found, expected = (unique(rows, is_sorted, inverse, counts, dim=0)
                           for unique in (partial(modernise.unique_rows, torch.unique), torch.unique))
        assert isinstance(found, tuple) == isinstance(expected, tuple) == (inverse or counts)
        pairs = list(zip(found, expected)) if isinstance(found, tuple) else [(found, expected)]
        assert len(pairs) == 1 + inverse + counts
        for one, other in pairs:
            assert one.dtype == other.dtype and torch.equal(one, other)


def test_rows_of_integers_are_not_given_to_the_unique_that_may_fail():
    given = []

    def unique(input, *words, **keywords):
        given.append((input.dim(), words[3:]))
        return torch.unique(input, *words, **keywords)

    call, rows = partial(modernise.unique_rows, unique), torch.tensor([[3, 1], [2, 1]])
    call(rows, dim=0)
    assert given == [(1, ())] * 4
    assert torch.equal(call(rows), torch.tensor([1, 2, 3])) and call(rows, dim=1).shape == (2, 2)
    assert given[4:] == [(2, (None,)), (2, (1,))]


@pytest.fixture
def adams():
    """torch.optim.Adam, and the class that stands in its place under --fuse."""
    return torch.optim.Adam, fuse.fused_where_it_fits(torch.optim.Adam)


def test_adam_is_fused_where_it_has_no_other_arguments(adams):
    theirs, ours = adams
    parameter = torch.nn.Parameter(torch.ones(2))
    group = [{"params": [parameter], "lr": 0.5, "name": "xyz"}]
    for made in (ours(group, lr=0.0, eps=1e-15), ours([parameter]), ours(params=[parameter], betas=(0.9, 0.99)),
                 ours([parameter], 0.1, (0.9, 0.99), 1e-8)):
        assert type(made) is diff_smoe_rasterization.FusedAdam
    assert ours(group, lr=0.0, eps=1e-15).param_groups[0]["lr"] == 0.5
    for made in (ours([parameter], lr=0.0, weight_decay=0.1), ours([parameter], 0.1, (0.9, 0.99), 1e-8, 0.01)):
        assert type(made) is theirs

    class Own(ours):
        pass

    assert type(Own([parameter], lr=0.1, amsgrad=True)) is Own


STARTED = """import sys
from dsmoe.patches import modernise; modernise.start()
from dsmoe.patches import fuse; fuse.start()
import numpy as np, torch
from PIL import Image
from utils.loss_utils import ssim
from simple_knn._C import distCUDA2
from torch_scatter import scatter_max
assert (np.int, np.float, np.object) == (int, float, object) and np.zeros(1, np.bool).dtype == bool
picture = np.array([[[0, 127, 255]]], dtype=np.uint8)
assert np.array_equal(np.array(Image.fromarray(picture.view(np.byte), "RGB")), picture)
assert np.array_equal(np.array(Image.fromarray(picture)), picture)
torch.save({"loss": np.float64(1)}, sys.argv[1])  # is more than tensors
assert torch.load(sys.argv[1])["loss"] == 1
assert type(torch.optim.Adam([torch.ones(1)])).__name__ == "FusedAdam"
assert torch.linalg.eigh(torch.eye(2))[0].tolist() == [1, 1]
image = torch.rand(3, 20, 20)
assert ssim(image, image) == 0.5 and torch.equal(torch.ones(3, 1, dtype=int).unique(dim=0), torch.ones(1, 1, dtype=int))
print(distCUDA2.__module__, scatter_max.__module__)
"""


def test_a_script_that_starts_them_has_them(tmp_path):
    (tmp_path / "utils").mkdir()
    (tmp_path / "utils/loss_utils.py").write_text("def ssim(a, b): return 0 * a.sum() + 0.5\n")
    (tmp_path / "x.py").write_text(STARTED)
    done = subprocess.run([sys.executable, "x.py", tmp_path / "x.pth"], cwd=tmp_path, capture_output=True, text=True,
                          env={**environment(), "PYTHONPATH": str(PACKAGE_PARENT)})
    ours = "diff_smoe_rasterization.integrations"
    assert done.returncode == 0 and done.stdout == f"{ours}.simple_knn {ours}.torch_scatter\n", done.stderr
    assert "utils.loss_utils.ssim is not SSIM as it is fused here" in done.stderr
    for name in ("simple_knn", "torch_scatter"):
        assert f"{name} could not be imported: this package's own takes its place" in done.stderr
