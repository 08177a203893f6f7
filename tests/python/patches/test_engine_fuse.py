"""--fuse: where its rules are applied, and that what it brings in computes what the trainer computed."""
from __future__ import annotations

import json
import math
import os
import re
import shutil
from pathlib import Path

import pytest
import torch
from torch.nn.functional import avg_pool2d, conv2d

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

import diff_smoe_rasterization  # noqa: E402
from diff_smoe_rasterization import FusedAdam, patches  # noqa: E402
from diff_smoe_rasterization.patches import runtime  # noqa: E402
from test_patch_engine import make, snapshot  # noqa: E402

LOSSES = {"utils/loss_utils.py": "def ssim(img1, img2, window_size=11, size_average=True):\n    return 1\n"}


def test_it_may_be_added_to_a_patch_and_stays_with_it(tmp_path, dsmoe):
    make(tmp_path, LOSSES)
    before = snapshot(tmp_path)
    patches.apply(tmp_path, modernise=True)
    assert "fused-loss" not in dsmoe("patch", "check", tmp_path).out
    said = dsmoe("patch", "apply", tmp_path, "--fuse")
    assert said.status == 0 and "fuse fused-loss: applied in utils/loss_utils.py: the five convolutions" in said.out
    assert "fuse: skipped, nothing matches: fused-adam" in said.out and "modernise checkpoint-load: applied" in said.out
    assert "@fused_where_equal\ndef ssim" in (tmp_path / "utils/loss_utils.py").read_text()
    said = dsmoe("patch", "check", tmp_path)
    assert ", with --modernise --fuse" in said.out and "fuse fused-loss: applied in utils/loss_utils.py" in said.out
    assert not patches.apply(tmp_path).written  # the patch that is there has all of it
    patches.revert(tmp_path)
    assert snapshot(tmp_path) == before


def test_check_says_what_to_type(tmp_path, dsmoe):
    make(tmp_path, LOSSES)
    patches.apply(tmp_path)
    said = dsmoe("patch", "check", tmp_path, "--fuse", "--modernise")
    assert "fuse fused-loss: not applied in utils/loss_utils.py" in said.out
    assert f"modernise, fuse: to apply what is not, type: dsmoe patch apply --modernise --fuse {tmp_path}" in said.out


def test_it_is_seen_without_a_record(tmp_path, dsmoe):
    make(tmp_path, {**LOSSES, "scene/model.py": "import torch\nadam = torch.optim.Adam(l, lr=0.0, eps=1e-15)\n"})
    patches.apply(tmp_path, fuse=True)
    shutil.rmtree(tmp_path / ".dsmoe_patch")
    said = dsmoe("patch", "check", tmp_path, "--fuse")
    assert "fuse fused-loss: applied in utils/loss_utils.py" in said.out
    assert "fuse fused-adam: applied in scene/model.py" in said.out and "type: " not in said.out


def test_a_record_from_before_the_option_is_read(tmp_path):
    make(tmp_path, LOSSES)
    patches.apply(tmp_path, modernise=True)
    path = tmp_path / ".dsmoe_patch/manifest.json"
    manifest = json.loads(path.read_text())
    assert manifest.pop("options") == ["modernise"]
    path.write_text(json.dumps({**manifest, "modernise": True}))
    assert patches.inspect(tmp_path).options == ("modernise",)
    assert patches.apply(tmp_path, fuse=True).options == ("modernise", "fuse")


@pytest.mark.skipif("DSMOE_TRAINERS" not in os.environ, reason="DSMOE_TRAINERS names no folder of public checkouts")
@pytest.mark.parametrize("name", patches.TRAINERS)
def test_in_public_checkouts_loss_and_optimizer_change(name):
    folder = Path(os.environ["DSMOE_TRAINERS"]) / name
    if not folder.is_dir():
        pytest.skip(f"DSMOE_TRAINERS has no {name}")
    found = {rule.rule: rule.files for rule in patches.inspect(folder, fuse=True).requested}
    assert found == {"fused-loss": ("utils/loss_utils.py",), "fused-adam": ("scene/gaussian_model.py",)}
    changed = [line for line in patches.diff(folder, fuse=True).splitlines() if line.startswith("+ ")]
    assert any("FusedAdam(" in line for line in changed)


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
    """The shapes that `fused_ssim` is called with; the first two are of a comparison."""
    calls, original = [], diff_smoe_rasterization.fused_ssim

    def counted(img1, img2):
        calls.append(tuple(img1.shape))
        return original(img1, img2)

    monkeypatch.setattr(diff_smoe_rasterization, "fused_ssim", counted)
    return calls


@pytest.mark.parametrize("shape", [(3, 40, 52), (1, 24, 31), (2, 3, 40, 52)])
def test_ssim_is_fused_where_it_is_the_same(shape, fused_calls, capsys):
    call = runtime.fused_where_equal(ssim)
    torch.manual_seed(0)
    image, target = torch.rand(shape, requires_grad=True), torch.rand(shape)
    for arguments in ((), (11,), (11, True)):
        value = call(image, target, *arguments)
        gradient, = torch.autograd.grad(value, image)
        expected = ssim(image, target)
        # Rounding, as at runtime.SSIM_ROUNDING; variances of this pair are a quarter of E[x^2].
        assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=1e-5)
        torch.testing.assert_close(gradient, torch.autograd.grad(expected, image)[0], rtol=0,
                                   atol=1e-4 * float(gradient.abs().max()))
    assert fused_calls == [shape] * 5  # two of them to compare, once
    assert capsys.readouterr().err == "" and call.__name__ == "ssim"


def test_what_the_kernel_does_not_have_is_computed_as_before(fused_calls):
    call = runtime.fused_where_equal(ssim)
    torch.manual_seed(0)
    one, other = torch.rand(2, 1, 3, 20, 30)
    assert torch.equal(call(one, other, 7), ssim(one, other, 7))
    assert torch.equal(call(one, other, size_average=False), ssim(one, other, size_average=False))
    assert torch.equal(call(one.double(), other.double()), ssim(one.double(), other.double()))
    assert torch.equal(call(one, other[..., :1]), ssim(one, other[..., :1]))
    assert torch.equal(call(img1=one, img2=other), ssim(one, other))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert call(one, other) == ssim(one, other)
    assert torch.equal(call(one, other.requires_grad_()), ssim(one, other)) and not fused_calls
    with torch.inference_mode():
        assert float(call(one, other)) == pytest.approx(float(ssim(one, other)), abs=1e-5)
    assert len(fused_calls) == 3


@pytest.mark.parametrize("arguments, keywords", [
    ((torch.ones(20, 30),), {}), ((11, True, torch.ones(20, 30)), {}), ((), {"mask": torch.ones(20, 30)})])
def test_other_arguments_are_the_trainers_own(arguments, keywords, fused_calls):
    def masked(img1, img2, *rest, mask=None):
        return ssim(img1, img2) * (rest[-1] if mask is None else mask).mean()

    one, other = torch.rand(2, 3, 20, 30)
    assert runtime.fused_where_equal(masked)(one, other, *arguments, **keywords) == ssim(one, other)
    assert runtime.fused_where_equal(lambda img1, img2: 3)(one.numpy(), other.numpy()) == 3 and not fused_calls


@pytest.mark.parametrize("other", [
    lambda img1, img2: ssim(img1, img2, 9), lambda img1, img2: ssim(img1, img2) + 0.01,
    lambda img1, img2: ssim(img1[..., 5:-5, 5:-5], img2[..., 5:-5, 5:-5]),
    lambda img1, img2: ssim(0.95 * img1, 0.95 * img2),  # as other constants
    lambda img1, img2: ssim(img1.clamp(0, 1), img2.clamp(0, 1)), lambda img1, img2: ssim(img1, img2).clamp(min=0),
    lambda img1, img2: ssim(avg_pool2d(img1, 2), avg_pool2d(img2, 2)) if img1.shape[-1] > 28 else ssim(img1, img2),
    lambda img1, img2: ssim(img1, img2, size_average=False), lambda img1, img2: len(img1) * ssim(img1, img2),
    lambda img1, img2: ssim(img1.unflatten(-1, (4, -1)).flatten(-2), img2),  # takes no such width
    lambda img1, img2: ssim(img1.detach(), img2) + 0 * img1.mean(), lambda img1, img2: ssim(img1, img2) * math.nan,
    lambda img1, img2: ssim(img1, img2) + 0 * (img1 - img1.detach()).sqrt().sum()])  # its gradient alone is NaN
def test_another_ssim_stays_and_that_is_said_once(other, capsys):
    runtime._say.cache_clear()
    call = runtime.fused_where_equal(other)
    torch.manual_seed(0)
    one, two = torch.rand(2, 2, 3, 20, 30)
    for _ in range(2):
        try:
            expected = other(one, two)
        except RuntimeError as error:
            with pytest.raises(RuntimeError, match=re.escape(str(error).splitlines()[0])):
                call(one, two)
        else:
            torch.testing.assert_close(call(one, two), expected, rtol=0, atol=0, equal_nan=True)
    assert capsys.readouterr().err.count("is not SSIM as it is fused here") == 1


def test_a_second_derivative_is_refused():
    image, target = torch.rand(3, 20, 30, requires_grad=True), torch.rand(3, 20, 30)
    with pytest.raises(RuntimeError, match="second derivatives are not implemented"):
        torch.autograd.grad(diff_smoe_rasterization.fused_ssim(image, target), image, create_graph=True)


def test_a_small_fit_goes_the_same_way():
    """3DGS's loss, its epsilon, parameters that are replaced on the way as densification does."""
    def fitted(similarity, adam):
        torch.manual_seed(0)
        target, start = torch.rand(3, 24, 24), torch.rand(3, 24, 24)
        image = torch.nn.Parameter(start)
        optimizer, losses = adam([{"params": [image], "lr": 0.01}], lr=0.0, eps=1e-15), []
        for step in range(40):
            loss = 0.8 * (image - target).abs().mean() + 0.2 * (1 - similarity(image, target))
            loss.backward()
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            losses.append(loss.item())
            if step == 20:
                state = optimizer.state.pop(image)
                image = optimizer.param_groups[0]["params"][0] = torch.nn.Parameter(image.detach().clone())
                optimizer.state[image] = {name: value.clone() if torch.is_tensor(value) else value
                                          for name, value in state.items()}
        return losses

    before, after = fitted(ssim, torch.optim.Adam), fitted(runtime.fused_where_equal(ssim), FusedAdam)
    # Adam divides by the gradient's size, so a pixel whose gradient is about 0 may step otherwise: 0.01 of 1728.
    assert before[-1] < 0.5 * before[0]
    assert after == pytest.approx(before, rel=1e-3)
